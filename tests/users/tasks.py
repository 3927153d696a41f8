"""Points 1 to 4: any task. Run in a folder with `arm.py` and `workshop.py`; see `.ci/run`."""

from pathlib import Path

import gymnasium
import numpy as np
from arm import Arm, make
from gymnasium.wrappers import NormalizeObservation, TimeLimit
from trying import SHORT, holds, point, raises, ran, refused, typed

import delayrl

LIMIT = "gymnasium.wrappers:TimeLimit(max_episode_steps=100)"
SCHEDULE = {"preset": "small", "steps": 150, "random_steps": 50, "evaluate_every": 50, "evaluation_episodes": 2}

point(1, "a task of one's own, on the command line")
typed(f"delayrl train random --env arm:make --env-kwargs gain=0.2 --delay 80ms --out own {SHORT}", "arm:make(gain=0.2)")
typed("delayrl evaluate own --episodes 2", "random on arm:make(gain=0.2), delay 4")
typed("delayrl watch own --out own.gif", "own.gif: 100 steps")
typed("delayrl evaluate own --episodes 2 --env-kwargs gain=.3", "arm:make(gain=0.3)")
typed(
    f"delayrl evaluate own --episodes 2 --env 'arm:Arm | {LIMIT}'", "arm:Arm(gain=0.2) | gymnasium.wrappers:TimeLimit"
)
refused("delayrl evaluate own --env arm:Arm", "no time limit", "TimeLimit(max_episode_steps=1000)")
typed(f"delayrl train random --env workshop:Workshop/Arm-v0 --delay 4 --out id {SHORT}", "workshop:Workshop/Arm-v0")
typed("delayrl evaluate id --episodes 2", "random on workshop:Workshop/Arm-v0, delay 4")
typed(f"delayrl train random --env Pendulum-v1 --env_kwargs g=5 --delay 2 --out light {SHORT}", "Pendulum-v1(g=5)")
typed("delayrl measure arm:make --env-kwargs gain=0.2", "observation delay")
refused("delayrl train random --env arm:Arm", "no time limit", "gymnasium.wrappers:TimeLimit(max_episode_steps=1000)")
refused("delayrl train random --env arm:make --env-kwargs gian=2", "unexpected keyword argument 'gian'")
refused("delayrl train random --env arm:make --env-kwargs gain", "NAME=VALUE, e.g. gain=2")
refused("delayrl train random --env arm:mak", "did you mean make?")
refused("delayrl train random --env arm", "unknown task 'arm'", "MODULE:NAME")
refused("delayrl train random --env workshop:READY", "instance of Arm", "give its class, a function that makes it")
refused("delayrl train random --env workshop:same --quiet", "returned the same environment twice")

point(1, "a task of one's own, in Python")
for name, task in {
    "a class": Arm,
    "a function": make,
    "a spec": gymnasium.spec("Pendulum-v1"),
    "a text": "arm:make",
}.items():
    obs, info = delayrl.make(task, 3).reset(seed=0)
    holds(f"delayrl.make of {name}", info["actions"].shape == (3, 1), info)
env = delayrl.make(Arm, 4, env_kwargs={"gain": 2}, wrappers=[LIMIT])
holds("delayrl.make(Arm, 4, env_kwargs={'gain': 2}, wrappers=[…])", env.unwrapped.gain == 2, env.unwrapped.gain)
for name, wrong in {"an instance": make(), "an instance of an id": gymnasium.make("Pendulum-v1")}.items():
    raises(f"delayrl.train of {name}", lambda env=wrong: delayrl.train("random", env, 4), "give its class, a function")
    raises(f"delayrl.make of {name}", lambda env=wrong: delayrl.make(env, 4), "give its class, a function")

