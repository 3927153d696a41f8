"""Lost episodes: how often policies fall, from the evaluations of HalfCheetah in the second half of training.

A robot on its back creeps on at a fraction of its return, so a mean can hide two kinds of episodes.
"""

import contextlib
import json
import sqlite3
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from front import COLOURS, STEPS, in_words
from ladder import rows_of
from matplotlib import pyplot

from delayrl.bench.results import read_table
from delayrl.report.markdown import markdown_table
from delayrl.run.cell import Cell

ENV = "HalfCheetah-v5"
DRAWN = 25
"""The delay of the picture's policies."""
LOST = 0.7
"""An episode is lost if it returns less than this part of the best of its evaluation, both above a random policy's."""
HEAD = ("Δ", "policy", "seeds", "mean return", "lost episodes", "mean of the others", "change")
CHANCE = "random"
QUERY = """
SELECT cells.id, cells.cell, json_extract(shared, '$.privileged'), seed, policy, rows.step, rows.return
FROM rows JOIN runs ON rows.run = runs.id JOIN cells ON cells.id = runs.cell
WHERE state = 'done' AND json_extract(cells.cell, '$.env') = ? ORDER BY rows.step, episode
"""

Runs = dict[int, dict[int, list[float]]]
"""Returns of the episodes, by seed and step."""


def section(files: list[Path], picture: Path) -> str:
    """Draw episodes; return the table, with where its rows are. Of a policy in two files, each seed counts once."""
    known: dict[tuple[int, str], Runs] = defaultdict(dict)
    for file in files:
        for policy, runs in episodes(file).items():
            known[policy] |= runs
    draw({words: known[DRAWN, words] for words in COLOURS if (DRAWN, words) in known}, picture)
    chance = [x for evaluations in known.pop((0, CHANCE)).values() for x in evaluations[max(evaluations)]]
    lines = [(delay, words, runs, measure(runs, float(np.mean(chance)))) for (delay, words), runs in known.items()]
    lines.sort(key=lambda line: (line[0], -line[3].mean))
    body = [[str(delay), words, str(len(runs)), *found.cells] for delay, words, runs, found in lines]
    return f"{markdown_table(HEAD, body)}\n\n{rows_of(files, [read_table(file) for file in files])}"


def episodes(file: Path) -> dict[tuple[int, str], Runs]:
    """Return what the policies of the first page's table returned, by delay and name, from the cells that have ended.

    A reference, which is evaluated without delay, stands at the delay of the policy that is cloned from it.
    """
    known: dict[tuple[int, str], Runs] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    with contextlib.closing(sqlite3.connect(file)) as rows:
        for id, cell, privileged, seed, policy, step, value in rows.execute(QUERY, (ENV,)):
            condition = Cell.from_json(json.loads(cell), id).condition
            words = CHANCE if condition.agent == CHANCE else in_words(condition, bool(privileged))
            alike = condition.preset == "matched" and condition.steps == STEPS[ENV]
            if isinstance(condition.delay, int) and (words == CHANCE or (words in COLOURS and alike)):
                words += ", its reference without delay" if policy == "reference" else ""
                known[condition.delay, words][seed][step].append(value)
    return known


def draw(policies: dict[str, Runs], out: Path) -> None:
    """Draw a panel for each policy: a dot for the return of each episode, in one colour for each seed."""
    rows = -(-len(policies) // 3)
    shape = {"figsize": (10, 3 * rows), "sharex": True, "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, panels = pyplot.subplots(rows, 3, **shape)
    for axes, (words, runs) in zip(panels.flat, policies.items(), strict=False):
        for number, run in enumerate(runs.values()):
            steps = np.repeat([step / 1000 for step in run], [len(x) for x in run.values()])
            axes.plot(steps, np.concatenate([*run.values()]), ".", color=f"C{number % 10}", markersize=3, alpha=0.5)
        axes.set_title(words.replace("`", ""), fontsize=10)
        axes.grid(alpha=0.25)
    for axes in panels.flat[len(policies) :]:
        axes.set_axis_off()
    figure.supxlabel("thousand environment steps")
    figure.supylabel("return of an episode")
    figure.savefig(out, dpi=110)
    pyplot.close(figure)


class Found(NamedTuple):
    """What the episodes of a policy return, over seeds and evaluations."""

    mean: float
    lost: float  # the part of the episodes that are lost
    others: float  # the mean return of those that are not
    change: float  # of an evaluation's mean return to the next one's, without its sign

    @property
    def cells(self) -> list[str]:
        """Of a table."""
        return [f"{self.mean:,.0f}", f"{100 * self.lost:.0f} %", f"{self.others:,.0f}", f"{self.change:,.0f}"]


def measure(runs: Runs, low: float) -> Found:
    """Measure the second half of each run, with `low` as the return of a random policy."""
    returns = np.array([[x for step, x in run.items() if step > max(run) / 2] for run in runs.values()])
    lost = returns - low < LOST * (returns.max(-1, keepdims=True) - low)
    means = returns.mean(-1)
    change = float(np.abs(np.diff(means)).mean())
    return Found(float(means.mean()), float(lost.mean()), float(returns[~lost].mean()), change)
