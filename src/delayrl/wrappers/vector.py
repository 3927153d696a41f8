"""The wrapper that delays a vector of environments, in each of Gymnasium's autoreset modes."""

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import ArrayLike, NDArray

from delayrl.delays import DelayLike, as_delay
from delayrl.errors import DelayRLError
from delayrl.wrappers.layers import check_spaces, name_of, seconds_of
from delayrl.wrappers.single import Info, find_delayed, history_rows, make_transit
from delayrl.wrappers.transit import Fill, Transit

OURS = ("age", "actions", "mask", "truth", "observation_age", "applied")  # what this wrapper adds to `info`
INSIDE = "the whole delay inside, gymnasium.make_vec(..., wrappers=[lambda env: Delayed(env, '2+reward=3')])"


TWICE = f"the environments are delayed already: give one delay, here '2+action=1', or {INSIDE}"


class DelayedVector(VectorWrapper[Any, Any, Any, Any, Any]):
    """Delay every environment of a vector, each with random numbers of its own.

    It computes with NumPy on the CPU. Vectors that give arrays of PyTorch or JAX are refused.

    Environment i of a vector that is reset with seed k equals, number for number, a single one that is reset with
    k + i. What `Delayed` adds to `info` has a leading axis for the environments. In autoreset mode "same step",
    `info["final_obs"]` and `info["final_info"]` hold what the agent saw at the end of an episode.

    Args:
        env: any Gymnasium vector environment with flat Box observations and actions, none of them delayed already.
        delay: as `Delayed`.
        history: as `Delayed`.
        fill: as `Delayed`.
        idle: as `Delayed`.
        step_seconds: the length of a step, for delays given as times; None to ask the environments.

    Raises:
        DelayRLError: as `Delayed`; for a delay of rewards, because a termination on its way would hold up the other
            environments, and for environments with one inside, because both would draw the same random numbers; and,
            at the first reset, for observations that are not NumPy's.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        delay: DelayLike,
        history: int | None = None,
        fill: Fill = "first",
        idle: ArrayLike | None = None,
        step_seconds: float | None = None,
    ) -> None:
        if not isinstance(env, VectorEnv):
            raise DelayRLError(f"DelayedVector takes a vector of environments; got {type(env).__name__}. See Delayed")
        check_spaces(name_of(env), env.single_observation_space, env.single_action_space)
        actions: Any = env.single_action_space
        super().__init__(env)
        envs = getattr(env.unwrapped, "envs", ())
        if any(max(inner.delay.maximum, inner.delay.reward.maximum) for inner in map(find_delayed, envs) if inner):
            raise DelayRLError(TWICE)
        if step_seconds is None:
            step_seconds = seconds_of(envs[0] if envs else env.unwrapped)
        self.delay = as_delay(delay, step_seconds)
        if self.delay.reward.maximum:
            line = "a vector of environments cannot delay rewards, because all environments step together"
            raise DelayRLError(f"{line}: give {INSIDE}")
        self.history = history_rows(env, self.delay, history)
        self._transits = [make_transit(self.delay, self.history, fill, actions, idle) for _ in range(env.num_envs)]
        mode = env.metadata.get("autoreset_mode")
        self._mode = getattr(mode, "value", mode or "NextStep")
        self._masks, self._dtype = np.tri(self.history + 1, self.history, -1, bool), actions.dtype
        self._ended = np.zeros(env.num_envs, bool)
        self._every = np.ones(env.num_envs, bool)
        self._every.setflags(write=False)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Info | None = None
    ) -> tuple[NDArray[Any], Info]:
        """Start all episodes, or those of `options["reset_mask"]`."""
        mask = self._every if options is None else options.get("reset_mask", self._every)
        truth, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        if not isinstance(truth, np.ndarray):
            kind = f"{type(truth).__module__}.{type(truth).__name__}"
            raise DelayRLError(
                f"DelayedVector takes and gives NumPy arrays, but the environments give {kind}: convert them inside, "
                "e.g. with gymnasium.wrappers.vector.ArrayConversion"
            )
        if {"age", "actions", "mask"} <= infos.keys():  # a Delayed in processes of their own
            get: Any = getattr(self.env, "get_attr", lambda _: ())  # not all vectors have it
            if np.size(infos["mask"]) or any(own.reward.maximum for own in get("delay")):
                raise DelayRLError(TWICE)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        for i in np.flatnonzero(mask):
            self._transits[i].reset(truth[i], seeds[i] if seeds is not None else None)
        self._ended[mask] = False
        obs, own = self._show(self._transits, truth)
        return obs, infos | own | {f"_{name}": self._every for name in own}

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        """Issue an action in every environment. Returns what has arrived by the next step."""
        actions = np.array(actions, self._dtype)
        if actions.shape != self.env.action_space.shape:
            raise DelayRLError(f"actions have the shape {self.env.action_space.shape}; got {actions.shape}")
        none = np.zeros(self.num_envs, bool)
        # an environment that this step only resets ignores its action
        reset_only = self._ended if self._mode == "NextStep" else none
        for i, transit in enumerate(self._transits):
            if not reset_only[i]:
                actions[i] = transit.act(actions[i])
        truth, rewards, terminated, truncated, infos = self.env.step(actions)
        done = np.asarray(terminated) | np.asarray(truncated)
        ended_here = done if self._mode == "SameStep" else none
        if ended_here.any():  # those of a Delayed without a delay inside have other shapes
            last = infos.get("final_info", {})
            infos["final_info"] = {name: last[name] for name in last if name.removeprefix("_") not in OURS}
        for i, transit in enumerate(self._transits):
            if reset_only[i]:
                transit.reset(truth[i])
            elif ended_here[i]:
                self._finish(i, infos)
                transit.reset(truth[i])
            else:
                transit.step(truth[i], 0.0, False, False)
        self._ended = done
        obs, own = self._show(self._transits, truth)
        presence = {f"_{name}": self._every for name in own}  # in every environment, as Gymnasium's vectors say it
        return obs, rewards, terminated, truncated, infos | own | presence

    def _finish(self, i: int, infos: Info) -> None:
        """Delay the last observation of environment i, whose next episode has started in the same step."""
        transit, truth = self._transits[i], infos["final_obs"][i]
        transit.step(truth, 0.0, False, False)
        obs, own = self._show([transit], truth[None])
        infos["final_obs"][i] = obs[0]
        last = {name: value[0] for name, value in own.items()}
        infos["final_info"] = self._add_info(infos["final_info"], last, i)

    def _show(self, transits: list[Transit], truth: NDArray[Any]) -> tuple[NDArray[Any], Info]:
        """Return observations and our part of `info`, with a leading axis for the environments."""
        observations, ages, histories, applied = zip(*(transit.shown() for transit in transits), strict=True)
        actions = np.zeros((len(transits), self.history, histories[0].shape[1]), self._dtype)
        for row, age, recent in zip(actions, ages, histories, strict=True):
            row[:age] = recent
        age = np.array(ages)
        own = {"age": age, "actions": actions, "mask": self._masks[age], "truth": np.array(truth)}
        if self.delay.action.maximum:
            own["observation_age"] = age - np.array([transit.lag for transit in transits])
            own["applied"] = np.array(applied)
        return np.array(observations), own
