"""`delayrl runs [DIR]`: list the runs in a folder."""

import argparse
import json
from pathlib import Path

from delayrl.cli.console import print_table


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the folder."""
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs"), help="where to look (default: runs)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(given: argparse.Namespace) -> None:
    """Print what each run trains, how far it is, and its last return."""
    from delayrl.play.run import runs

    names = ("agent", "preset", "env", "delay", "seed")
    rows = []
    for one in runs(given.folder):
        config, curve = one.config, one.curve()
        done, steps = (int(curve.steps[-1]) if len(curve.steps) else 0), config["schedule"].get("steps", 0)
        last = float(curve.returns[-1].mean()) if done else None
        columns = {name: config.get(name) for name in names}
        rows.append({**columns, "step": done, "steps": steps, "return": last, "run": str(one.path)})
    if given.json:
        print(json.dumps(rows))
        return
    if not rows:
        print(f"no runs in {given.folder}; `delayrl train` makes one")
        return
    table = [
        [
            *(row[name] for name in names),
            f"{row['step']:,}" if row["step"] >= row["steps"] else f"{row['step']:,} of {row['steps']:,}",
            "-" if row["return"] is None else f"{row['return']:,.1f}",
            row["run"],
        ]
        for row in rows
    ]
    print_table([*names, "steps", "return", "run"], table)
