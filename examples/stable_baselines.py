"""Stable-Baselines3's SAC on a delayed task, with only the wrappers of this library.

    pip install -e '.[examples]'
    python examples/stable_baselines.py --steps 6000

`AugmentedObservation` puts the newest observation and the actions since into one vector, so that an algorithm that
knows nothing about delays can learn. Without it, SAC takes a late observation for the current one.
"""

import argparse

import gymnasium as gym
import numpy as np

from delayrl.errors import needs_extra
from delayrl.wrappers import AugmentedObservation, Delayed

try:
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
except ModuleNotFoundError as error:
    raise SystemExit(needs_extra(error) or error) from error


def task(delay: str, augmented: bool) -> gym.Env:
    env = Delayed(gym.make("Pendulum-v1"), delay)
    return Monitor(AugmentedObservation(env) if augmented else env)


parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=6000)
parser.add_argument("--delay", default="uniform:1:5", help="in the text form of delayrl.delays (default: %(default)s)")
given = parser.parse_args()

for augmented in (True, False):
    env = task(given.delay, augmented)
    check_env(env)
    model = SAC("MlpPolicy", env, seed=0, learning_starts=200)
    model.learn(given.steps)
    mean, std = evaluate_policy(model, task(given.delay, augmented), n_eval_episodes=20)
    what = "the augmented state" if augmented else "the late observation alone"
    print(f"delay {given.delay}, SAC on {what}: return {mean:.0f} ± {std:.0f}", flush=True)
    assert np.isfinite(mean)