nameless = delayrl.train(
    "random", lambda gain: make(gain), 4, env_kwargs={"gain": 0.2}, progress=False, out="nameless", **SCHEDULE
)
holds(
    "a lambda trains, and its run has no name for it", nameless.config["env"] == "<lambda>(gain=0.2)", nameless.config
)
raises("delayrl.load(nameless)", lambda: delayrl.load(nameless), "<lambda> has no name", "give it again, as env")
result = delayrl.evaluate(nameless, 2, env=make)
holds("delayrl.evaluate(nameless, env=make)", result["env"] == "arm:make(gain=0.2)", result)
refused("delayrl evaluate nameless", "<lambda> has no name", "give it again")
typed("delayrl evaluate nameless --env arm:make --episodes 2", "random on arm:make(gain=0.2)")
again = delayrl.train("random", "arm:make", 4, env_kwargs={"gain": 0.2}, progress=False, out="own", **SCHEDULE)
holds("the call that says the same as the command gives back its run", len(again.rows()) == 6, again.rows())

point(2, "the ids of delayrl in Gymnasium")
MADE = "assert env.spec.id == 'delayrl/Ant-v4'; assert env.reset(seed=0)[0].shape == (27,)"
LATER = "import sys; assert not {'jax', 'mujoco'} & set(sys.modules), 'imported too early'"
ran(f"import delayrl; import gymnasium; {LATER}; env = gymnasium.make('delayrl/Ant-v4'); {MADE}")
ran(f"import gymnasium; import delayrl; {LATER}; env = gymnasium.make('delayrl/Ant-v4'); {MADE}")
ran(f"import gymnasium; env = gymnasium.make('delayrl:delayrl/Ant-v4'); {MADE}")
typed("delayrl measure delayrl:delayrl/Walk-v0 --episodes 2", "observation delay")

point(3, "the errors of one's own code")
Path("unplugged.py").write_text("import driver_of_the_arm\n")
Path("halved.py").write_text("ratio = 1 / 0\n")
for command in ("delayrl train random --env", "delayrl measure", "delayrl evaluate own --env"):
    refused(f"{command} workshop:Broken", "ValueError: the serial port is closed")
refused("delayrl train random --env unplugged:make", "ModuleNotFoundError: No module named 'driver_of_the_arm'")
refused("delayrl train random --env halved:make", "ZeroDivisionError: division by zero")
refused("delayrl train random --env nowhere:make", "No module named 'nowhere'")
refused("delayrl train random --env Pendulm-v1", "did you mean Pendulum-v1")

point(4, "nested observations and wrappers")
NESTED = f"--env workshop:Gripper --wrapper '{LIMIT}'"
refused(f"delayrl train random {NESTED} --delay 4", "Dict", "--flatten")
typed(f"delayrl train random {NESTED} --flatten --delay 4 --out nested {SHORT}", "| flatten, delay 4")
typed("delayrl evaluate nested --episodes 2", "workshop:Gripper | gymnasium.wrappers:TimeLimit")
env = delayrl.make("workshop:Gripper", 2, flatten=True)
obs, _ = env.reset(seed=0)  # closed as one of two, then the angle
angle = env.unwrapped.angle[0]
holds(
    "delayrl.make('workshop:Gripper', 2, flatten=True)",
    np.allclose(obs, [abs(angle) >= 0.1, abs(angle) < 0.1, angle]),
    obs,
)
typed(
    f"delayrl train random --env arm:make --wrapper 'workshop:Scaled(by=3)' --out scaled {SHORT}",
    "workshop:Scaled(by=3)",
)
plain, scaled = delayrl.make(make, 1), delayrl.make(make, 1, wrappers=["workshop:Scaled(by=3)"])
holds("the wrapper is there", np.allclose(3 * plain.reset(seed=0)[0], scaled.reset(seed=0)[0]))
refused("delayrl train random --env arm:make --wrapper workshop:Scale", "did you mean Scaled?")
refused("delayrl train random --env arm:make --wrapper Scaled", "module:Class")
env = delayrl.make(make, 4, normalise=True)
shown = [env.reset(seed=seed)[0] for seed in range(20)]
holds("delayrl.make(make, 4, normalise=True)", 0.5 < np.std(shown) < 2 and abs(np.mean(shown)) < 1, shown)
for outer in (NormalizeObservation, lambda env: TimeLimit(env, 20)):
    env = delayrl.AugmentedObservation(outer(delayrl.Delayed(gymnasium.make("Pendulum-v1"), 3)))
    vector, _ = env.reset(seed=0)
    holds(f"AugmentedObservation over {type(env.env).__name__}", vector.shape == (3 + 3 * 1 + 1,), vector)
