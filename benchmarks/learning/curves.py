"""The base beside other libraries' SAC: reads the rows of both, compares areas under curves, draws them."""

import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from scipy import stats

from delayrl.errors import DelayRLError
from delayrl.report import statistics
from delayrl.report.markup import markdown_table

COLOURS = {"delayrl": "#1f6feb", "SBX": "#d1242f", "Stable-Baselines3": "#1a7f37", "delayrl, matched": "#8250df"}
COLOURS |= {"delayrl, matched, bfloat16": "#c07ff0", "delayrl, small": "#9a6700"}
BASE = {"delayrl, matched, bfloat16": "delayrl, matched"}
"""With whom to compare, where it is not ours with the standard settings, "delayrl"."""
PEERS = {"sbx": "SBX", "sb3": "Stable-Baselines3"}
Runs = dict[str, dict[str, dict[int, dict[int, float]]]]  # task -> who -> seed -> step -> mean return


def read(folder: Path) -> tuple[Runs, list[str]]:
    """Return the mean return of each evaluation of each run, and the versions that made them, in words.

    Raises DelayRLError if a run is there twice.
    """
    runs: Runs = defaultdict(lambda: defaultdict(dict))
    versions: dict[str, set[str]] = defaultdict(set)
    for file in sorted(folder.glob("*.jsonl")):
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        configs = {line.get("run", 0): line for line in lines if "config" in line}
        episodes: dict[tuple[int, int], list[float]] = defaultdict(list)
        for line in lines:
            if "step" in line and line.get("policy", "agent") == "agent":
                episodes[line.get("run", 0), line["step"]].append(line["return"])
        for (run, step), returns in episodes.items():
            config = configs[run]["config"]
            curve = runs[config["env"]][name(config)].setdefault(config["seed"], {})
            if step in curve:
                raise DelayRLError(f"{file}: seed {config['seed']} of {name(config)} is in another file too")
            curve[step] = float(np.mean(returns))
        for line in configs.values():
            used = line.get("versions") or line["config"]["versions"]
            packages = ("jax", "torch", "stable-baselines3", "sbx-rl", "mujoco", "gymnasium")
            words = ", ".join(f"{package} {used[package]}" for package in packages if used.get(package))
            words += f", commit {used['commit'] or 'unknown'}" if "commit" in used else ""
            versions[name(line["config"])].add(f"{words}; {used['cores']} x86 cores")
    return runs, [f"{who}: {'; '.join(sorted(words))}" for who, words in sorted(versions.items())]


def name(config: dict[str, Any]) -> str:
    """Return who trained: a library, with the preset where it is not the standard settings."""
    if "library" in config:
        return PEERS[config["library"]]
    words = ["delayrl"]
    if config["preset"] == "small":
        words.append("small")
    elif config["hyperparameters"]["n_steps"] > 1:  # preset paper too: its entropies were over [-1, 1] here
        words.append("matched")
    precision = config["schedule"].get("precision", "float32")
    return ", ".join(words if precision == "float32" else [*words, precision])


def table(runs: Runs) -> str:
    """Return a Markdown table: area and final return by task and library, and its difference from the base."""
    head = ["task", "SAC of", "seeds", "mean return over training", "after training"]
    head.append("difference over training, 95 % interval")
    body = []
    for task, by_name in sorted(runs.items()):
        areas = {}
        for who in sorted(by_name, key=order):
            steps, returns = statistics.common_steps([by_name[who][seed] for seed in sorted(by_name[who])])
            areas[who] = statistics.area(steps, returns)
            cells = [task, who, str(len(returns)), spread(areas[who]), spread(returns[:, -1])]
            base = BASE.get(who, "delayrl")
            compared = difference(areas[who], areas.get(base)) if who != "delayrl" else ""
            body.append([*cells, compared and f"{compared} against {base}"])
    return markdown_table(head, body)


def order(who: str) -> tuple[int, str]:
    """Sort names as their colours stand, others behind them."""
    return (list(COLOURS).index(who) if who in COLOURS else len(COLOURS)), who


def spread(values: statistics.Floats) -> str:
    """Write mean ± standard deviation."""
    mean, std = statistics.mean_std(values)
    return f"{mean:,.0f}" + ("" if np.isnan(std) else f" ± {std:,.0f}")


def difference(one: statistics.Floats, other: statistics.Floats | None, digits: int = 0) -> str:
    """Write the difference of the means with its 95 % interval, by Welch's t, with `digits` decimals."""
    if other is None or min(one.size, other.size) < 2:
        return ""
    low, high = stats.ttest_ind(one, other, equal_var=False).confidence_interval()
    return f"{one.mean() - other.mean():+,.{digits}f} ({low:+,.{digits}f} to {high:+,.{digits}f})"


def draw(runs: Runs, out: Path) -> None:
    """Draw a panel of curves for each task."""
    figure, panels = pyplot.subplots(1, len(runs), figsize=(5 * len(runs), 4.2), layout="constrained", squeeze=False)
    lines = {}
    for axes, (task, by_name) in zip(panels[0], sorted(runs.items()), strict=True):
        for who in sorted(by_name, key=order):
            steps, returns = statistics.common_steps(list(by_name[who].values()))
            lines[who] = curve(axes, steps, returns, COLOURS.get(who, "#555555"))
        axes.set_title(f"{task}, no delay")
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(out, dpi=130)
    pyplot.close(figure)


def bold(text: str) -> str:
    """Write in bold a difference whose interval leaves out 0; a difference without an interval is empty."""
    if not text:
        return ""
    low, high = re.findall(r"[-+][\d,.]+", text)[1:]
    return f"**{text}**" if low[0] == high[0] and re.search("[1-9]", low + high) else text


def curve(axes: Axes, steps: statistics.Floats, returns: statistics.Floats, colour: Any) -> Line2D:
    """Draw return against steps: a thin line for each seed, and their mean, which is returned."""
    axes.plot(steps, returns.T, color=colour, alpha=0.2, linewidth=0.8)
    (mean,) = axes.plot(steps, returns.mean(0), color=colour, linewidth=2.2)
    axes.set(xlabel="environment steps", ylabel="return")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return mean


def section(folder: Path, picture: Path) -> str:
    """Draw the picture, and return the table with what made it."""
    runs, versions = read(folder)
    draw(runs, picture)
    made = "\n".join(f"- {line}" for line in versions)
    return f"{table(runs)}\n\nRows: `benchmarks/results/learning/`. Made with:\n\n{made}"
