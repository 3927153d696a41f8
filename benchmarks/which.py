"""Which agent is best where: the table of docs/which-agent.md, from the rows of the grids that compare agents."""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.bench.results import read_table
from delayrl.report.comparisons import make_comparisons
from delayrl.report.results import Result, delay_order
from delayrl.report.summary import summarise
from delayrl.report.wording import number

HEAD = ("task", "delay", "preset", "steps", "runs", "highest return", "not told apart from it", "lower")


def section(files: list[Path]) -> str:
    """Return a Markdown table with a line for each task and delay on which at least two agents have ended."""
    table = ["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD)]
    for file in files:
        collected = read_table(file)
        summary = summarise(collected.rows, collected.standing, collected.configs)
        table += ["| " + " | ".join(cells) + " |" for cells in lines(summary.results.values())]
    return "\n".join(table) + f"\n\nRows: {', '.join(f'`benchmarks/results/{file.name}`' for file in files)}."


def lines(results: Iterable[Result]) -> list[list[str]]:
    """Return the cells of each line. Agents with other options than their preset's are left out."""
    ended = [r for r in results if r.runs and not (r.partial or r.is_anchor) and r.place.label == r.condition.agent]
    groups = [list(group) for _, group in groupby(sorted(ended, key=case), case)]
    return [line(group) for group in groups if len(group) > 1]


def case(result: Result) -> tuple[Any, ...]:
    """Return what results must share to be compared."""
    return result.place.env, delay_order(result.place.delay), result.place.setting, result.condition.steps


def line(results: list[Result]) -> list[str]:
    """Return the cells of one case: the best agent, those that are not clearly lower, and those that are."""
    best, *others = sorted(results, key=lambda r: -r.curves.final.mean())
    found = [c for pair in make_comparisons(results) for c in (pair, pair.turned())]
    lower = {c.other for c in found if c.one == best.place.label and c.clear}
    parts = [best], *([r for r in others if (r.place.label in lower) == clear] for clear in (False, True))
    runs = [r.runs for r in results]
    number_of_runs = str(runs[0]) if min(runs) == max(runs) else f"{min(runs)} to {max(runs)}"
    about = [best.place.env, str(best.place.delay), f"`{best.place.setting.preset}`", f"{best.condition.steps:,}"]
    return [*about, number_of_runs, *(", ".join(map(score, part)) for part in parts)]


def score(result: Result) -> str:
    """Write an agent with its mean normalised return, or the raw one where an anchor is missing."""
    mean = float(np.mean(result.final))
    value = f"{number(float(result.curves.final.mean()))} raw" if np.isnan(mean) else f"{mean:.2f}"
    return f"`{result.condition.agent}` {value}"
