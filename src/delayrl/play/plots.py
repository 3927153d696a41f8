"""Figures of one run: returns against steps, and against the delay."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.run.rows import plain_text, whole_evaluations

COLOURS = {"agent": "#1f6feb", "reference": "#8c8c8c"}


def curve(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the learning curve of a run: the mean and the range of each whole evaluation's returns, against steps."""
    if not rows:
        return
    returns: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        returns[row["policy"]][row["step"]].append(row["return"])
    first = rows[0]
    with _axes(path) as axes:
        for policy, points in returns.items():
            label = f"{first['agent']}, delay {first['delay']}" if policy == "agent" else "its reference, no delay"
            steps = whole_evaluations(points)
            _band(axes, steps, [points[step] for step in steps], COLOURS[policy], label)
        axes.set(xlabel="environment steps", ylabel="return", title=plain_text(f"{first['env']}, seed {first['seed']}"))
        axes.legend(frameon=False)


def against_delay(results: list[dict[str, Any]], path: Path) -> None:
    """Draw the returns of one policy against the delay: mean and range of the episodes that `sweep` yields."""
    first = results[0]
    with _axes(path) as axes:
        _band(axes, [r["delay"] for r in results], [r["returns"] for r in results], COLOURS["agent"], first["agent"])
        title = plain_text(f"{first['env']}, one policy, {first['episodes']} episodes a point")
        axes.set(xlabel="delay of the observations (steps)", ylabel="return", title=title)


def curves(groups: Sequence[tuple[str, NDArray[Any], NDArray[Any]]], path: Path, title: str) -> None:
    """Draw learning curves beside each other: for each label and its steps, [N], mean and range of [seeds, N]."""
    with _axes(path) as axes:
        for number, (label, steps, returns) in enumerate(groups):
            _band(axes, list(steps), list(returns.T), f"C{number}", label)
        axes.set(xlabel="environment steps", ylabel="return, mean and range of the seeds", title=plain_text(title))
        axes.legend(frameon=False)


def _band(axes: Any, x: Sequence[float], values: Sequence[Any], colour: str, label: str) -> None:
    axes.plot(x, [np.mean(v) for v in values], color=colour, label=plain_text(label), marker="o", markersize=3)
    low, high = [np.min(v) for v in values], [np.max(v) for v in values]
    axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)


@contextmanager
def _axes(path: Path) -> Iterator[Any]:
    from matplotlib.figure import Figure  # pyplot would take a notebook's backend from it

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    yield axes
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
