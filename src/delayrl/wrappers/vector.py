"""The wrapper of a vector of environments, for any of Gymnasium's ways to start the next episode."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

from delayrl.delays import Channel, Delay, DelayLaw, as_delay
from delayrl.errors import DelayRLError
from delayrl.wrappers import single
from delayrl.wrappers.single import Info
from delayrl.wrappers.transit import Fill, Transit


class DelayedVector(VectorWrapper[Any, Any, Any, Any, Any]):
    """`Delayed` for every environment of a vector, each with random numbers of its own.

    Environment i of a vector that is reset with seed k is, number for number, the single one reset with k + i. What
    `Delayed` adds to `info` has a leading axis for the environments. Where an ended episode is followed at once by the
    next (autoreset mode "same step"), what was seen last stands in `info["final_obs"]` and `info["final_info"]`.

    Args:
        env: any Gymnasium vector environment with flat Box observations and actions.
        delay, history, fill: as `Delayed`. Times need `step_seconds`.
        step_seconds: the length of a step; None to ask the environment.

    Raises:
        DelayRLError: as `Delayed`; and for late rewards: a late termination would have to hold one environment back.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        delay: float | str | DelayLaw | Channel | Delay,
        history: int | None = None,
        fill: Fill = "first",
        step_seconds: float | None = None,
    ) -> None:
        if not isinstance(env, VectorEnv):
            raise DelayRLError(f"DelayedVector takes a vector of environments; got {type(env).__name__}. See Delayed")
        single.check_spaces(single.name_of(env), env.single_observation_space, env.single_action_space)
        super().__init__(env)
        if step_seconds is None and (envs := getattr(env.unwrapped, "envs", None)):
            step_seconds = single.seconds_of(envs[0])
        self.delay = as_delay(delay, step_seconds)
        if self.delay.reward.maximum:
            raise DelayRLError(
                "a vector of environments goes on together, so rewards and terminations cannot be late in it: "
                "delay them inside, gymnasium.make_vec(..., wrappers=[lambda env: Delayed(env, ...)])"
            )
        self.history = single.check_length(env, self.delay, history, fill)
        actions = env.single_action_space
        assert isinstance(actions, Box)
        self._transits = [single.transit_of(self.delay, self.history, fill, actions) for _ in range(env.num_envs)]
        mode = env.metadata.get("autoreset_mode")
        self._mode = getattr(mode, "value", mode or "NextStep")
        self._masks, self._dtype = single.masks(self.history), actions.dtype
        self._ended = np.zeros(env.num_envs, bool)
        self._present = np.ones(env.num_envs, bool)
        self._present.setflags(write=False)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Info | None = None
    ) -> tuple[NDArray[Any], Info]:
        """Start all episodes, or those of `options["reset_mask"]`."""
        every = np.ones(self.num_envs, bool)
        mask = every if options is None else options.get("reset_mask", every)
        truth, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        for i in np.flatnonzero(mask):
            self._transits[i].reset(truth[i], seeds[i] if seeds is not None else None)
        self._ended[mask] = False
        obs, late = self._show(self._transits, truth)
        return obs, infos | late | self._said(late)

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        """Act in all of them."""
        actions = np.array(actions, self._dtype)
        # those that this step only resets: their action is not used
        reset_only = set(np.flatnonzero(self._ended)) if self._mode == "NextStep" and self._ended.any() else ()
        for i, (transit, action) in enumerate(zip(self._transits, actions, strict=True)):
            if i not in reset_only:
                applied = transit.act(action)
                if applied is not action:
                    action[:] = applied
        truth, rewards, terminated, truncated, infos = self.env.step(actions)
        done = np.asarray(terminated) | np.asarray(truncated)
        ended_here = set(np.flatnonzero(done)) if self._mode == "SameStep" and done.any() else ()
        for i, transit in enumerate(self._transits):
            if i in reset_only:
                transit.reset(truth[i])
            elif i in ended_here:
                transit.step(infos["final_obs"][i], 0.0, False, False)
                last, late = self._show([transit], infos["final_obs"][i][None])
                infos["final_obs"][i] = last[0]
                late = {name: value[0] for name, value in late.items()}
                infos["final_info"] = self._add_info(infos.get("final_info", {}), late, i)
                transit.reset(truth[i])
            else:
                transit.step(truth[i], 0.0, False, False)
        self._ended = done
        obs, late = self._show(self._transits, truth)
        return obs, rewards, terminated, truncated, infos | late | self._said(late)

    def _show(self, transits: list[Transit], truth: NDArray[Any]) -> tuple[NDArray[Any], Info]:
        """What is seen in each of these, with a leading axis."""
        shown = [transit.shown() for transit in transits]
        size = shown[0][2].shape[1]
        actions = np.zeros((len(shown), self.history, size), self._dtype)
        for row, (_, age, recent, _) in zip(actions, shown, strict=True):
            row[:age] = recent
        ages = np.array([age for _, age, _, _ in shown])
        obs = np.array([one for one, _, _, _ in shown])
        late = {"age": ages, "actions": actions, "mask": self._masks[ages], "truth": np.array(truth)}
        if self.delay.action.maximum:
            late["observation_age"] = ages - self.delay.action.maximum
            late["applied"] = np.array([applied for _, _, _, applied in shown])
        return obs, late

    def _said(self, late: Info) -> Info:
        """Gymnasium's way to say whose entries these are: everybody's."""
        return {f"_{name}": self._present for name in late}
