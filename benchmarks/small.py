"""Train every agent on a small task, three seeds in lockstep: `python benchmarks/small.py TASK [AGENT …]`.

Runs are stored below runs/small/TASK; the same command resumes them. The rows of all complete runs there are then
collected into benchmarks/results/TASK.jsonl, with 20 episodes on start states that the run never saw.
"""

import argparse
from pathlib import Path
from typing import Any

from collect import collect

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.errors import DelayRLError
from delayrl.run.folder import RunFolder

SMALL_NETWORKS = {"hidden": [64, 64], "batch_size": 64}
TASKS: dict[str, dict[str, Any]] = {
    "pendulum": {"env": "InvertedPendulum-v5", "delay": 5},
    "reacher": {"env": "Reacher-v5", "delay": 5, "steps": 10_000, "evaluate_every": 2_000},
    "walk": {"env": "delayrl/Walk-v0", "delay": 4, "steps": 6_000, "evaluate_every": 1_000},
    "walk-random": {"env": "delayrl/Walk-v0", "delay": "uniform:1:4", "steps": 6_000, "evaluate_every": 1_000},
    "pusher-random": {"env": "delayrl/Pusher-v4", "delay": "paper-stochastic-5"},
}
OWN: dict[tuple[str, str], dict[str, Any]] = {
    ("reacher", "dida"): {"expert_steps": 7_000},
    ("walk", "dida"): {"expert_steps": 4_000, "hidden": [64, 64]},
    ("reacher", "lifting"): {"lifting_hold": 2_500, "lifting_end": 7_500},
    ("walk", "lifting"): {"lifting_hold": 1_500, "lifting_end": 4_500},
    ("walk", "vdpo"): {"width": 32, "layers": 1},
}


def main() -> None:
    """Train the agents that the command line names, then collect all complete runs of the task."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=list(TASKS))
    parser.add_argument("agents", nargs="*", default=list(AGENTS))
    given = parser.parse_args()
    options, kind = TASKS[given.task], given.task.removesuffix("-random")
    for agent in given.agents:
        networks = SMALL_NETWORKS if kind == "walk" and agent != "random" else {}
        values = options | networks | OWN.get((kind, agent), {}) | ({"delay": 0} if agent == "sac" else {})
        out = Path("runs/small") / given.task / agent
        delayrl.train(agent, preset="small", seeds=3, out=out, progress=False, **values)
        print(f"{agent}: done", flush=True)
    complete = complete_runs(Path("runs/small", given.task))
    collect(Path(__file__).parent / "results" / f"{given.task}.jsonl", complete, 20, every_delay=kind != given.task)


def complete_runs(folder: Path) -> list[Path]:
    """Return the runs of a task that have ended."""
    return [path for path in sorted(folder.glob("*/seed*")) if is_complete(path)]


def is_complete(path: Path) -> bool:
    """Tell whether a run has ended. One without an intact checkpoint, such as one that was killed early, has not."""
    try:
        return RunFolder(path).latest().complete
    except DelayRLError as error:
        print(f"left out: {error}", flush=True)
        return False


if __name__ == "__main__":
    main()
