"""Delays by stamps: each observation says when it was made, and when it arrived, so its delay is exact."""

from pathlib import Path

import numpy as np

from delayrl.errors import DelayRLError
from delayrl.measure import ages, reading
from delayrl.measure.ages import rounded_up_steps
from delayrl.measure.correlate import Array, Mask
from delayrl.measure.estimated import Estimated


def by_stamps(
    path: Path, made: Array, arrived: Array, episode: Array, period: float | None, warm_up: float | None
) -> Estimated:
    """Return the delays of observations from the times when they were made and arrived, [N], and their recordings, [N].

    `period` is that of control and `warm_up` what is left out at the start, both in seconds, or None for the defaults
    of `from_log`. Raises DelayRLError if the stamps cannot be right, or are too few.
    """
    inside = episode[1:] == episode[:-1]
    made, arrived = _in_order(path, made, arrived, inside)
    delays = arrived - made
    start, first, row_spacing = _one_clock(path, made, inside)
    made, delays = made[0] + start, delays[first]
    since = ages.without_pauses(start, row_spacing)
    warm = reading.WARM_UP * float(since[-1]) if warm_up is None else warm_up
    used = since >= warm
    if used.sum() < 10:
        raise DelayRLError(f"{path}: {used.sum()} rows are left after a warm-up of {warm:g} s: too few")
    kept, period = delays[used], period or row_spacing
    continuous = ages.without_pauses(made[used], row_spacing)
    oldest = np.quantile(ages.at_the_next(continuous, kept), 0.99)
    most = np.quantile(ages.steps_before_the_next(continuous, kept, period), 0.99, method="nearest")
    steps = tuple(rounded_up_steps(d, period) for d in kept)
    return Estimated(
        method="stamps",
        path=str(path),
        delay=float(np.median(kept)),
        low=float(np.quantile(kept, 0.025)),
        high=float(np.quantile(kept, 0.975)),
        row=row_spacing,
        period=period,
        rows=len(kept),
        warm_up=warm,
        steps=steps,
        step=rounded_up_steps(float(np.median(kept)), period),
        span=(float(kept.min()), float(oldest)),
        step_span=(min(steps), int(most)),
        replay=ages.replay(continuous, kept, row_spacing, period),
        longest=float(kept.max()),
        slowest_warm_up=float(delays[~used].max()) if (~used).any() else None,
        drift=_drift(made[used], kept),
    )


def _in_order(path: Path, made: Array, arrived: Array, inside: Mask) -> tuple[Array, Array]:
    """Return both times in the order of the stamps: some messages may have overtaken others of their recording.

    Raises DelayRLError for a stamp that goes back as only another recording's does, and for two clocks or units.
    """
    delays, gaps = arrived - made, np.diff(made)
    spacing = float(np.median(gaps[inside & (gaps > 0)])) if (inside & (gaps > 0)).any() else 0.0
    far = (gaps < -reading.GAP * spacing) | (np.diff(arrived) < 0)  # who was overtaken arrived later, and not long ago
    if (back := inside & (gaps < 0) & far).any():
        hint = "sort the rows by when observations were made, or name a column with --episode that changes where a new "
        raise DelayRLError(f"{path}, row {int(np.argmax(back)) + 2}: the stamp goes back; {hint}recording begins")
    if delays.min() < 0:
        row = int(np.argmin(delays))
        hint = "the clocks differ by at least that; synchronise them (PTP, NTP), or stamp both ends with one clock"
        if delays.max() < 0:
            hint = "--stamp and --received are swapped or in different units, or " + hint
        raise DelayRLError(f"{path}, row {row + 1}: arrived {-delays[row]:.6g} s before it was made: {hint}")
    if delays.min() > max(10, 1000 * spacing):
        late = f"every observation arrived {delays.min():.6g} s after it was made, or later"
        raise DelayRLError(f"{path}: {late}: --stamp and --received are of two clocks, or in different units")
    order = np.lexsort((made, np.append(0, np.cumsum(~inside))))
    return made[order], arrived[order]


def _one_clock(path: Path, made: Array, inside: Mask) -> tuple[Array, Mask, float]:
    """Return when each observation was made after the first, [M], the rows that show it first, [N], and their spacing.

    Each recording begins a pause after the one before, whatever its clock says. All times are in seconds.
    """
    gaps = np.diff(made)
    # a row of the control loop may show the observation of the row before
    first = np.append(True, ~inside | (gaps > 0))
    if first.sum() < 10:
        raise DelayRLError(f"{path} has {first.sum()} different stamps: too short, at least 10 are needed")
    spacing = float(np.median(gaps[inside & (gaps > 0)]))
    pause = 2 * reading.GAP * spacing
    return np.append(0.0, np.cumsum(np.where(inside, gaps, pause)))[first], first, spacing


def _drift(made: Array, delays: Array) -> float:
    """Return how fast the smallest delays grow, in parts per million."""
    parts = np.array_split(np.arange(len(delays)), min(10, len(delays) // 2))
    times, least = np.array([(made[part].mean(), delays[part].min()) for part in parts]).T
    return float(np.polyfit(times, least, 1)[0]) * 1e6
