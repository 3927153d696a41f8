"""Measure the time from starting `delayrl train` to its first learned step, compiling or compiled before.

`python benchmarks/start.py` writes rows and the table in docs/performance.md; `--table` only the table, `--only AGENT`
rows of that agent. The ways alternate, so that other work on the machine meets both.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import jsonl
import numpy as np
import trainings
from pages import HERE, insert
from trainings import Work

from delayrl.report.markup import markdown_table

ROWS = HERE / "results" / "start.jsonl"
WORKS = [
    Work("sac", 0, "small"),
    Work("bpql", 25, "small"),
    Work("any-age", 25, "small"),
    Work("vdpo", 5, "small"),
    Work("vdpo", 5, "paper"),
]
CHILD = """
import sys, jax
from delayrl.cli.main import main
from delayrl.training.learner import Program
learn = Program.learn
def first(*args):
    result = learn(*args)
    if result[-1]:
        jax.block_until_ready(result[0])
        print("learned", flush=True)
        sys.stdin.read()
    return result
Program.learn = first
main(sys.argv[1:])
"""


def seconds(work: Work, home: Path, kept: bool) -> float:
    """Start a run, and stop it once it has learned from its first step. Returns the time until then."""
    variables = os.environ | {"XDG_CACHE_HOME": str(home), "JAX_ENABLE_COMPILATION_CACHE": str(int(kept))}
    began = time.perf_counter()
    command = [sys.executable, "-c", CHILD, *trainings.words(work, 2_000, 200), "--out", str(home / "run")]
    with subprocess.Popen(command, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        line = child.stdout.readline()
        took = time.perf_counter() - began
        child.kill()
    if line != "learned\n":
        raise RuntimeError(f"{work.agent} did not learn: {line!r}")
    return took


def measure(works: list[Work], rounds: int) -> None:
    """Measure works in turn and write their rows."""
    from delayrl.run.provenance import versions

    rows: list[dict[str, Any]] = []
    for work in works:
        with tempfile.TemporaryDirectory() as home:
            seconds(work, Path(home), kept=True)  # compiles
            for number in range(rounds):
                for kept in (False, True):
                    took = seconds(work, Path(home), kept)
                    rows.append(work._asdict() | {"round": number, "kept": kept, "seconds": took})
                    print(rows[-1], flush=True)
            size = sum(file.stat().st_size for file in Path(home, "delayrl").rglob("*") if file.is_file())
            rows[-1]["bytes"] = size
    jsonl.replace(ROWS, {"versions": versions()}, rows, Work._fields)


def table() -> str:
    """Return the medians as Markdown, and how each line was measured."""
    lines, notes = [], []
    for about, rows in jsonl.blocks(ROWS):
        works: dict[Work, list[dict[str, Any]]] = defaultdict(list)
        for row in rows:
            works[Work(*(row[name] for name in Work._fields))].append(row)
        for work, own in works.items():
            medians = [np.median([row["seconds"] for row in own if row["kept"] is kept]) for kept in (False, True)]
            size = next(row["bytes"] for row in own if "bytes" in row)
            cells = [f"`{work.agent}`", work.delay, f"`{work.preset}`", *(f"{m:.1f}" for m in medians)]
            lines.append([*cells, f"{size / 1e6:.1f}"])
        agents = ", ".join(dict.fromkeys(f"`{work.agent}`" for work in works))
        used = about["versions"]
        words = f"{1 + max(row['round'] for row in rows)} rounds, {used['cores']} x86 cores, Python {used['python']}"
        notes.append(f"{agents}: {words}, jax {used['jax']}, commit {used['commit']}.")
    table = markdown_table(["agent", "Δ", "preset", "compiling, s", "compiled before, s", "kept, MB"], lines)
    return f"{table}\n\nMedians, HalfCheetah-v5. {' '.join(notes)} Rows: `benchmarks/results/start.jsonl`."


if __name__ == "__main__":
    given = trainings.parser(__doc__, WORKS).parse_args()
    if not given.table:
        measure([work for work in WORKS if given.only in (None, work.agent)], given.rounds)
    insert(HERE.parent / "docs" / "performance.md", "start", table())
