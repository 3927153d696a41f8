"""The wrapper of one environment."""

from collections.abc import Iterator
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from delayrl.delays import Channel, Delay, DelayLaw, as_delay
from delayrl.delays.units import whole_steps
from delayrl.errors import DelayRLError
from delayrl.wrappers.transit import Fill, Transit

Info = dict[str, Any]


def check_spaces(name: str, observations: gym.Space[Any], actions: gym.Space[Any]) -> None:
    """Say in one line what is wrong with a task that has no flat observations or no bounded continuous actions."""
    if not isinstance(observations, Box):
        raise DelayRLError(f"{name}: observations must be a Box; got {observations}. Flatten them first")
    if len(observations.shape) != 1:
        raise DelayRLError(
            f"{name}: observations must be flat vectors; got shape {observations.shape} (images are not supported)"
        )
    if not isinstance(actions, Box) or len(actions.shape) != 1:
        raise DelayRLError(f"{name}: actions must be a flat Box (continuous); got {actions}")
    if not (np.issubdtype(actions.dtype, np.floating) and (actions.low < actions.high).all()):
        raise DelayRLError(f"{name}: actions must be real numbers with low < high; got {actions}")
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise DelayRLError(f"{name}: actions must be bounded; got {actions}. Wrap it with RescaleAction or a clip")


def name_of(env: Any) -> str:
    """The id of an environment, or its class."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def _layers(env: Any) -> Iterator[Any]:
    """An environment and what it wraps."""
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env


def seconds_of(env: Any) -> float | None:
    """How long a step of the task is, where it says so: its `dt`, or `tau`."""
    for seconds in (getattr(env.unwrapped, name, None) for name in ("dt", "tau")):
        if isinstance(seconds, int | float | np.number) and seconds > 0:
            return float(seconds)
    return None


def check_length(env: Any, delay: Delay, history: int | None, fill: str) -> int:
    """The rows of the action history. Raises DelayRLError where delay, history and episode do not fit together."""
    limit = env.spec.max_episode_steps if env.spec is not None else None
    longest = max(delay.maximum, delay.reward.maximum)
    if limit is not None and longest >= limit:
        raise DelayRLError(
            f"a delay of {longest} steps is no shorter than an episode of {name_of(env)} ({limit} steps)"
        )
    if fill not in ("first", "zeros"):
        raise DelayRLError(f"fill must be first or zeros; got {fill!r}")
    if history is not None and whole_steps(history) < delay.maximum:
        raise DelayRLError(f"a history of {history} actions is too short for ages up to {delay.maximum}")
    return delay.maximum if history is None else history


def masks(history: int) -> NDArray[np.bool_]:
    """Row i is true for its first i slots: [history + 1, history]."""
    return np.arange(history) < np.arange(history + 1)[:, None]  # type: ignore[no-any-return]


def transit_of(delay: Delay, history: int, fill: Fill, actions: Box, idle: Any = None) -> Transit:
    """The delayed side of an environment with these actions."""
    idle = np.zeros(actions.shape) if idle is None else np.asarray(idle)
    if idle.shape != actions.shape:
        raise DelayRLError(f"the idle action must have the shape {actions.shape}; got {idle.shape}")
    idle = np.clip(idle.astype(actions.dtype), actions.low, actions.high)
    return Transit(delay, history, fill, actions.shape[0], actions.dtype, idle)


class Delayed(gym.Wrapper[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], RecordConstructorArgs):
    """Makes observations late; and actions and rewards, where the delay says so.

    Added to `info`, with H the history's length (the longest age), A the size of an action and S of an observation:
      age      (int)           how many actions may not have acted yet on the state that is shown: the steps since it
                               was made, and the longest delay of the actions
      actions  (float [H, A])  these actions as they were issued, oldest first, zeros after the first `age`
      mask     (bool [H])      true for the first `age` slots
      truth    (float [S])     the true current observation: for privileged learners and tests, never for the agent
    and where actions are late:
      observation_age (int)    the steps since the shown observation was made
      applied  (int)           how old the action was that led to the shown observation: 0 if it acted at once

    What else is in `info` is the task's own and is not late; so wrappers that speak of episodes belong around this one.
    Before its first action arrives, zero acts (clipped to the bounds). A late termination leaves the agent acting, to
    no effect, on an episode that is over; the time limit is not late, and with it comes all that was on its way.

    Args:
        env: any Gymnasium environment with flat Box observations and actions.
        delay: steps, a text ("uniform:1:5@fifo", "80ms+action=2"), a law, or a `Delay`: see `delayrl.delays`.
        history: rows of the action history, to train for longer ages than this delay has; None for the longest age.
        fill: what is shown before anything has arrived: "first" (s_0, at once) or "zeros".
        idle: the action in force before the first one has arrived, [A]; None for zero.
        step_seconds: the length of a step, for delays given as times; None for what the task says (`dt`).

    Raises:
        DelayRLError: for a bad delay, or an environment whose spaces are not flat boxes.
    """

    def __init__(
        self,
        env: gym.Env[NDArray[Any], NDArray[Any]],
        delay: float | str | DelayLaw | Channel | Delay,
        history: int | None = None,
        fill: Fill = "first",
        idle: NDArray[Any] | None = None,
        step_seconds: float | None = None,
    ) -> None:
        if any(isinstance(inner, Delayed) for inner in _layers(env)):
            raise DelayRLError("the environment is delayed already: give one delay, as in Delayed(task, '2+action=1')")
        check_spaces(name_of(env), env.observation_space, env.action_space)
        self.delay = as_delay(delay, seconds_of(env) if step_seconds is None else step_seconds)
        RecordConstructorArgs.__init__(self, delay=self.delay.plain(), history=history, fill=fill, idle=idle)
        gym.Wrapper.__init__(self, env)
        self.history = check_length(env, self.delay, history, fill)
        assert isinstance(env.action_space, Box)
        self._transit = transit_of(self.delay, self.history, fill, env.action_space, idle)
        self._limit = env.spec.max_episode_steps if env.spec is not None else None
        self._masks, self._dtype = masks(self.history), env.action_space.dtype
        self._last: NDArray[Any] = np.zeros(0)
        self._info: Info = {}

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start an episode."""
        self._last, self._info = self.env.reset(seed=seed, options=options)
        self._transit.reset(self._last, seed)
        return self._show()

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, Info]:
        """Act; see what has arrived by the next step."""
        applied = self._transit.act(np.asarray(action, self._dtype))
        reward, terminated, truncated = 0.0, False, False
        if self._transit.over:
            truncated, self._info = self._limit is not None and self._transit.time + 1 >= self._limit, {}
        else:
            self._last, reward, terminated, truncated, self._info = self.env.step(applied)  # type: ignore[assignment]
        reward, terminated, truncated = self._transit.step(self._last, reward, terminated, truncated)
        obs, info = self._show()
        return obs, reward, terminated, truncated, info

    def draw_from(self, seed: int) -> None:
        """Draw the travel times of the episode that has just been reset from another seed than the task's."""
        self._transit.random = np.random.default_rng([seed, 1])

    def _show(self) -> tuple[NDArray[Any], Info]:
        obs, age, recent, late = self._transit.shown()
        if age == self.history:
            actions = recent.copy()
        else:
            actions = np.zeros((self.history, recent.shape[1]), recent.dtype)
            actions[:age] = recent
        info = {**self._info, "age": age, "actions": actions, "mask": self._masks[age].copy(), "truth": self._last}
        if self.delay.action.maximum:
            info["observation_age"], info["applied"] = age - self.delay.action.maximum, late
        return obs.copy(), info
