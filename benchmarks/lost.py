"""Lost episodes: what the means of evaluations hide, on HalfCheetah in the second half of training.

A robot that falls on its back creeps on, at a fraction of its return, to the end of the episode.
"""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from front import ARMS, COLOURS, STEPS, in_words
from ladder import AWAY, read_table, rows_of
from matplotlib import pyplot

from delayrl.bench.results import Collected
from delayrl.errors import DelayRLError
from delayrl.report.markup import markdown_table
from delayrl.run.condition import Condition

ENV = "HalfCheetah-v5"
DRAWN = 25
"""The delay of the picture's policies."""
LOST = 0.7
"""An episode is lost if it returns less than this part of the best of its evaluation, both above a random policy's.

Of an evaluation whose best is below that, none is.
"""
HEAD = ("Δ", "policy", "seeds", "mean return", "lost", f"below {AWAY:,}", "mean of those not lost", "change")
CHANCE = "random"

Policy = tuple[int, str]
"""Delay and name."""
Runs = dict[int, dict[int, list[float]]]
"""Returns of the episodes, by seed and step."""


def section(files: list[Path], picture: Path) -> str:
    """Draw episodes; return the table, with where its rows are. Of a policy in two files, each seed counts once."""
    tables = [read_table(file) for file in files]
    known: dict[Policy, Runs] = defaultdict(dict)
    for table in tables:
        for policy, runs in episodes(table).items():
            known[policy] |= runs
    draw({words: known[DRAWN, words] for words in COLOURS if (DRAWN, words) in known}, picture)
    chance = [x for run in known.pop((0, CHANCE)).values() for evaluation in run.values() for x in evaluation]
    lines = [(delay, words, runs, measure(runs, float(np.mean(chance)))) for (delay, words), runs in known.items()]
    lines.sort(key=lambda line: (line[0], -line[3].mean))
    body = [[str(delay), words, str(len(runs)), *found.cells] for delay, words, runs, found in lines]
    return f"{markdown_table(HEAD, body)}\n\n{rows_of(files, tables)}"


def episodes(table: Collected) -> dict[Policy, Runs]:
    """Return what the policies of the pages' tables returned, those of which all cells have ended.

    A reference, which is evaluated without delay, stands at the delay of the policy that is cloned from it. Raises
    DelayRLError if a seed of a policy is there twice.
    """
    cells = {cell.id: cell.condition for cell, _ in table.standing if budget(cell.condition)}
    late = {
        policy_of(cells[cell.id]) for cell, progress in table.standing if cell.id in cells and progress.state != "done"
    }
    known: dict[Policy, Runs] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    cell_of: dict[tuple[Policy, int], str] = {}
    for row in table.rows:
        condition = cells.get(row["cell"])
        if condition is None or policy_of(condition) in late:
            continue
        words = CHANCE if condition.agent == CHANCE else in_words(condition, row["privileged"])
        if words == CHANCE or words in ARMS:
            words += ", its reference without delay" if row["policy"] == "reference" else ""
            policy, seed = (condition.delay, words), row["seed"]
            if cell_of.setdefault((policy, seed), row["cell"]) != row["cell"]:
                raise DelayRLError(f"seed {seed} of {words} at delay {condition.delay} is in two cells")
            known[policy][seed][row["step"]].append(row["return"])
    return known


def budget(condition: Condition) -> bool:
    """Tell whether a condition has the first page's budget, or is a random policy's: on ENV, at a constant delay."""
    long = condition.agent == CHANCE or condition.steps == STEPS[ENV]
    return long and condition.env == ENV and isinstance(condition.delay, int)


def policy_of(condition: Condition) -> tuple[int | str, str]:
    """Return what all cells of a policy share."""
    return condition.delay, in_words(condition, privileged=False)


def draw(policies: dict[str, Runs], out: Path) -> None:
    """Draw a panel for each policy: a dot for the return of each episode, in one colour for each seed."""
    rows = -(-len(policies) // 3)
    shape = {"figsize": (10, 3 * rows), "sharex": True, "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, panels = pyplot.subplots(rows, 3, **shape)
    for axes, (words, runs) in zip(panels.flat, policies.items(), strict=False):
        for number, run in enumerate(runs.values()):
            steps = np.repeat([step / 1000 for step in run], [len(x) for x in run.values()])
            axes.plot(steps, np.concatenate([*run.values()]), ".", color=f"C{number % 10}", markersize=3, alpha=0.5)
        axes.set_title(f"{words.replace('`', '')}, {len(runs)} seeds", fontsize=8)
        axes.grid(alpha=0.25)
        axes.tick_params(labelbottom=True)
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
    low: float  # the part that return less than AWAY
    others: float  # the mean return of those that are not lost
    change: float  # of an evaluation's mean return to the next one's, without its sign

    @property
    def cells(self) -> Iterable[str]:
        """Of a table."""
        shares = (f"{100 * share:.0f} %" for share in (self.lost, self.low))
        return f"{self.mean:,.0f}", *shares, f"{self.others:,.0f}", f"{self.change:,.0f}"


def measure(runs: Runs, chance: float) -> Found:
    """Measure the second half of each run, with `chance` as the return of a random policy."""
    returns = np.array([[x for step, x in run.items() if step > max(run) / 2] for run in runs.values()])
    best = returns.max(-1, keepdims=True)
    lost = (best > chance) & (returns - chance < LOST * (best - chance))
    means = returns.mean(-1)
    change = np.abs(np.diff(means)).mean()
    return Found(*map(float, (means.mean(), lost.mean(), (returns < AWAY).mean(), returns[~lost].mean(), change)))
