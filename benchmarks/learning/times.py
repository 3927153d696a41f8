"""Tables and the picture of returns against wall-clock, from the rows of timed.py."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import pyplot

RETURNS = (1_000, 2_000, 3_000)
NAMES = {"sb3": "SAC of Stable-Baselines3", "sbx": "SAC of SBX", "released": "VDPO, released code"}
COLOURS = ("#1f6feb", "#1a7f37", "#8250df", "#c07ff0", "#9a6700", "#d1242f", "#8c8c8c")


class Run(NamedTuple):
    """One seed of one side: at each evaluation its step, seconds of training, and mean return."""

    steps: list[int]
    seconds: list[float]
    returns: list[float]
    end: tuple[int, float]  # steps and seconds of the whole run


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
        runs[config["delay"]][name(config)].append(Run(*columns, (lines[-1]["step"], lines[-1]["seconds"])))
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


def cell(runs: list[Run], value: float) -> str:
    """Write the median minutes and steps of the seeds that reach a return, and how many do if not all."""
    ends = [end for run in runs if (end := reached(run, value))]
    if not ends:
        return "–"
    steps, seconds = (np.median([end[i] for end in ends]) for i in range(2))
    share = "" if len(ends) == len(runs) else f"; {len(ends)} of {len(runs)} seeds"
    return f"{seconds / 60:.1f} min ({steps:,.0f} steps{share})"


def table(runs: Runs) -> str:
    """Return a Markdown table of the time to each return, by delay and side."""
    head = ["Δ", "side", "seeds", *(f"{value:,}" for value in RETURNS), "at the end", "minutes", "steps a second"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for delay, sides in sorted(runs.items()):
        for side, own in sorted(sides.items()):
            last = [run.returns[-1] for run in own if run.returns]
            speed = np.median([steps / seconds for steps, seconds in (run.end for run in own)])
            cells = [str(delay), side, str(len(own)), *(cell(own, value) for value in RETURNS)]
            cells += [f"{np.mean(last):,.0f}" if last else "–"]
            cells += [f"{np.median([run.end[1] for run in own]) / 60:.0f}", f"{speed:,.1f}"]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(runs: Runs, out: Path) -> None:
    """Draw return against minutes: a thin line for each seed in its side's colour, a panel for each delay."""
    figure, panels = pyplot.subplots(1, len(runs), figsize=(5 * len(runs), 4.2), layout="constrained", squeeze=False)
    sides = sorted({side for own in runs.values() for side in own})
    for axes, (delay, own) in zip(panels[0], sorted(runs.items()), strict=True):
        for side, colour in zip(sides, COLOURS, strict=False):
            for i, run in enumerate(own.get(side, [])):
                label = side.replace("`", "") if i == 0 else None
                axes.plot(np.array(run.seconds) / 60, run.returns, color=colour, linewidth=1.4, label=label)
        axes.set(xlabel="minutes of training", ylabel="return", title=f"Δ = {delay}", xscale="log")
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
    made = sorted({f"{key} {value}" for head in heads for key, value in head["versions"].items() if value})
    return f"{table(runs)}\n\n{tasks}. Made with {', '.join(made)}. Rows: `benchmarks/results/times/`."
