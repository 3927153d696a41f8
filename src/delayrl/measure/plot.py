"""A picture of a delay that was estimated from a log."""

from pathlib import Path

import numpy as np

from delayrl.errors import DelayRLError
from delayrl.measure.estimated import Estimated


def plot(estimated: Estimated, out: str | Path) -> None:
    """Plot how far each lag is from chance, or with stamps how often each delay occurs.

    The suffix of `out` sets the format. Raises DelayRLError if matplotlib does not know it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    if Path(out).suffix.removeprefix(".") not in figure.canvas.get_supported_filetypes():
        raise DelayRLError(f"--plot takes a .png, .svg or .pdf file; got {out}")
    if estimated.method == "stamps":
        axes.bar(list(estimated.counts), list(estimated.counts.values()), color="#1f6feb")
        axes.set(xlabel=f"steps of {estimated.period * 1e3:g} ms", ylabel="observations")
    else:
        lag, strength, r = np.array(estimated.curve).T
        axes.axvspan(estimated.low * 1e3, estimated.high * 1e3, color="#1a7f37", alpha=0.2, label="dead time, 95 %")
        axes.axvline(estimated.delay * 1e3, color="#1a7f37")
        axes.plot(lag * 1e3, strength, color="#1f6feb", marker=".", label="innovations, 1 = chance")
        axes.set(xlabel="dead time, ms", ylabel="strength of the response", yscale="symlog", ylim=(0, None))
        shown = 1e3 * max(4 * estimated.high, 2 * estimated.peak.lag if estimated.peak else 0)
        axes.set(xlim=(0, min(shown, lag[-1] * 1e3)))
        axes.axhline(1, color="#8c8c8c", linewidth=1, linestyle="--")
        other = axes.twinx()
        other.plot(lag * 1e3, np.abs(r), color="#d1242f", alpha=0.7, label="increments, |r| of the best pair")
        other.set(ylabel="|r| of increments", ylim=(0, None))
        lines = [*axes.get_legend_handles_labels()[0], *other.get_legend_handles_labels()[0]]
        axes.legend(handles=lines, frameon=False)
    axes.set(title=f"{Path(estimated.path).name}: train with --delay {estimated.train_with}")
    figure.savefig(out, dpi=130)
