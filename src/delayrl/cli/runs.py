"""`delayrl runs [DIR]`: list the runs in a folder."""

import argparse
import json
from pathlib import Path
from typing import Any

from delayrl.cli.console import print_table
from delayrl.errors import DelayRLError
from delayrl.play.run import Run, runs
from delayrl.run.checkpoint import checkpoint_folders
from delayrl.run.rows import number_in_words

NAMES = ("agent", "preset", "env", "delay", "seed")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the folder."""
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs"), help="where to look (default: runs)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(given: argparse.Namespace) -> None:
    """Print what each run trains, how far it is, and its last return; of one that cannot be read why."""
    rows = [_row(one) for one in runs(given.folder)]
    if given.json:
        print(json.dumps(rows))
        return
    if not rows:
        print(f"no runs in {given.folder}; `delayrl train` makes one")
        return
    print_table([*NAMES, "steps", "return", "run"], [_cells(row) for row in rows])


def _row(run: Run) -> dict[str, Any]:
    """Return the columns of a run; `error` is the line that says why it cannot be read."""
    row: dict[str, Any] = dict.fromkeys((*NAMES, "step", "steps", "return")) | {"run": str(run.path), "error": None}
    try:
        config, curve, stored = run.config, run.curve(), checkpoint_folders(run.path)
    except DelayRLError as error:
        return row | {"error": str(error)}
    evaluated = max(curve.steps, default=0)
    step = max([int(evaluated), *(int(folder.name) for folder in stored)])
    last = float(curve.returns[-1].mean()) if evaluated else None
    columns = {name: config.get(name) for name in NAMES} | {"delay": run.delay}
    return row | columns | {"step": step, "steps": config["schedule"]["steps"], "return": last}


def _cells(row: dict[str, Any]) -> list[Any]:
    if row["error"]:
        return [*["-"] * (len(NAMES) + 2), row["error"]]  # which names the folder
    steps = f"{row['step']:,}" if row["step"] >= row["steps"] else f"{row['step']:,} of {row['steps']:,}"
    last = "-" if row["return"] is None else number_in_words(row["return"])
    return [*(row[name] for name in NAMES), steps, last, row["run"]]
