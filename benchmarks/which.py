"""Which agent is best where: the table of docs/which-agent.md, from the rows of the grids that compare agents."""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from ladder import read_table, rows_of

from delayrl.bench.results import Collected
from delayrl.report.markup import markdown_table
from delayrl.report.results import Result, delay_order
from delayrl.report.statistics import FEWEST, improvement_interval
from delayrl.report.summary import summarise
from delayrl.report.wording import number

HEAD = ("case", "highest return", "not shown to be lower", "lower", "not finished")
BUDGET = {"precision", "steps", "evaluate_every", "replay_capacity", "tokens"}
"""Overrides that leave an agent what it is."""
WAITING = "@wait"
"""The end of a delay whose observations are held back for the longest one."""


def section(files: list[Path]) -> str:
    """Return a Markdown table with a line for each task and delay on which at least two agents have ended."""
    tables = [read_table(file) for file in files]
    return f"{markdown_table(HEAD, lines(results_of(tables)))}\n\n{rows_of(files, tables)}"


def results_of(tables: Iterable[Collected]) -> list[Result]:
    """Return the results of all tables."""
    return [r for t in tables for r in summarise(t.rows, t.standing, t.configs).results.values()]


def lines(results: Iterable[Result]) -> list[list[str]]:
    """Return the cells of each line. Agents with other options than their preset's are left out."""
    plain = [r for r in results if not r.is_anchor and not r.condition.overrides.keys() - BUDGET]
    groups = [list(group) for _, group in groupby(sorted(plain, key=case), case)]
    return [line(group) for group in groups if len({name(r) for r in group if ended(r)}) > 1]


def case(result: Result) -> tuple[Any, ...]:
    """Return what results must share to be compared. Who waits for the longest delay has the same plant."""
    return result.place.env, delay_order(plant(result)), result.place.setting, result.condition.steps


def plant(result: Result) -> int | str:
    """Return the delay, without the rule to wait."""
    delay = result.place.delay
    return delay.removesuffix(WAITING) if isinstance(delay, str) else delay


def name(result: Result) -> str:
    """Return the agent, marked if it waits."""
    return result.condition.agent + (WAITING if plant(result) != result.place.delay else "")


def ended(result: Result) -> bool:
    """Tell whether all seeds have."""
    return result.runs == result.seeds and not result.partial


def line(group: list[Result]) -> list[str]:
    """Return the cells of one case. An agent that several grids hold counts once, with most of its runs."""
    most = {name(r): r for r in sorted(group, key=lambda r: (ended(r), r.runs))}
    best, *others = sorted(filter(ended, most.values()), key=lambda r: (r.runs < FEWEST, -r.curves.final.mean()))
    parts: dict[bool, list[Result]] = {False: [], True: []}
    for other in others:
        low, _ = improvement_interval([(best.curves.final, other.curves.final)])
        parts[bool(low > 0.5)].append(other)
    setting = best.place.setting
    about = [best.place.env, f"delay {plant(best)}", f"`{setting.preset}`", f"{best.condition.steps:,} steps"]
    about += [f"protocol `{setting.protocol}`"] if setting.protocol != "corrected" else []
    scored = (", ".join(map(score, part)) for part in ([best], parts[False], parts[True]))
    todo = ", ".join(f"`{agent}`" for agent, result in most.items() if not ended(result))
    return [", ".join(about), *scored, todo]


def score(result: Result) -> str:
    """Write an agent with its mean normalised return, or the raw one where an anchor is missing, and its runs."""
    mean = float(np.mean(result.final))
    value = f"{number(float(result.curves.final.mean()))} raw" if np.isnan(mean) else f"{mean:.2f}"
    return f"`{name(result)}` {value} ({result.runs})"
