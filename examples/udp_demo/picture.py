"""Plot the rows of the demonstration: the angle of the pole, and the return of every episode."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.lines import Line2D

COLOURS = {"delayed": "#1f6feb", "blind": "#d1242f", "deaf": "#9a6700"}
WORDS = {
    "delayed": "with its history",
    "blind": "blind to the delay",
    "deaf": "with its history, but not told which commands were lost",
}
SHOWN = 100  # steps of the first panel


def draw(lines: list[dict[str, Any]], out: Path) -> None:
    """Plot rows of `demo.py`: on the left the first episode of the roughest network, on the right all returns."""
    rows = [line for line in lines if "return" in line]
    names = list(dict.fromkeys(row["scenario"] for row in rows))
    roughest = next(name for name in reversed(names) if name.endswith("late"))
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for row in rows:
        if row["scenario"] == roughest and row["trace"] is not None:
            angle = np.array(row["trace"])[: SHOWN + 1, 1]
            left.plot(angle, color=COLOURS[row["controller"]], linewidth=2)
            if len(row["trace"]) <= SHOWN:
                left.plot(len(angle) - 1, angle[-1], "x", color=COLOURS[row["controller"]], markersize=10)
    left.axhline(0, color="#8c8c8c", linewidth=0.8)
    left.set(xlabel="environment steps", ylabel="angle of the pole (rad)", title=f"Observations {roughest}")
    handles = [Line2D([], [], color=COLOURS[who], marker="o", label=WORDS[who]) for who in WORDS]
    for i, name in enumerate(reversed(names)):
        for controller, shift in (("delayed", 0.2), ("blind", -0.2), ("deaf", 0)):
            returns = [row["return"] for row in rows if (row["scenario"], row["controller"]) == (name, controller)]
            right.plot(returns, np.full(len(returns), i + shift), "o", color=COLOURS[controller], alpha=0.5)
    right.set_yticks(range(len(names)), [name.replace(", 10 %", ",\n10 %") for name in reversed(names)])
    right.set(xlabel="return of each episode (best: 1000)", xlim=(-30, 1030), ylim=(-0.5, len(names) - 0.5))
    for axes in (left, right):
        axes.grid(alpha=0.25)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.legend(handles=handles, frameon=False, loc="outside lower center", ncols=3)
    figure.savefig(out, dpi=130)
    pyplot.close(figure)
