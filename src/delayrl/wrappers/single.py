"""The wrapper that delays one environment."""

from typing import TYPE_CHECKING, Any, SupportsFloat, get_args

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import Autoreset, DelayObservation
from numpy.typing import ArrayLike, NDArray

from delayrl.delays import Delay, DelayLike, as_delay
from delayrl.errors import DelayRLError
from delayrl.wrappers.layers import check_length, check_spaces, layers_of, limit_of, name_of, seconds_of, warn_once
from delayrl.wrappers.transit import Fill, Transit

Info = dict[str, Any]


def find_delayed(env: Any) -> "Delayed | None":
    """Return the `Delayed` that an environment is or wraps, if any."""
    return next((layer for layer in layers_of(env) if isinstance(layer, Delayed)), None)


def check_layers(env: Any) -> None:
    """Raise DelayRLError if an environment is delayed, or resets itself; warn if another library delays it."""
    layers = list(layers_of(env))
    if find_delayed(env):
        raise DelayRLError("the environment is delayed already: give one delay, e.g. '2+action=1'")
    if any(isinstance(layer, Autoreset) for layer in layers):
        line = "Autoreset inside Delayed would carry what is on its way into the next episode"
        raise DelayRLError(f"{line}: put it outside, Autoreset(Delayed(task, delay))")
    if any(isinstance(layer, DelayObservation) for layer in layers):
        line = "shows old observations already, and no age counts that: give the delay to Delayed (--delay) alone"
        warn_once(f"the DelayObservation inside {name_of(env)} {line}")


def history_rows(env: Any, delay: Delay, history: int | None) -> int:
    """Return the rows of the action history; None asks for the longest age. Raises DelayRLError if they are too few."""
    name, limit = name_of(env), limit_of(env)
    check_length(delay, name, limit)
    late = delay.observation.maximum
    if limit is not None and delay.observation.constant and late >= limit - 1:
        line = f"with a delay of {late} steps nothing after the start of an episode of {name} "
        line += f"({limit} steps) is ever observed: the agent acts on s_0 and its own actions alone"
        warn_once(line)
    if history is None:
        return delay.maximum
    if isinstance(history, bool) or not isinstance(history, int | np.integer):
        raise DelayRLError(f"history is a whole number of actions; got {history!r}")
    if history < delay.maximum:
        raise DelayRLError(f"a history of {history} actions is too short for ages up to {delay.maximum}")
    return int(history)


def make_transit(delay: Delay, history: int, fill: Fill, actions: Box, idle: Any = None) -> Transit:
    """Make the delayed side of an environment with these actions. Raises DelayRLError for a bad fill or idle action."""
    if fill not in get_args(Fill):
        raise DelayRLError(f"fill must be {' or '.join(get_args(Fill))}; got {fill!r}")
    idle = np.zeros(actions.shape) if idle is None else np.asarray(idle)
    if idle.shape != actions.shape or not np.isfinite(idle).all():
        raise DelayRLError(f"the idle action must be finite and have the shape {actions.shape}; got {idle}")
    return Transit(delay, history, fill, np.clip(idle.astype(actions.dtype), actions.low, actions.high))


def _parts(env: Any, method: str, given: Any, count: int, names: str) -> tuple[Any, ...]:
    """Return what an environment gives, if it is a tuple of so many parts. Raises DelayRLError, with their names."""
    several = isinstance(given, tuple | list)
    if several and len(given) == count:
        return tuple(given)
    got = f"{len(given)} things" if several else f"one {type(given).__name__}"
    raise DelayRLError(f"{method} of {name_of(env)} must give {names} (the API of Gymnasium); it gave {got}")


