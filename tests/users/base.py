"""What works in an environment with delayrl's base alone, from the wheel: `python base.py BUNDLE`; CI runs it.

It prints a line for each thing tried, and the size of the environment. Modules that only the extra `train` brings must
be missing, so that this shows what it says.
"""

import importlib.util
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

for module in ("jax", "mujoco", "matplotlib", "imageio", "PIL"):
    assert importlib.util.find_spec(module) is None, f"{module} is installed"

began = time.perf_counter()
import delayrl  # noqa: E402

print(f"import delayrl: {1e3 * (time.perf_counter() - began):.0f} ms")

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402

from delayrl.deploy import Controller, load_bundle  # noqa: E402


def delayrl_says(*words: str) -> tuple[int, str]:
    """Run the command; return its exit status and what it wrote."""
    done = subprocess.run([sys.executable, "-m", "delayrl", *words], capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


env = delayrl.AugmentedObservation(delayrl.Delayed(gymnasium.make("Pendulum-v1"), "uniform:1:3"))
obs, info = env.reset(seed=0)
for _ in range(5):
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
assert obs.shape == env.observation_space.shape
print("wrappers and delays: a delayed Pendulum-v1")

env = delayrl.make("Pendulum-v1", 2)
env.reset(seed=0)
print("make:", env.step(np.zeros(1, np.float32))[4]["age"], "step of age after one step")

status, text = delayrl_says("measure", "Pendulum-v1")
assert status == 0, text
print("measure:", text.strip().splitlines()[-1])

bundle = load_bundle(sys.argv[1], "numpy")
size, actions = bundle.metadata["observation"]["shape"][0], bundle.metadata["action"]["shape"][0]
longest = bundle.metadata["ages"][1]
action = bundle(np.zeros(size, np.float32), np.zeros((longest, actions), np.float32), longest)
assert action.shape == (actions,)
assert Controller
print("bundle:", bundle.metadata["agent"], "decides in NumPy")

for words in (
    ["train", "sac", "--env", "Pendulum-v1"],
    ["agents"],
    ["evaluate", "runs/nothing"],
    ["tasks"],
    ["measure", "HalfCheetah-v5"],
):
    status, text = delayrl_says(*words)
    assert (status, text.count("\n")) == (2, 1), text
    assert "pip install 'delayrl[train]'" in text, text
    print(f"{words[0]}: {text.strip()}")
try:
    delayrl.train("sac", env="Pendulum-v1")
except delayrl.DelayRLError as error:
    print("delayrl.train:", error)

packages = Path(sysconfig.get_path("purelib"))
pip = sum(
    file.stat().st_size for name in ("pip", "setuptools") for file in (packages / name).rglob("*") if file.is_file()
)
total = sum(file.stat().st_size for file in packages.rglob("*") if file.is_file()) - pip
print(f"installed: {total / 1e6:.0f} MB")
