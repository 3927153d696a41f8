"""Small tasks for tests and quick trials of an agent. Each one exposes one kind of silent error."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

Obs = NDArray[np.float32]
_STEP = tuple[Obs, float, bool, bool, dict[str, Any]]


class Coin(gym.Env[Obs, Obs]):
    """The state is a new fair coin s = ±1 at every step, the reward a·s. With a delay no agent averages above 0."""

    observation_space = Box(-1, 1, (1,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Toss the first coin."""
        super().reset(seed=seed)
        return self._toss(), {}

    def step(self, action: Obs) -> _STEP:
        """Pay for guessing the coin on the table, then toss the next."""
        reward = float(action[0] * self._coin[0])
        return self._toss(), reward, False, False, {}

    def _toss(self) -> Obs:
        self._coin = np.array([self.np_random.choice([-1.0, 1.0])], np.float32)
        return self._coin


class Walk(gym.Env[Obs, Obs]):
    """s' = s + a, reward -s². With a delay only an agent that knows the actions on their way solves it."""

    observation_space = Box(-10, 10, (1,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Start somewhere in [-2, 2]."""
        super().reset(seed=seed)
        self._position = self.np_random.uniform(-2, 2, 1).astype(np.float32)
        return self._position, {}

    def step(self, action: Obs) -> _STEP:
        """Move by the action, and pay for the new position."""
        self._position = np.clip(self._position + np.clip(action, -1, 1), -10, 10).astype(np.float32)
        return self._position, -float(self._position[0] ** 2), False, False, {}


class Counter(gym.Env[Obs, Obs]):
    """Observation [t, T], reward t + 1, termination after T steps, T drawn from 4..10. It shows misaligned steps."""

    observation_space = Box(0, 10, (2,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Draw the length of the episode, and start at 0."""
        super().reset(seed=seed)
        self._length = int(self.np_random.integers(4, 11))
        self._time = 0
        return self._obs(), {}

    def step(self, action: Obs) -> _STEP:
        """Count one step."""
        self._time += 1
        return self._obs(), float(self._time), self._time == self._length, False, {}

    def _obs(self) -> Obs:
        return np.array([self._time, self._length], np.float32)
