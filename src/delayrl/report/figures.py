"""Pictures of a summary, as PNG files."""

import math
import textwrap
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.report.results import Curves, Result, Setting, agent_order, delay_order
from delayrl.report.statistics import mean_std
from delayrl.report.summary import THRESHOLDS, Aggregate, Summary
from delayrl.run.disk import write_figure
from delayrl.run.rows import plain_text

STYLES = {
    "vdpo": ("#2b63b5", "#7aaeff", ""),
    "ad-sac": ("#d64550", "#ff8e96", ""),
    "bpql": ("#1f8a3b", "#55c777", ""),
    "dida": ("#a3307a", "#e888c4", "8 3"),
    "dcac": ("#9a8400", "#d8c64c", "2 2"),
    "a-sac": ("#1d93b8", "#62cdf0", "6 2 2 2"),
    "any-age": ("#7b3fc4", "#b98cff", ""),
    "lifting": ("#c65d00", "#ffa25c", "10 3"),
    "sac-memoryless": ("#777777", "#a0a0a0", "4 3"),
    "sac": ("#333333", "#dddddd", "6 3"),
    "random": ("#999999", "#777777", "1 3"),
}
"""Colours on light and on dark ground, and dashes: told apart with any colour vision, and in black and white."""
SPARE = (("#00796b", "#4fc3b4"), ("#37474f", "#cfd8dc"), ("#8d5524", "#d39b6a"), ("#546e7a", "#9fb6c1"))
Look = tuple[str, str, str, str]  # name, then a style
SAC: Look = ("delay-free SAC", *STYLES["sac"])
RANDOM: Look = ("random", *STYLES["random"])
DASHES = ("5 2", "2 3", "9 2 2 2", "")
NAME, TITLE = 60, 40  # letters in a line


