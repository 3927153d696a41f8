"""Collect runs into one file of rows to commit: `python benchmarks/collect.py OUT.jsonl RUN [RUN …]`.

Each run takes one line with its configuration and versions, then one line for each evaluation episode. `--episodes N`
adds N episodes on start states that the run never saw (`delayrl evaluate`).
"""

import argparse
from pathlib import Path

import jsonl

from delayrl.play.evaluation import evaluate, sweep
from delayrl.play.run import Run
from delayrl.run.rows import EPISODE


def collect(out: Path, runs: list[Path], episodes: int = 0, every_delay: bool = False) -> None:
    """Write the rows of run folders into one file, with new evaluations if `episodes` is not 0."""
    lines = []
    for number, path in enumerate(runs):
        run = Run(path)
        metrics = run.metrics()
        speed = metrics[-1]["steps_per_second"] if metrics else None
        lines.append({"run": number, "config": run.config, "steps_per_second": speed})
        lines += [{"run": number} | {name: row[name] for name in EPISODE} for row in run.rows()]
        if episodes:
            lines.append({"run": number, "evaluation": evaluate(path, episodes, seed=run.config["seed"])})
        if episodes and every_delay:
            lines += [{"run": number, "sweep": result} for result in sweep(path, episodes, seed=run.config["seed"])]
    out.parent.mkdir(parents=True, exist_ok=True)
    jsonl.write(out, lines)


def main() -> None:
    """Collect the runs that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--episodes", type=int, default=0, help="also evaluate on this many unseen start states")
    parser.add_argument("--every-delay", action="store_true", help="also evaluate at every delay the policy serves")
    given = parser.parse_args()
    collect(given.out, given.runs, given.episodes, given.every_delay)


if __name__ == "__main__":
    main()
