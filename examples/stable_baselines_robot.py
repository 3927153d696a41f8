"""A policy of Stable-Baselines3 on a robot: in the controller, and as a bundle that needs neither it nor PyTorch.

    pip install -e '.[examples]'
    python examples/stable_baselines_robot.py --steps 6000 --out pendulum

It trains SAC on the augmented state, for a sensor that is 75 ms late at any phase of the control loop. Then it plays
the same episodes with the model and with the bundle: the actions agree.
"""

import argparse

import gymnasium as gym
import numpy as np

from delayrl.deploy import Controller, adapt, export_layers, load_bundle, stable_baselines_layers
from delayrl.errors import needs_extra
from delayrl.wrappers import AugmentedObservation, Delayed

try:
    from stable_baselines3 import SAC
except ModuleNotFoundError as error:
    raise SystemExit(needs_extra(error) or error) from error

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=6000)
parser.add_argument("--delay", default="75ms~", help="in the text form of delayrl.delays (default: %(default)s)")
parser.add_argument("--out", default="pendulum", help="folder of the bundle (default: %(default)s)")
given = parser.parse_args()

env = AugmentedObservation(Delayed(gym.make("Pendulum-v1"), given.delay))
model = SAC("MlpPolicy", env, seed=0, learning_starts=200)
model.learn(given.steps)


def act(vector: np.ndarray) -> np.ndarray:
    return model.predict(vector, deterministic=True)[0]


export_layers(stable_baselines_layers(model), act, env, given.out, agent="SAC", force=True)


def play(controller: Controller, episode: int) -> tuple[float, list[np.ndarray]]:
    """Play an episode through the controller, which is given observations with their stamps, and nothing else."""
    _, info = env.reset(seed=episode)
    controller.reset()
    truths, actions, total, done = [info["truth"]], [], 0.0, False
    while not done:
        step = len(actions)
        made = step - info["age"] + controller.action_delay  # the age counts actions that have not acted yet
        controller.observe(truths[made], made, step)
        actions.append(controller.act(step))
        _, reward, terminated, truncated, info = env.step(actions[-1])
        truths.append(info["truth"])
        total, done = total + float(reward), terminated or truncated
    return total, actions


of_model, of_bundle = Controller(adapt(act, env)), Controller(load_bundle(given.out))
print(f"{given.out} serves {of_bundle.serves}")
for episode in range(3):
    (total, actions), (again, others) = play(of_model, episode), play(of_bundle, episode)
    print(f"episode {episode}: return {total:.0f} with the model, {again:.0f} with the bundle")
    assert np.abs(np.array(actions)[:20] - np.array(others)[:20]).max() < 1e-3
assert of_model.statistics.overruns == of_bundle.statistics.overruns == 0
