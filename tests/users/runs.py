"""Points 6 to 8: what is done with runs. Run in a folder with `arm.py` and `workshop.py`; see `.ci/run`."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio
from trying import holds, point, raises, refused, typed

import delayrl

WORDS = "--preset small --random-steps 100 --evaluate-every 100 --evaluation-episodes 2 --hidden 8,8 --batch-size 8"
WALK = f"delayrl train bpql --env delayrl/Walk-v0 --delay 2 {WORDS}"

point(6, "going on")
typed(f"{WALK} --steps 200 --out first", "200 steps")
typed("delayrl train first --steps 300 --quiet", "300 steps")
typed(f"{WALK} --steps 300 --out whole --quiet")
first, whole = delayrl.Run("first"), delayrl.Run("whole")
returns = [[row["return"] for row in run.rows()] for run in (first, whole)]
holds("200 steps and 100 more give what 300 give", returns[0] == returns[1] and len(returns[0]) == 6, returns)
again = delayrl.go_on("first", 400, progress=False)
holds("delayrl.go_on(run, 400)", again.curve().steps.tolist() == [100, 200, 300, 400], again.curve())
refused("delayrl train first --steps 300", "first has 400 steps", "give more than that: got 300")
refused("delayrl train first", "--steps")
refused("delayrl train runs/nowhere --steps 300", "there is no run folder runs/nowhere", "`delayrl runs`")
typed(f"{WALK} --steps 200 --slim --out slim --quiet")
holds("--slim drops the replay", not Path("slim/replay").exists() and Path("first/replay").exists())
refused("delayrl train slim --steps 300", "--slim", "--from slim starts a new run with its networks")
other = f"delayrl train bpql --env delayrl/Walk-v0 --delay 3 --steps 200 {WORDS}"
typed(f"{other} --from slim --out other", "taken over: critic, target, log_temperature; new: actor, and the optimisers")
refused(f"{other} --from nowhere --out b", "nowhere is not a run folder")

point(7, "runs in Python")
run = delayrl.Run("first")
steps, played = run.curve()
holds("run.curve()", (steps.shape, played.shape) == ((4,), (4, 2)), run.curve())
holds("run.config", (run.config["agent"], run.config["delay"], run.config["seed"]) == ("bpql", 2, 0), run.config)
holds("run.rows()", [row["return"] for row in run.rows()] == played.flatten().tolist(), run.rows())
episodes = run.episodes()
holds("run.episodes(), of 50 steps each", [row["length"] for row in episodes] == [50] * 8, episodes)
policy = run.policy()
env = delayrl.make("delayrl/Walk-v0", 2)
obs, info = env.reset(seed=0)
action = policy.act(obs, info)
holds("run.policy().act(obs, info)", action.shape == (1,), action)
holds("delayrl.load(run) is the same", delayrl.load(run).act(obs, info) == action)
result = delayrl.evaluate(run, 2)
holds("delayrl.evaluate(run, 2)", len(result["returns"]) == 2, result)
same = delayrl.evaluate(policy, 2)["returns"]
holds("delayrl.evaluate(policy, 2)", same == result["returns"] == delayrl.evaluate("first", 2)["returns"], same)
raises("delayrl.evaluate(policy, agent=…)", lambda: delayrl.evaluate(policy, agent="bpql"), "leave agent out")
holds("delayrl.runs('.')", [one.path.name for one in delayrl.runs(".")] == ["first", "other", "slim", "whole"])
small = {"preset": "small", "random_steps": 100, "evaluate_every": 100, "evaluation_episodes": 2, "progress": False}
TINY = {**small, "hidden": [8, 8], "batch_size": 8}
pair = delayrl.train("bpql", "delayrl/Walk-v0", 2, seeds=[0, 1], steps=200, out="pair", **TINY)
holds("delayrl.train(…, seeds=[0, 1])", [one.config["seed"] for one in pair] == [0, 1], pair)
raises("delayrl.train(…, stpes=3)", lambda: delayrl.train("bpql", "delayrl/Walk-v0", 2, stpes=3), "did you mean steps")
seen = []


def stop(step, runs):
    seen.append((step, len(runs[0].rows())))
    return step == 200


delayrl.train("bpql", "delayrl/Walk-v0", 2, steps=400, out="stopped", callback=stop, **TINY)
holds("a callback is called at each evaluation, and stops the run", seen == [(100, 2), (200, 4)], seen)
typed("delayrl runs .", "bpql", "200 of 400", "first", "stopped", "pair/seed1")
rows = json.loads(typed("delayrl runs . --json"))
holds("delayrl runs --json", len(rows) == 7 and rows[0]["return"] == played[-1].mean(), rows)
text = typed(
    "delayrl compare first other pair --out three.png", "delay    2", "pair (2 seeds)", "95 % bootstrap interval"
)
holds("what is the same in all is not printed", "batch_size" not in text and "hidden" not in text, text)
holds("both curves are drawn", imageio.v3.imread("three.png").std() > 1)
refused("delayrl compare first", "two to 8 runs; got 1")

point(8, "presets that follow the budget")
command = "lifting --env delayrl/Walk-v0 --delay 2 --preset small --steps 100000 --out long --quiet"
print(f"$ delayrl train {command}, and Ctrl-C", flush=True)
delayrl_program = Path(sys.executable).with_name("delayrl")
process = subprocess.Popen([delayrl_program, "train", *command.split()], stderr=subprocess.PIPE, text=True)
while process.poll() is None and not Path("long/metrics.jsonl").exists():  # written at step 1,000
    time.sleep(0.1)
process.send_signal(signal.SIGINT)
line = process.communicate()[1]
holds("it stops at a checkpoint", "stopped at step" in line and "goes on from there" in line, line)
config = delayrl.Run("long").config
values = {**config["hyperparameters"], **config["schedule"]}
shares = {name: values[name] / 100_000 for name in ("lifting_hold", "lifting_end", "random_steps")}
holds("lifting ends at 3/4 of the run, whatever its length", shares["lifting_end"] > 0.7, shares)
holds("the replay holds all of it", values["replay_capacity"] >= 100_000, values)
refused("delayrl train a-sac --env delayrl/Walk-v0 --steps 1500", "nothing would be learned", "preset small")
typed("delayrl train bpql --env delayrl/Walk-v0 --delay 2 --steps 2000 --quiet --out paper --batch-size 8 --hidden 8,8")
holds(
    "bpql of preset paper learns in its first 2,000 steps, all random",
    "critic_loss" in delayrl.Run("paper").metrics()[-1],
)
