"""Measure how many seed-steps a second this machine trains, by processes and seeds: `python benchmarks/machines.py`.

One process has all cores; of several, each has one, as in `delayrl bench run`. They train their seeds in lockstep, and
all of them learn while the clock runs. Writes rows and the table in docs/performance.md; `--table` only the table,
`--only AGENT` rows of that agent.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import jsonl
import numpy as np
import trainings
from pages import HERE, insert
from trainings import Work

from delayrl.report.markup import markdown_table

ROWS = HERE / "results" / "machines.jsonl"
WORKS = [Work("sac", 0, "small"), Work("vdpo", 5, "small"), Work("vdpo", 25, "small"), Work("any-age", 25, "small")]
SEEDS = (1, 4, 8)
WARM, RANDOM = 300, 1000  # learned steps before the clock runs, and random ones before these
CHILD = """
import os, sys, time
settings, words = [int(x) for x in sys.argv[1].split(",")], sys.argv[2:]
first, seconds, cores = settings[0], settings[1], settings[2:]
os.sched_setaffinity(0, cores)
import jax
from delayrl.cli.main import main
from delayrl.training.loop import Loop
step, began = Loop.step, None
def timed(self):
    global began
    step(self)
    if self.state.step == first:
        jax.block_until_ready(self.state.learner)
        print("ready", flush=True)
        sys.stdin.readline()
        began = time.perf_counter()
    if began is not None and time.perf_counter() - began > seconds:
        jax.block_until_ready(self.state.learner)
        print((self.state.step - first) / (time.perf_counter() - began), flush=True)
        os._exit(0)
Loop.step = timed
main(words)
"""


def speed(work: Work, shares: list[list[int]], seeds: int, seconds: int, home: Path) -> float:
    """Return the seed-steps a second of processes that learn side by side, each on its share of the cores."""
    words = [*trainings.words(work, 200_000, RANDOM), "--evaluate-every", "200000", "--seeds", str(seeds)]
    children = []
    for number, share in enumerate(shares):
        settings = ",".join(map(str, [RANDOM + WARM, seconds, *share]))
        command = [sys.executable, "-c", CHILD, settings, *words, "--out", str(home / f"run{number}-{seeds}")]
        children.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    for child in children:
        if child.stdout.readline() != "ready\n":
            raise RuntimeError(f"{work.agent} did not learn")
    for child in children:
        child.stdin.write("go\n")
        child.stdin.flush()
    return seeds * sum(float(child.communicate()[0]) for child in children)


def measure(works: list[Work], rounds: int, seconds: int) -> None:
    """Measure works in turn and write their rows."""
    from delayrl.run.provenance import versions

    available = sorted(os.sched_getaffinity(0))
    ways = [(processes, seeds) for processes in sorted({1, len(available)}) for seeds in SEEDS]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as home:
        for number in range(rounds):
            for work in works:
                for processes, seeds in ways:
                    size = len(available) // processes
                    shares = [available[i * size : (i + 1) * size] for i in range(processes)]
                    found = speed(work, shares, seeds, seconds, Path(home))
                    way = {"processes": processes, "seeds": seeds, "round": number}
                    rows.append(work._asdict() | way | {"speed": found})
                    print(rows[-1], flush=True)
    about = {"versions": versions(), "seconds": seconds}
    jsonl.replace(ROWS, about, rows, Work._fields)


def table() -> str:
    """Return the medians as Markdown, the best of each line in bold, and how each line was measured."""
    measured = jsonl.blocks(ROWS)
    ways = list(dict.fromkeys((row["processes"], row["seeds"]) for _, rows in measured for row in rows))
    heads = [f"{processes} × {seeds}" for processes, seeds in ways]
    lines, notes = [], []
    for about, rows in measured:
        agents = dict.fromkeys(row["agent"] for row in rows)
        for agent, delay in dict.fromkeys((row["agent"], row["delay"]) for row in rows):
            own = [row for row in rows if (row["agent"], row["delay"]) == (agent, delay)]
            by_way = [[row["speed"] for row in own if (row["processes"], row["seeds"]) == way] for way in ways]
            medians = [np.median(speeds) for speeds in by_way]
            cells = [f"**{m:,.0f}**" if m == max(medians) else f"{m:,.0f}" for m in medians]
            lines.append([f"`{agent}`", delay, *cells])
        rounds = 1 + max(row["round"] for row in rows)
        used = about["versions"]
        words = f"{rounds} rounds of {about['seconds']} s, {used['cores']} x86 cores, jax {used['jax']}"
        notes.append(f"{', '.join(f'`{agent}`' for agent in agents)}: {words}, commit {used['commit']}.")
    words = (
        "Seed-steps a second, processes × seeds of each; medians of rounds of learning, HalfCheetah-v5, preset `small`."
    )
    words += f" {' '.join(notes)} Rows: `benchmarks/results/machines.jsonl`."
    return f"{markdown_table(['agent', 'Δ', *heads], lines)}\n\n{words}"


if __name__ == "__main__":
    parser = trainings.parser(__doc__, WORKS)
    parser.add_argument("--seconds", type=int, default=10)
    given = parser.parse_args()
    if not given.table:
        measure([work for work in WORKS if given.only in (None, work.agent)], given.rounds, given.seconds)
    insert(HERE.parent / "docs" / "performance.md", "machines", table())
