"""Tables and the picture of returns against wall-clock, from the rows of timed.py."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import pyplot

from delayrl.report.figures import STYLES
from delayrl.report.markup import markdown_table

RETURNS = (1_000, 2_000, 3_000)
OURS = "`any-age`, `small`"
NAMES = {"sb3": "SAC of Stable-Baselines3", "sbx": "SAC of SBX", "released": "VDPO, released code"}
TICKS = (0.1, 0.3, 1, 3, 10, 30)
COLOURS = {"SAC of Stable-Baselines3": "#8d5524", "SAC of SBX": "#d39b6a", "VDPO, released code": STYLES["vdpo"][1]}
"""Agents of ours have the colours of reports."""


class Run(NamedTuple):
    """One seed of one side: at each evaluation its step, seconds of training, and mean return."""

    steps: list[int]
    seconds: list[float]
    returns: list[float]
    given: float  # minutes that it was given


Runs = dict[int, dict[str, list[Run]]]  # delay -> side -> one run for each seed


def read(folder: Path) -> tuple[Runs, list[dict[str, Any]]]:
    """Return the runs, and the first lines of their files."""
    runs: Runs = defaultdict(lambda: defaultdict(list))
    heads = []
    for file in sorted(folder.glob("*.jsonl")):
        head, *lines = [json.loads(line) for line in file.read_text().splitlines()]
        config = head["config"]
        evaluated = [line for line in lines if line["return"] is not None]
        columns = ([line[name] for line in evaluated] for name in ("step", "seconds", "return"))
        runs[config["delay"]][name(config)].append(Run(*columns, config["minutes"]))
        heads.append(head)
    return runs, heads


def name(config: dict[str, Any]) -> str:
    """Return a side's name in the table."""
    if config["side"] in NAMES:
        return NAMES[config["side"]]
    return ", ".join(f"`{word}`" for word in (config["side"], config["preset"], *config["set"]))


def reached(run: Run, value: float) -> tuple[int, float] | None:
    """Return step and seconds of the first evaluation with at least this return; None if there is none."""
    found = [i for i, mean in enumerate(run.returns) if mean >= value]
    return (run.steps[found[0]], run.seconds[found[0]]) if found else None


def median(runs: list[Run], value: float) -> tuple[float, float]:
    """Return the median steps and seconds to a return over all seeds; infinite where half of them do not reach it."""
    steps, seconds = np.median([reached(run, value) or (np.inf, np.inf) for run in runs], axis=0)
    return steps, seconds


def cell(runs: list[Run], value: float) -> str:
    """Write the median minutes and steps to a return, and how many seeds reach it; a dash where half of them do not."""
    found = sum(reached(run, value) is not None for run in runs)
    steps, seconds = median(runs, value)
    share = "" if found in (0, len(runs)) else f"{found} of {len(runs)} seeds"
    if not np.isfinite(seconds):
        return f"– ({share})" if share else "–"
    return f"{seconds / 60:.1f} min ({steps:,.0f} steps{'; ' * bool(share)}{share})"


def after(run: Run, minutes: float) -> float:
    """Return the mean return of the last evaluation within so many minutes; NaN if there is none."""
    known = [mean for seconds, mean in zip(run.seconds, run.returns, strict=True) if seconds <= 60 * minutes]
    return known[-1] if known else np.nan


def speed(run: Run) -> float:
    """Return the steps a second over the last quarter of the evaluations, where all sides learn; NaN with only one."""
    if len(run.steps) < 2:
        return np.nan
    since = -1 - max(1, len(run.steps) // 4)
    return (run.steps[-1] - run.steps[since]) / (run.seconds[-1] - run.seconds[since])


def table(runs: Runs) -> str:
    """Return a Markdown table of the time to each return, by delay and side."""
    least = min(run.given for sides in runs.values() for own in sides.values() for run in own)
    ends = [f"after {least:.0f} minutes, or at the end", "steps a second"]
    head = ["Δ", "side", "seeds", *(f"{value:,}" for value in RETURNS), *ends]
    body = []
    for delay, sides in sorted(runs.items()):
        for side, own in sorted(sides.items()):
            last, fast = np.mean([after(run, least) for run in own]), np.median([speed(run) for run in own])
            cells = [str(delay), side, str(len(own)), *(cell(own, value) for value in RETURNS)]
            body.append([*cells, *("–" if np.isnan(x) else f"{x:,.{n}f}" for x, n in ((last, 0), (fast, 1)))])
    return markdown_table(head, body)


def ratio(runs: list[Run], ours: list[Run], value: float) -> str:
    """Write how many times as long as ours a side takes to a return; a dash where neither reaches it.

    Where half of one's seeds do not, that is a bound: those count as if they had at their last evaluation. Seeds of
    the other that do not reach it are the last in its median.
    """
    theirs_does, ours_does = (np.isfinite(median(some, value)[1]) for some in (runs, ours))
    if not (theirs_does or ours_does):
        return "–"
    if theirs_does and ours_does:
        return f"{median(runs, value)[1] / median(ours, value)[1]:.1f}"
    theirs, own = (
        median(some, value)[1]
        if does
        else np.median([(reached(run, value) or (0, run.seconds[-1]))[1] for run in some])
        for some, does in ((runs, theirs_does), (ours, ours_does))
    )
    return f"{'> ' if ours_does else '< '}{theirs / own:.1f}"


def ratios(runs: Runs, ours: str) -> str:
    """Return a Markdown table of every side's time to each return over that of `ours`."""
    head = ["Δ", f"side, times as long as {ours}", *(f"{value:,}" for value in RETURNS)]
    body = [
        [str(delay), side, *(ratio(own, sides[ours], value) for value in RETURNS)]
        for delay, sides in sorted(runs.items())
        for side, own in sorted(sides.items())
        if ours in sides and side != ours
    ]
    return markdown_table(head, body)


def draw(runs: Runs, out: Path) -> None:
    """Draw return against minutes: a thin line for each seed in its side's colour, a panel for each delay."""
    figure, panels = pyplot.subplots(1, len(runs), figsize=(5 * len(runs), 4.2), layout="constrained", squeeze=False)
    sides = sorted({side for own in runs.values() for side in own})
    for axes, (delay, own) in zip(panels[0], sorted(runs.items()), strict=True):
        for side in sides:
            colour = COLOURS.get(side) or STYLES[side.split("`")[1]][0]
            for i, run in enumerate(own.get(side, [])):
                label = side.replace("`", "") if i == 0 else None
                axes.plot(np.array(run.seconds) / 60, run.returns, color=colour, linewidth=1.4, label=label)
        axes.set(xlabel="minutes of training", ylabel="return", title=f"Δ = {delay}", xscale="log")
        axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, dpi=130)
    pyplot.close(figure)


def section(folder: Path, picture: Path) -> str:
    """Draw the picture, and return the table with what made it."""
    runs, heads = read(folder)
    draw(runs, picture)
    tasks = ", ".join(sorted({head["config"]["env"] for head in heads}))
    about = f"{tasks}. Made with {made_with(heads)}. Rows, each with its own versions: `benchmarks/results/times/`."
    return "\n\n".join([table(runs), ratios(runs, OURS), about])


def made_with(heads: list[dict[str, Any]]) -> str:
    """Write the versions that made the rows, all of each package in one place."""
    used: dict[str, set[str]] = defaultdict(set)
    for versions in (head["versions"] for head in heads):
        for key, value in versions.items():
            if value and key not in ("cores", "machine"):
                used[key].add(str(value))
    return ", ".join(f"{key} {' and '.join(sorted(values))}" for key, values in used.items())
