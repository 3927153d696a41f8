"""Gymnasium wrappers that make observations arrive late. They need NumPy and Gymnasium alone.

At step t of an episode the newest observation that has arrived is s_{t-d}, and d is its *age*: min(t, Δ) for a constant
delay Δ. The first observation is s_0 with age 0; no action is faked. What makes the delayed task Markov again, the age
and the actions taken since, is always in `info` (VDPO, §2: x_t = (s_{t-Δ}, a_{t-Δ}, …, a_{t-1})).
"""

from collections import deque
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from delayrl.delays import DelayLaw, as_law
from delayrl.errors import DelayRLError

Info = dict[str, Any]


def check_spaces(env: gym.Env[Any, Any]) -> None:
    """Say in one line what is wrong with a task that has no flat observations or no bounded continuous actions."""
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    observations, actions = env.observation_space, env.action_space
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


class DelayedObservation(gym.Wrapper[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], RecordConstructorArgs):
    """Shows each observation only after its delay; rewards and terminations are not delayed.

    Added to `info`, with Δ the longest delay and A the size of an action:
      age      (int)             steps since the shown observation was made, 0..Δ
      actions  (float [Δ, A])    the actions since then, oldest first, zeros after the first `age`
      mask     (bool [Δ])        true for the first `age` slots
      truth    (float [S])       the true current observation: for privileged learners and tests, never for the agent

    Args:
        env: any Gymnasium environment with flat Box observations and actions.
        delay: environment steps, or a delay law.

    Raises:
        DelayRLError: for a bad delay, or an environment whose spaces are not flat boxes.
    """

    def __init__(self, env: gym.Env[NDArray[Any], NDArray[Any]], delay: int | DelayLaw) -> None:
        check_spaces(env)
        RecordConstructorArgs.__init__(self, delay=delay)
        gym.Wrapper.__init__(self, env)
        self.law = as_law(delay)
        limit = env.spec.max_episode_steps if env.spec is not None else None
        if limit is not None and self.law.maximum >= limit:
            raise DelayRLError(
                f"a delay of {self.law.maximum} steps is no shorter than an episode of {env.spec.id} ({limit} steps)"  # type: ignore[union-attr]
            )
        self._observations: deque[NDArray[Any]] = deque(maxlen=self.law.maximum + 1)
        self._arrivals: deque[int] = deque(maxlen=self.law.maximum + 1)
        self._actions: deque[NDArray[Any]] = deque(maxlen=self.law.maximum)
        self._step = self._newest = self._memory = 0
        self._random = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start an episode; s_0 is shown at once."""
        truth, info = self.env.reset(seed=seed, options=options)
        if seed is not None:  # a stream of its own: the delay must not disturb the environment's randomness
            self._random = np.random.default_rng([seed, 1])
        for history in (self._observations, self._arrivals, self._actions):
            history.clear()
        self._step = self._newest = self._memory = 0
        self._observations.append(np.array(truth))
        self._arrivals.append(0)
        return self._show(info)

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, Info]:
        """Act now; see what has arrived by the next step."""
        truth, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        travel, self._memory = self.law.draw(self._memory, self._random)
        self._observations.append(np.array(truth))
        self._arrivals.append(self._step + travel)
        self._actions.append(np.array(action, self.action_space.dtype))
        obs, info = self._show(info)
        return obs, reward, terminated, truncated, info

    def _show(self, info: Info) -> tuple[NDArray[Any], Info]:
        first = self._step - len(self._observations) + 1
        arrived = [first + i for i, arrival in enumerate(self._arrivals) if arrival <= self._step]
        self._newest = max([self._newest, *arrived])
        age = self._step - self._newest
        actions = np.zeros((self.law.maximum, *self.action_space.shape), self.action_space.dtype)  # type: ignore[misc]
        if age:
            actions[:age] = list(self._actions)[-age:]
        shown = self._observations[self._newest - first].copy()
        late = {
            "age": age,
            "actions": actions,
            "mask": np.arange(self.law.maximum) < age,
            "truth": self._observations[-1].copy(),
        }
        return shown, {**info, **late}


class AugmentedObservation(gym.Wrapper[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], RecordConstructorArgs):
    """Flattens the augmented state into one Box, so that any library can train on a delayed task.

    The vector is the shown observation, the Δ actions since (oldest first, zeros where there are none yet) and the age
    divided by Δ: size S + Δ·A + 1. Without a delay it is the observation unchanged.

    Args:
        env: an environment wrapped by `DelayedObservation`.
    """

    def __init__(self, env: DelayedObservation) -> None:
        if not isinstance(env, DelayedObservation):
            raise DelayRLError("AugmentedObservation goes around DelayedObservation: wrap the task with a delay first")
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._delay = env.law.maximum
        observations, actions = env.observation_space, env.action_space
        assert isinstance(observations, Box)
        assert isinstance(actions, Box)
        if self._delay:
            # a slot without an action holds zeros, which the action's own bounds need not contain
            low, high = np.minimum(actions.low, 0), np.maximum(actions.high, 0)
            self.observation_space = Box(
                np.concatenate([observations.low, np.tile(low, self._delay), [0.0]]).astype(observations.dtype),
                np.concatenate([observations.high, np.tile(high, self._delay), [1.0]]).astype(observations.dtype),
                dtype=observations.dtype.type,  # type: ignore[arg-type, union-attr]
            )

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start an episode with the augmented state of age 0."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self._augment(obs, info), info

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, Info]:
        """Act now; see the augmented state of the next step."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._augment(obs, info), reward, terminated, truncated, info

    def _augment(self, obs: NDArray[Any], info: Info) -> NDArray[Any]:
        if not self._delay:
            return obs
        parts = [obs, info["actions"].ravel(), [info["age"] / self._delay]]
        return np.concatenate(parts).astype(self.observation_space.dtype)
