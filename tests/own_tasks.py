"""Tasks such as users bring: a class, functions, wrappers, and modules in a folder of their own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.wrappers import TimeLimit


class Arm(gym.Env):
    """position' = position + gain · action, reward -|position|."""

    observation_space = Box(-np.inf, np.inf, (1,), np.float64)
    action_space = Box(-1, 1, (1,), np.float32)

    def __init__(self, gain: float = 1.0, names: Any = None) -> None:
        self.gain, self.names = gain, names

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 1)
        return self.position.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.position = self.position + self.gain * action.astype(float)
        return self.position.copy(), -abs(float(self.position[0])), False, False, {}


class Camera(gym.ObservationWrapper):
    """Shows a nested observation: {"arm": {"position": [x], "double": [2x, 2x]}, "bias": [offset]}."""

    def __init__(self, env: gym.Env, offset: float = 0.0) -> None:
        super().__init__(env)
        self.offset = offset
        number, two = Box(-np.inf, np.inf, (1,), np.float64), Box(-np.inf, np.inf, (2, 1), np.float64)
        self.observation_space = Dict({"arm": Dict({"double": two, "position": number}), "bias": number})

    def observation(self, x: np.ndarray) -> dict:
        return {"arm": {"double": np.array([2 * x, 2 * x]), "position": x}, "bias": np.array([self.offset])}


class Wind(gym.Env):
    """docs/theory.md, section 9: from the sky 3 to the place 0, from -2 to 1 or -1; the reward is a at 0, else -a."""

    observation_space = Box(-4, 4, (1,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.place = self.np_random.choice([3, -2])
        return np.array([self.place], np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward, place = 0.0, self.place
        if place in (0, 1, -1):
            reward = float(action[0] if place == 0 else -action[0])
            self.place = self.np_random.choice([3, -2])
        else:
            self.place = 0 if place == 3 else self.np_random.choice([1, -1])
        return np.array([self.place], np.float32), reward, False, False, {}


def make_arm(**kwargs: Any) -> gym.Env:
    return TimeLimit(Arm(**kwargs), 20)


def failing(method: str) -> Callable[[], gym.Env]:
    """A function that makes an environment whose `reset` or `step` divides by zero, `step` at its third call."""

    class Failing(Arm):
        calls = 0

        def reset(self, **options: Any) -> Any:
            return super().reset(**options) if method != "reset" else 1 / 0

        def step(self, action: np.ndarray) -> Any:
            self.calls += 1
            return super().step(action) if self.calls < 3 else 1 / 0

    return lambda: TimeLimit(Failing(), 20)


LIMIT = "gymnasium.wrappers:TimeLimit(max_episode_steps=20)"
MODULE = """
from own_tasks import Arm, Camera, make_arm


def make(**kwargs):
    return make_arm(**kwargs)


class Broken(Arm):
    def __init__(self, how):
        if how == "id":
            import gymnasium
            gymnasium.make("Nowhere-v3")
        raise ValueError("the serial port is closed\\nsecond line")
"""


def write_module(folder: Path, name: str, text: str = MODULE) -> Path:
    """Write a module of a user into a folder."""
    (folder / f"{name}.py").write_text(text)
    return folder
