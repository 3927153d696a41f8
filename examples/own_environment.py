"""Your own environment with delays on all three channels, and with delays that you measured.

A cart is controlled over a network. Positions, commands and the news of a crash all arrive late. The delays come from a
file such as a logger writes, with one travel time in seconds per line. The example needs only NumPy and Gymnasium.
"""

import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np

from delayrl.delays import as_delay
from delayrl.wrappers import Delayed


class Cart(gym.Env):
    """Hold a cart on top of a hill, at 0. Observation: position, velocity. Action: force. It crashes beyond ±2."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    dt = 0.05  # seconds a step, so that delays can be given as times

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-0.1, 0.1, 2)
        return self.state.copy(), {}

    def step(self, action):
        position, velocity = self.state
        velocity += self.dt * (8 * float(action[0]) + 6 * position)
        self.state = np.array([position + self.dt * velocity, velocity])
        return self.state.copy(), 1.0, bool(abs(self.state[0]) > 2), False, {}


def predict(obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Predict the present state: run the model through the actions that are on their way."""
    cart = Cart()
    cart.state = obs.copy()
    for action in actions:
        cart.step(action)
    return cart.state


def controller(state: np.ndarray) -> np.ndarray:
    return np.clip([-1.6 * state[0] - 0.7 * state[1]], -1, 1).astype(np.float32)


def steps_until_crash(env: gym.Env, predicts: bool, seed: int) -> int:
    obs, info = env.reset(seed=seed)
    for step in range(400):
        state = predict(obs, info["actions"][: info["age"]]) if predicts else obs
        obs, _, terminated, _, info = env.step(controller(state))
        if terminated:
            return step
    return 400


with tempfile.TemporaryDirectory() as folder:
    trace = Path(folder, "trace.csv")  # your measurements; made up here, 100 to 400 ms
    times = np.where(np.arange(500) % 50 < 25, 0.4, 0.2) - np.random.default_rng(0).uniform(0, 0.1, 500)
    trace.write_text("\n".join(["travel", *(f"{time:.4f}" for time in times)]) + "\n")

    for text in ("0", f"recorded:{trace}:s@fifo", f"recorded:{trace}:s@fifo+action=100ms+reward=200ms"):
        env = Delayed(Cart(), text)
        for predicts in (False, True):
            lasted = [steps_until_crash(env, predicts, seed) for seed in range(20)]
            how = "predicts through the actions on their way" if predicts else "trusts the late observation"
            print(f"up to {as_delay(text, Cart.dt).maximum} steps late; {how}: {np.mean(lasted):.0f} of 400 steps")
