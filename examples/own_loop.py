"""Delay any Gymnasium task, in a plain loop: needs only NumPy and Gymnasium, no JAX.

A hand-written controller swings up the pendulum from the newest observation, under longer and longer delays.
"""

import gymnasium as gym
import numpy as np

from delayrl.wrappers import AugmentedObservation, Delayed


def swing_up(obs: np.ndarray) -> np.ndarray:
    """Add energy to the pendulum, and hold it when it is up. obs: cos, sin, angular velocity."""
    angle, velocity = np.arctan2(obs[1], obs[0]), obs[2]
    energy = velocity**2 / 6 + 5 * obs[0] - 5
    torque = -10 * angle - 3 * velocity if abs(angle) < 0.6 else -np.sign(velocity) * energy
    return np.clip([torque], -2, 2).astype(np.float32)


for delay in (0, 1, 3, 5):
    env = Delayed(gym.make("Pendulum-v1"), delay=delay)
    returns = []
    for seed in range(10):
        obs, info = env.reset(seed=seed)
        total, done = 0.0, False
        while not done:
            obs, reward, terminated, truncated, info = env.step(swing_up(obs))
            total += float(reward)
            done = terminated or truncated
        returns.append(total)
    flat = AugmentedObservation(env)  # one vector, for libraries that know nothing about delays
    print(f"delay {delay}: return {np.mean(returns):6.0f}, flat observation {flat.observation_space.shape}")
