"""Points 9 and 10: pictures, and small things.

Run with `workshop.py` in the folder, and without the package onnx; see `.ci/run`.
"""

import importlib.util
import subprocess
import sys
from pathlib import Path

import gymnasium
import imageio
import jax.numpy as jnp
import numpy as np
from trying import SHORT, holds, point, raises, refused, typed

import delayrl

point(9, "videos that show the robot")
typed(f"delayrl train late-ddpg --width 8 --batch-size 8 --env workshop:run_away --delay 1 --out near {SHORT}")
typed(f"delayrl train random --env workshop:run_away --delay 2 --out far {SHORT}")
line = typed("delayrl watch near --compare far --out two.mp4", "two.mp4: 15 steps", "; beside it 15 steps")
holds("nothing else is written, of OpenGL for example", line.count("\n") == 1, line)
*_, frame = imageio.v3.imiter("two.mp4")
for name, half in zip(("left", "right"), np.array_split(frame, 2, axis=1), strict=True):
    red, green, blue = half.astype(int).transpose(2, 0, 1)
    robot = int(((red > green) & (red - blue > 40)).sum())
    holds(f"the robot is in the {name} half of the last frame, 90 m from the start", robot > 1000, robot)
refused("delayrl watch near --out near.mp4 --camera top", "no camera 'top'; it has track")
refused("delayrl watch near --out near.avi", ".mp4 or .gif")

point(10, "small things")
typed("delayrl --version", f"delayrl {delayrl.__version__}")
WALK = "delayrl train bpql --env delayrl/Walk-v0 --delay 2 --preset small"
SCHEDULE = "--random_steps 100 --evaluate_every 100 --evaluation-episodes 2 --batch-size 8 --quiet"
typed(f"{WALK} --hidden 8,8 --steps 2e2 --replay_capacity 1_000 {SCHEDULE} --out numbers", "200 steps")
config = delayrl.Run("numbers").config
values = [config["schedule"]["steps"], config["schedule"]["replay_capacity"], config["hyperparameters"]["hidden"]]
holds("1e5, 1_000 and 8,8 are numbers", values == [200, 1000, [8, 8]], values)
refused(f"{WALK} --steps 1.5", "must be a whole number; got '1.5'")
refused(f"{WALK} --lr 3e-4", "did you mean --actor-learning-rate, --critic-learning-rate")
raises("delayrl.train(…, lr=3e-4)", lambda: delayrl.train("sac", "Pendulum-v1", lr=3e-4), "actor_learning_rate, critic")
PENDULUM = "delayrl train random --env Pendulum-v1 --preset small --steps 200 --evaluate-every 200 --random-steps 170"
typed(f"{PENDULUM} --delay 80 --out steps", "delay: 80 steps = 4 s")
typed(f"{PENDULUM} --delay 80ms --out times", "delay: 2 steps of 50 ms")
refused("delayrl train random --env delayrl/Walk-v0 --delay 80ms", "does not say how long a step is", "give steps")
refused("delayrl train bqpl --env delayrl/Walk-v0", "unknown agent 'bqpl'; did you mean bpql?")

push = np.random.default_rng(0).normal(size=500)
# a row's command acts in the row after it, so this observation is 2 steps late
lines = [f"{i / 100},{push[i]},{push[i - 7]},{push[i - 3]}" for i in range(500)]
Path("log.csv").write_text("\n".join(["time,q1_cmd,q1_cmd_filtered,q1", *lines, ""]))
typed("delayrl measure log.csv --commands q1_cmd --observations q1", "q1_cmd and q1\n", "in steps of 10 ms         2")


class InJAX(gymnasium.vector.SyncVectorEnv):
    """Gives arrays of another library, as vectors of PyTorch do."""

    def reset(self, **options):
        obs, info = super().reset(**options)
        return jnp.asarray(obs), info


envs = delayrl.DelayedVector(InJAX([lambda: gymnasium.make("Pendulum-v1")] * 2), 2)
raises("DelayedVector over arrays of another library", lambda: envs.reset(seed=0), "NumPy")
holds("the package onnx is not installed here", importlib.util.find_spec("onnx") is None)
typed(
    "delayrl export numbers --out numbers-bundle",
    "no policy.onnx",
    "onnx is not installed",
    "delayrl[deploy]",
    "ages 2..2",
)
files = sorted(file.name for file in Path("numbers-bundle").iterdir())
holds("the bundle is there without policy.onnx", files == ["bundle.json", "policy.safetensors"], files)
print("$ python ros2_node.py", flush=True)
done = subprocess.run([sys.executable, "ros2_node.py"], capture_output=True, text=True)
holds(
    "without ROS it says so in one line",
    done.returncode and done.stderr.count("\n") == 1 and "ROS 2" in done.stderr,
    done,
)