def styles(labels: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Choose a style for each label: its agent's own; variants and agents of yours get what is left."""
    left = [(*colour, dash) for dash in DASHES for colour in SPARE]
    chosen: dict[str, tuple[str, str, str]] = {}
    for label in labels:
        chosen[label] = STYLES.get(label) or left[len(set(chosen) - set(STYLES)) % len(left)]
    return chosen


def draw(summary: Summary, out: Path) -> Mapping[tuple[Setting, str], list[str]]:
    """Draw everything that there are numbers for; returns file names by setting and kind: curves, delay, aggregates."""
    out.mkdir(parents=True, exist_ok=True)
    looks = {label: (summary.name(label), *style) for label, style in styles(summary.labels).items()}
    files: dict[tuple[Setting, str], list[str]] = defaultdict(list)
    for number, setting in enumerate(summary.settings):
        learners = [r for r in summary.results.values() if r.place.setting == setting and r.runs and not r.is_anchor]
        for index, delay in enumerate(sorted({r.place.delay for r in learners}, key=delay_order)):
            name = f"curves-{number}-{index}.png"
            _curves([r for r in learners if r.place.delay == delay], delay, looks, out / name)
            files[setting, "curves"].append(name)
        delays_of: dict[str, set[int]] = defaultdict(set)
        for result in learners:
            if isinstance(result.place.delay, int):
                delays_of[result.place.env].add(result.place.delay)
        constant = [r for r in learners if r.place.delay in delays_of[r.place.env] and len(delays_of[r.place.env]) > 1]
        if constant:
            files[setting, "delay"].append(f"delay-{number}.png")
            _against_delay(constant, looks, out / f"delay-{number}.png")
        aggregates = [a for a in summary.aggregates if a.setting == setting]
        if aggregates:
            files[setting, "aggregates"].append(f"aggregates-{number}.png")
            _aggregates(aggregates, looks, out / f"aggregates-{number}.png")
    return files


def _panels(lines: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False)
    for panel in panels.flat:
        panel.grid(alpha=0.2)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _task_panels(results: list[Result]) -> tuple[Any, dict[str, Any]]:
    """A panel for each task, in up to three columns."""
    tasks = sorted({r.place.env for r in results})
    columns = min(3, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    figure, panels = _panels(lines, columns, (max(6.0, 4.0 * columns), 2.9 * lines + 0.5))
    for panel in panels.flat[len(tasks) :]:
        panel.set_visible(False)
    return figure, dict(zip(tasks, panels.flat, strict=False))


def _save(figure: Any, path: Path) -> None:
    lines: dict[str, Any] = {}
    for panel in figure.axes:
        lines |= {label: line for line, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    names = sorted(lines, key=lambda name: (name in (SAC[0], RANDOM[0]), agent_order(name)))
    drawn, width = [_drawn(name) for name in names], figure.get_figwidth()
    longest = max((len(line) for name in drawn for line in name.splitlines()), default=0)
    columns = max(1, int(min(5, width / 2, width / (0.6 + 0.075 * longest))))
    look = {"loc": "outside lower center", "ncols": columns, "frameon": False}
    below = max(0, math.ceil(sum(name.count("\n") + 1 for name in drawn) / columns) - 2)
    above = max(panel.get_title().count("\n") for panel in figure.axes) * figure.axes[0].get_gridspec().nrows
    figure.set_figheight(figure.get_figheight() + 0.17 * (below + above))  # lines beyond the usual ones
    figure.legend([lines[name] for name in names], drawn, fontsize=9, **look)
    write_figure(path, figure, 110)


def _line(look: Look) -> dict[str, Any]:
    name, colour, _, dashes = look
    dash = tuple(float(x) / 1.5 for x in dashes.split())
    return {"label": name, "color": colour, "linestyle": (0, dash) if dash else "-", "linewidth": 1.8}


def _drawn(text: str, letters: int = NAME) -> str:
    """Make text from the rows drawable: in lines of so many letters, no formula, no lone surrogates.

    What tells two names apart may stand anywhere in them, so that only very long ones are cut, in the middle.
    """
    text = text if len(text) <= 400 else f"{text[:200]} … {text[-200:]}"
    return plain_text(textwrap.fill(text, letters, break_on_hyphens=False))


def _anchor_lines(axes: Any, results: Sequence[Result]) -> None:
    """Draw the random policy and delay-free SAC. One that not all results share says of which length it is."""
    for kind, look in (("reference_anchor", SAC), ("random_anchor", RANDOM)):
        lines = {r.condition.steps: getattr(r, kind).value for r in results}
        shared = len({None if math.isnan(value) else value for value in lines.values()}) == 1
        for steps, value in sorted(lines.items())[: 1 if shared else None]:
            if math.isnan(value):
                continue
            axes.axhline(value, **_line(look) | {"linewidth": 1.1})
            if not shared:
                place = {"xy": (1, value), "xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
                axes.annotate(f"{steps:,} steps", fontsize=7, color=look[1], **place)


def _curves(results: list[Result], delay: int | str, looks: dict[str, Look], path: Path) -> None:
    """Mean over the seeds and standard deviation, a panel for each task."""
    figure, panels = _task_panels(results)
    for task, axes in panels.items():
        mine = [r for r in results if r.place.env == task]
        for result in mine:
            _curve(axes, result.curves, _line(looks[result.place.label]))
        _anchor_lines(axes, mine)
        last = max(r.curves.steps[-1] for r in mine)
        longer = {r.longer_reference.steps: r.longer_reference.curves for r in mine if r.longer_reference.steps}
        for trained, curves in longer.items():
            shown = curves.steps <= last
            look = _line(SAC) | {"label": f"{SAC[0]} ({trained:,} steps)"}
            _curve(axes, Curves(curves.steps[shown], curves.returns[:, shown]), look)
        axes.set_title(_drawn(f"{task}, Δ = {delay}", TITLE), fontsize=10)
        axes.set(xlabel="environment steps", ylabel="return")
        axes.ticklabel_format(axis="both", style="sci", scilimits=(-3, 4))
    _save(figure, path)


def _curve(axes: Any, curves: Curves, style: dict[str, Any]) -> None:
    steps, mean = curves.steps, curves.mean
    axes.plot(steps, mean, **style)
    if len(curves.returns) > 1:
        std = curves.returns.std(0, ddof=1)
        axes.fill_between(steps, mean - std, mean + std, color=style["color"], alpha=0.13, lw=0)


def _against_delay(results: list[Result], looks: dict[str, Look], path: Path) -> None:
    """Return after training against the delay, a panel for each task; bars are standard deviations over the seeds."""
    figure, panels = _task_panels(results)
    for task, axes in panels.items():
        mine = [r for r in results if r.place.env == task and not r.partial]
        for label in dict.fromkeys(r.place.label for r in mine):
            points = [r for r in mine if r.place.label == label]
            mean, std = np.array([mean_std(r.curves.final) for r in points]).T
            delays, style = [r.place.delay for r in points], _line(looks[label])
            axes.errorbar(delays, mean, np.nan_to_num(std), marker="o", markersize=4, capsize=2, **style)
        _anchor_lines(axes, mine)
        axes.set_title(_drawn(task, TITLE), fontsize=10)
        axes.set(xlabel="delay (steps)", ylabel="return")
    _save(figure, path)


def _aggregates(aggregates: list[Aggregate], looks: dict[str, Look], path: Path) -> None:
    """IQM with its interval, and the performance profile beside it, a line for each delay."""
    delays = list(dict.fromkeys(a.delay for a in aggregates))
    names = {a.label: _drawn(looks[a.label][0]) for a in aggregates}  # they stand beside the left panels
    longest = max(len(line) for name in names.values() for line in name.splitlines())
    lines = max(name.count("\n") + 1 for name in names.values())
    figure, panels = _panels(len(delays), 2, (8 + 0.08 * longest, (2.4 + 0.4 * lines) * len(delays) + 0.5))
    for (left, right), delay in zip(panels, delays, strict=True):
        mine = [a for a in aggregates if a.delay == delay]
        title = "all constant delays" if delay is None else f"Δ = {delay}"
        for height, a in enumerate(reversed(mine)):
            style = _line(looks[a.label])
            left.plot([a.low, a.high], [height, height], color=style["color"], linewidth=6, alpha=0.3)
            left.plot(a.iqm, height, "o", color=style["color"])
            right.plot(THRESHOLDS, a.profile, **style)
            right.fill_between(THRESHOLDS, a.profile_low, a.profile_high, color=style["color"], alpha=0.12, lw=0)
        left.set_yticks(range(len(mine)), [names[a.label] for a in reversed(mine)])
        left.set(title=_drawn(f"IQM, {title}", TITLE), xlabel="normalised return", ylim=(-0.6, len(mine) - 0.4))
        right.set(title=_drawn(f"Profile, {title}", TITLE), xlabel="normalised return τ", ylabel="runs above τ")
        for panel in (left, right):
            panel.title.set_fontsize(10)
    _save(figure, path)
