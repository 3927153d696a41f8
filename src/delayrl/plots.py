"""Pictures, from rows alone."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

COLOURS = {"agent": "#1f6feb", "reference": "#8c8c8c"}


def curve(rows: list[dict[str, Any]], path: Path) -> None:
    """The learning curve of one run: mean return of each evaluation, and the range of its episodes, against steps."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    if not rows:
        return
    returns: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        returns[row["policy"]][row["step"]].append(row["return"])
    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    first = rows[0]
    for policy, points in returns.items():
        steps = sorted(points)
        values = [np.asarray(points[step]) for step in steps]
        label = f"{first['agent']}, delay {first['delay']}" if policy == "agent" else "its reference, no delay"
        axes.plot(steps, [v.mean() for v in values], color=COLOURS[policy], label=label, marker="o", markersize=3)
        low, high = [v.min() for v in values], [v.max() for v in values]
        axes.fill_between(steps, low, high, color=COLOURS[policy], alpha=0.15, linewidth=0)
    axes.set(xlabel="environment steps", ylabel="return", title=f"{first['env']}, seed {first['seed']}")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
