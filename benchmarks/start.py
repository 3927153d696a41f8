"""Measure the time from starting `delayrl train` to its first learned step, compiling or compiled before.

`python benchmarks/start.py` writes rows and the table in docs/performance.md; `--table` only the table, `--only AGENT`
rows of that agent. The ways alternate, so that other work on the machine meets both.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import blocks
import numpy as np
from pages import HERE, insert

from delayrl.report.markup import markdown_table

ROWS = HERE / "results" / "start.jsonl"
NAMES = ("agent", "delay", "preset")
WORKS = [
    ("sac", 0, "small"),
    ("bpql", 25, "small"),
    ("any-age", 25, "small"),
    ("vdpo", 5, "small"),
    ("vdpo", 5, "paper"),
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


def seconds(agent: str, delay: int, preset: str, home: Path, kept: bool) -> float:
    """Start a run, and stop it once it has learned from its first step. Returns the time until then."""
    words = ["train", agent, "--env", "HalfCheetah-v5", "--delay", str(delay), "--preset", preset, "--overwrite"]
    words += [
        "--random-steps",
        "200",
        "--update-after",
        "200",
        "--steps",
        "2000",
        "--replay-capacity",
        "20000",
        "--quiet",
    ]
    variables = os.environ | {"XDG_CACHE_HOME": str(home), "JAX_ENABLE_COMPILATION_CACHE": str(int(kept))}
    began = time.perf_counter()
    command = [sys.executable, "-c", CHILD, *words, "--out", str(home / "run")]
    with subprocess.Popen(command, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        line = child.stdout.readline()
        took = time.perf_counter() - began
        child.kill()
    if line != "learned\n":
        raise RuntimeError(f"{agent} did not learn: {line!r}")
    return took


def measure(works: list[tuple[str, int, str]], rounds: int) -> None:
    """Measure works in turn and write their rows."""
    from delayrl.run.provenance import versions

    rows = []
    for agent, delay, preset in works:
        with tempfile.TemporaryDirectory() as home:
            seconds(agent, delay, preset, Path(home), kept=True)  # compiles
            for number in range(rounds):
                for kept in (False, True):
                    took = seconds(agent, delay, preset, Path(home), kept)
                    rows.append(
                        {
                            "agent": agent,
                            "delay": delay,
                            "preset": preset,
                            "round": number,
                            "kept": kept,
                            "seconds": took,
                        }
                    )
                    print(rows[-1], flush=True)
            size = sum(file.stat().st_size for file in Path(home, "delayrl").rglob("*") if file.is_file())
            rows[-1]["bytes"] = size
    blocks.replace(ROWS, {"versions": versions()}, rows, NAMES)


def table() -> str:
    """Return the medians as Markdown, and how each line was measured."""
    lines, notes = [], []
    for about, rows in blocks.read(ROWS):
        works = dict.fromkeys(tuple(row[name] for name in NAMES) for row in rows)
        for work in works:
            own = [row for row in rows if tuple(row[name] for name in NAMES) == work]
            medians = [np.median([row["seconds"] for row in own if row["kept"] is kept]) for kept in (False, True)]
            size = next(row["bytes"] for row in own if "bytes" in row)
            lines.append([f"`{work[0]}`", work[1], f"`{work[2]}`", *(f"{m:.1f}" for m in medians), f"{size / 1e6:.1f}"])
        agents = ", ".join(dict.fromkeys(f"`{agent}`" for agent, *_ in works))
        used = about["versions"]
        words = f"{1 + max(row['round'] for row in rows)} rounds, {used['cores']} x86 cores, Python {used['python']}"
        notes.append(f"{agents}: {words}, jax {used['jax']}, commit {used['commit']}.")
    table = markdown_table(["agent", "Δ", "preset", "compiling, s", "compiled before, s", "kept, MB"], lines)
    return f"{table}\n\nMedians, HalfCheetah-v5. {' '.join(notes)} Rows: `benchmarks/results/start.jsonl`."


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--table", action="store_true", help="write the table alone")
    parser.add_argument("--only", metavar="AGENT", choices=sorted({agent for agent, *_ in WORKS}))
    given = parser.parse_args()
    if not given.table:
        measure([work for work in WORKS if given.only in (None, work[0])], given.rounds)
    insert(HERE.parent / "docs" / "performance.md", "start", table())
