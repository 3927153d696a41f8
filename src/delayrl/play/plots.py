"""Figures of one run: returns against steps, and against the delay."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from delayrl.play.run import Run
from delayrl.run.disk import write_figure
from delayrl.run.rows import plain_text

if TYPE_CHECKING:  # it takes JAX, and curves do not
    from delayrl.play.evaluation import AgeEvaluation

Line = tuple[str, NDArray[Any], NDArray[Any]]

COLOUR, GREY = "#1f6feb", "#8c8c8c"


def curve(run: Run, path: Path) -> None:
    """Draw the learning curve of a run: the mean and the range of each whole evaluation's returns, against steps."""
    config, drawn = run.config, []
    for policy, label in (("agent", f"{config['agent']}, delay {run.delay}"), ("reference", "its reference, no delay")):
        steps, returns = run.curve(policy)
        if len(steps):
            drawn.append((label, steps, returns.T))
    if drawn:
        title = f"{config['env']}, seed {config['seed']}"
        _curves(drawn, path, title, "return", (COLOUR, GREY))


def against_delay(results: Sequence["AgeEvaluation"], path: Path) -> None:
    """Draw the returns of one policy against the delay: mean and range of the episodes that `sweep` yields."""
    first = results[0]
    with _axes(path) as axes:
        _band(axes, [int(r["delay"]) for r in results], [r["returns"] for r in results], COLOUR, first["agent"])
        title = plain_text(f"{first['env']}, one policy, {first['episodes']} episodes a point")
        words = "return, mean and range of the episodes"
        axes.set(xlabel="delay of the observations (steps)", ylabel=words, title=title)
        axes.xaxis.get_major_locator().set_params(integer=True)


def curves(groups: Sequence[Line], path: Path, title: str) -> None:
    """Draw learning curves beside each other: for each label and its steps, [N], mean and range of [seeds, N]."""
    _curves(groups, path, title, "return, mean and range of the seeds", [f"C{number}" for number in range(len(groups))])


def _curves(groups: Sequence[Line], path: Path, title: str, what: str, colours: Sequence[str]) -> None:
    with _axes(path) as axes:
        for (label, steps, returns), colour in zip(groups, colours, strict=False):
            _band(axes, list(steps), list(returns.T), colour, label)
        axes.set(xlabel="environment steps", ylabel=what, title=plain_text(title))
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
    write_figure(path, figure, 130)
