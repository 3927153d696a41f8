"""Collect runs of `examples/ppo_brax.py` into rows to commit, and write their table and picture in the docs.

`python benchmarks/ppo.py OUT [OUT …]` takes the folders of `--out`; without one, only table and picture are written.
"""

import argparse
import runpy
from collections import defaultdict
from pathlib import Path
from typing import Any

import jsonl
import numpy as np
from pages import HERE, insert

from delayrl.report.markup import markdown_table

ROWS = HERE / "results" / "ppo.jsonl"
VIEWS = ("blind", "augmented", "privileged")


def collect(folders: list[Path]) -> None:
    """Write the rows of run folders, after a line with the options of each task and the versions that made the rows."""
    rows = [row for folder in folders for row in jsonl.read(folder / "rows.jsonl")]
    options: dict[str, dict[str, Any]] = {}
    versions: list[dict[str, Any]] = []
    for row in rows:
        used = {name: value for name, value in row.pop("options").items() if name != "seed"}
        if used != options.setdefault(row["task"], used):
            raise SystemExit(f"{row['task']}: runs of other options are among these: {used} and {options[row['task']]}")
        if (made := row.pop("versions")) not in versions:
            versions.append(made)
    jsonl.write(ROWS, [{"options": options, "versions": versions}, *rows])


def table() -> str:
    """Return final returns and returns over training, means and standard deviations over seeds, as Markdown."""
    about, *rows = jsonl.read(ROWS)
    curves: dict[tuple[str, str, str], dict[int, dict[int, float]]] = defaultdict(lambda: defaultdict(dict))
    seconds: dict[str, dict[Any, float]] = defaultdict(dict)  # by task and run
    for row in rows:
        curves[row["task"], row["delay"], row["view"]][row["seed"]][row["step"]] = row["return"]
        seconds[row["task"]][row["delay"], row["view"], row["seed"]] = row["seconds"]
    body = []
    for task, delay, view in sorted(curves, key=lambda key: (key[0], key[1] != "0", VIEWS.index(key[2]))):
        seeds = [list(curve.values()) for curve in curves[task, delay, view].values()]
        last, mean = np.array([curve[-1] for curve in seeds]), np.array([np.mean(curve[1:]) for curve in seeds])
        steps = max(next(iter(curves[task, delay, view].values())))
        each = " · ".join(f"{value:,.0f}" for value in last)
        spread = [f"{x.mean():,.0f}" + (f" ± {x.std(ddof=1):,.0f}" if len(x) > 1 else "") for x in (last, mean)]
        kind = view if delay != "0" else "no delay"
        body.append([task, delay, f"{steps:,}", kind, *spread, each])
    took = ", ".join(f"{task} {np.median([*runs.values()]) / 60:.0f} min" for task, runs in sorted(seconds.items()))
    used = about["versions"][0]
    commits = ", ".join(sorted({made["commit"] for made in about["versions"]}))
    made = f"A run took, on a core (median): {took}. Made with brax {used['brax']}, jax {used['jax']}, "
    made += f"{used['cores']} x86 cores, commit {commits}. Rows: `benchmarks/results/ppo.jsonl`."
    table = markdown_table(["task", "delay", "steps", "PPO", "return", "mean over training", "each seed"], body)
    return f"{table}\n\nEach return is the mean of 128 episodes with deterministic actions. {made}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    given = parser.parse_args()
    if given.folders:
        collect(given.folders)
    draw = runpy.run_path(str(HERE.parent / "examples" / "ppo_brax.py"))["draw"]
    draw(jsonl.read(ROWS)[1:], HERE.parent / "docs/img/ppo.png")
    insert(HERE.parent / "docs" / "simulators.md", "ppo", table())