class Delayed(gym.Wrapper[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], RecordConstructorArgs):
    """Delay the observations of an environment, and its actions and rewards if the delay says so.

    Added to `info`, with H the history's length (the longest age), A the size of an action and S of an observation:
      age      (int)           how many actions may not have acted yet on the state that is shown: the steps since it
                               was made, plus the longest delay of the actions in this episode
      actions  (float [H, A])  these actions as they were issued, oldest first, zeros after the first `age`
      mask     (bool [H])      true for the first `age` slots
      truth    (float [S])     the true current observation: for privileged learners and tests, never for the agent
    and with delayed actions:
      observation_age (int)    the steps since the shown observation was made
      applied  (int)           the age of the action that led to the shown observation: 0 if it acted at once

    The task's own `info` has no delay, so put wrappers that record episodes around this one. Before the first action
    arrives, the idle action acts. While a termination is on its way, the agent's actions have no effect. A time limit
    has no delay, and all that is on its way arrives with it.

    Put `TimeLimit` inside: `Delayed(TimeLimit(task, 100), delay)`. This wrapper cannot see one around it, which loses
    the rewards on their way and makes a truncation of a termination on its way. `Autoreset` goes around it.

    Args:
        env: any Gymnasium environment with flat Box observations and actions.
        delay: steps, a text ("uniform:1:5@fifo", "80ms+action=2"), a law, or a `Delay`: see `delayrl.delays`.
        history: rows of the action history, to train for longer ages than this delay has; None for the longest age.
        fill: what is shown before anything has arrived: "first" (s_0, at once) or "zeros".
        idle: the action in force before the first one has arrived, [A]; None for zero. Clipped to the bounds.
        step_seconds: the length of a step, for delays given as times; None for what the task says (`dt` or `tau`). A
            wrapper that repeats actions says it with a `dt` of its own.

    Raises:
        DelayRLError: a bad delay, an environment whose spaces are not flat boxes, or one that resets itself.
    """

    if TYPE_CHECKING:  # as checked below
        observation_space: Box  # type: ignore[override]
        action_space: Box  # type: ignore[override]

    def __init__(
        self,
        env: gym.Env[NDArray[Any], NDArray[Any]],
        delay: DelayLike,
        history: int | None = None,
        fill: Fill = "first",
        idle: ArrayLike | None = None,
        step_seconds: float | None = None,
    ) -> None:
        if not isinstance(env, gym.Env):
            hint = (
                "DelayedVector takes a vector" if isinstance(env, gym.vector.VectorEnv) else "gymnasium.make makes one"
            )
            raise DelayRLError(f"Delayed takes an environment; got {env!r:.60}: {hint}")
        check_layers(env)
        check_spaces(name_of(env), env.observation_space, env.action_space)
        assert isinstance(env.action_space, Box)
        self.step_seconds = seconds_of(env) if step_seconds is None else step_seconds
        self.delay = as_delay(delay, self.step_seconds)
        RecordConstructorArgs.__init__(
            self, delay=self.delay.plain(), history=history, fill=fill, idle=idle, step_seconds=step_seconds
        )
        gym.Wrapper.__init__(self, env)
        self.history = history_rows(env, self.delay, history)
        self._transit = make_transit(self.delay, self.history, fill, env.action_space, idle)
        self.idle = self._transit.idle  # as it acts: within the bounds
        self._limit = limit_of(env)
        self._masks = np.tri(self.history + 1, self.history, -1, bool)  # by age: true in the first `age` slots
        self._dtype = env.action_space.dtype
        self._truth: NDArray[Any] = np.zeros(0)
        self._info: Info = {}

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start an episode. The seed fixes its delays too."""
        shown = self.env.reset(seed=seed, options=options)
        self._truth, self._info = _parts(self.env, "reset", shown, 2, "the observation and its info")
        self._transit.reset(self._truth, seed)
        return self._show()

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, Info]:
        """Issue an action. Returns what has arrived by the next step."""
        action = np.asarray(action, self._dtype)
        if action.shape != self.idle.shape:
            raise DelayRLError(f"an action has the shape {self.idle.shape}; got one of {action.shape}")
        acting = self._transit.act(action)
        reward: Any = 0.0
        terminated = truncated = False
        if self._transit.over:
            truncated = self._limit is not None and self._transit.time + 1 >= self._limit
            self._info = {}
        else:
            shown = self.env.step(acting)
            parts = _parts(self.env, "step", shown, 5, "observation, reward, terminated, truncated and info")
            self._truth, reward, terminated, truncated, self._info = parts
        reward, terminated, truncated = self._transit.step(self._truth, reward, terminated, truncated)
        obs, info = self._show()
        return obs, reward, terminated, truncated, info

    def draw_from(self, seed: int) -> tuple[NDArray[Any], Info]:
        """Take the delays of the current episode, and the random actions of `NoisyActions`, from another seed.

        Call it right after `reset`. Returns what `reset` would then have returned.
        """
        self._transit.draw_from(seed)
        if self.env.has_wrapper_attr("draw_from"):
            self.env.get_wrapper_attr("draw_from")(seed)
        return self._show()

    def _show(self) -> tuple[NDArray[Any], Info]:
        obs, age, recent, applied = self._transit.shown()
        if age == self.history:
            actions = recent.copy()
        else:
            actions = np.zeros((self.history, recent.shape[1]), recent.dtype)
            actions[:age] = recent
        info = {**self._info, "age": age, "actions": actions, "mask": self._masks[age].copy()}
        info["truth"] = np.array(self._truth)  # the environment may go on to write into its own
        if self.delay.action.maximum:
            info["observation_age"], info["applied"] = age - self._transit.lag, applied
        return obs.copy(), info
