"""Point 5: an agent and a law of one's own, of the package in `package/`; see `.ci/run`."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from arm import make
from late_ddpg import LateDDPG
from my_laws import Burst
from trying import holds, point, raises, refused, typed

import delayrl

LENGTH = {"preset": "small", "steps": 300, "random_steps": 100, "evaluate_every": 100, "evaluation_episodes": 2}
WORDS = (
    "--preset small --steps 300 --random-steps 100 --evaluate-every 100 --evaluation-episodes 2 --batch-size 8 --quiet"
)
LAW = "burst(length=3, rate=0.2, steps=3)"
SMALL = LateDDPG(width=16, batch_size=8)

point(5, "an agent and a law that an installed package declares")
typed("delayrl agents", "late-ddpg", "DDPG whose actor sees the augmented state")
typed("delayrl train late-ddpg --help", "--width", "units of each hidden layer", "--noise")
TRAIN = f"delayrl train late-ddpg --width 16 --env arm:make --delay 'burst(rate=0.2, steps=3)' {WORDS}"
typed(f"{TRAIN} --out package", f"late-ddpg on arm:make, delay {LAW}, seed 0: 300 steps")
typed(f"{TRAIN} --out package", "300 steps")  # a finished run says its summary again
typed("delayrl evaluate package --episodes 2", f"late-ddpg on arm:make, delay {LAW}")
typed("delayrl evaluate package --episodes 2 --delay 1", "delay 1")
typed(
    "delayrl evaluate package --episodes 2 --delay 'my_laws:Burst(rate=1, steps=2)'", "burst(length=3, rate=1, steps=2)"
)
typed("delayrl export package --out package-bundle", "late-ddpg on arm:make, ages 0..3")
typed("delayrl latency package-bundle --decisions 20", "numpy")
refused("delayrl evaluate package --delay 'burst(steps=4)'", "takes delays up to 3 steps; got 4; train with --delay 4")

point(5, "the same in Python; it is the same run")
rows = delayrl.Run("package").rows()
whole = delayrl.train(SMALL, make, Burst(rate=0.2, steps=3), progress=False, out="whole", **LENGTH)
holds("delayrl.train(LateDDPG(width=16), make, Burst(rate=0.2, steps=3))", whole.rows() == rows, whole.rows()[-1])
part = delayrl.train(
    SMALL, make, Burst(0.2, 3), progress=False, out="part", callback=lambda step, runs: step == 100, **LENGTH
)
holds("a callback stops it at step 100", part.curve().steps.tolist() == [100], part.curve())
typed(f"{TRAIN} --out part", "300 steps")
holds("the command resumes it, and it ends as if it had never stopped", part.rows() == rows, part.rows()[-1])
holds("delayrl.evaluate(run)", delayrl.evaluate(part, 2)["agent"] == "late-ddpg")

point(5, "module:object, for what no package declares")
typed(f"delayrl train workshop:WIDE --env arm:make --delay 2 {WORDS} --out wide", "on arm:make, delay 2")
holds("its width is that of the instance", delayrl.Run("wide").config["hyperparameters"]["width"] == 24)
typed("delayrl evaluate wide --episodes 2", "on arm:make, delay 2")
refused("delayrl train late_ddpg:LateDPG --env arm:make", "did you mean LateDDPG")
refused("delayrl train late_ddpg:q_value --env arm:make", "late_ddpg:q_value is no agent")
refused("delayrl train late-dpg --env arm:make", "did you mean late-ddpg")
refused("delayrl train late-ddpg --env arm:make --delay 'my_laws:Brust()'", "did you mean Burst")
refused("delayrl train late-ddpg --env arm:make --delay 'burst(rat=0.2)'", "unexpected keyword argument 'rat'")
raises("delayrl.make(make, Burst)", lambda: delayrl.make(make, Burst), "a law is an instance: give Burst(…)")


@dataclass(frozen=True)
class Here(LateDDPG):
    """An agent of this script, which no run can name."""


run = delayrl.train(Here(16, batch_size=8), make, 2, progress=False, out="here", **LENGTH)
raises("delayrl.load(run) of an agent of this script", lambda: delayrl.load(run), "<Here> has no name", "as agent")
holds("delayrl.load(run, agent=Here)", delayrl.load(run, agent=Here).agent == replace(Here(16), batch_size=8))
typed("delayrl evaluate here --agent late_ddpg:LateDDPG --episodes 2", "arm:make, delay 2")

point(5, "a grid of own agents, tasks and laws")
Path("mine.toml").write_text("""
agents = ["late-ddpg", "random"]
tasks = ["arm:make"]
delays = ["my_laws:Burst(rate=0.2, steps=3)"]
env_kwargs = { gain = 0.2 }
wrappers = ["workshop:Scaled"]
preset = "small"
[overrides]
steps = 300
random_steps = 100
evaluate_every = 100
evaluation_episodes = 2
batch_size = 8 # random has none, and is let alone
[overrides.late-ddpg]
width = 16
""")
typed(
    "delayrl bench plan mine.toml", f"late-ddpg on arm:make(gain=0.2) | workshop:Scaled, delay {LAW}", "2 cells, 2 runs"
)
typed("delayrl bench run mine.toml --workers 1", "2 of 2 cells done")
typed("delayrl bench status mine.toml", "late-ddpg", "done")
typed("delayrl bench collect mine.toml", "2 of 2 cells are done")
typed("delayrl bench report mine.toml --out report", "open report")
report = "".join(file.read_text() for file in Path("report").glob("*.md"))
holds("its report", all(words in report for words in ("late-ddpg", "arm:make(gain=0.2)", "burst(")), report)
typed("delayrl runs .", "late-ddpg", "random", LAW)

point(5, "a run folder that came with code of its own")
trap = delayrl.Run(shutil.copytree("package", "downloaded"))
Path("downloaded/trap.py").write_text("open('caught', 'w')")
for name, value in {"agent": "Agent", "env": "make", "delay": "Law(steps=3)"}.items():
    trap.path.mkdir(exist_ok=True)
    (trap.path / "config.json").write_text(json.dumps(whole.config | {name: f"downloaded.trap:{value}"}))
    for command in ("evaluate downloaded", "export downloaded --out b", "train downloaded --steps 400"):
        refused(f"delayrl {command}", "downloaded came with", "could run any code, downloaded.trap:")
holds("its module was not imported", not Path("caught").exists())
