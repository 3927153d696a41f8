"""Estimate the delay of a running system from its log: exactly from stamps of the observations, or by correlation."""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.delays import PerEpisode, any_phase, uniform
from delayrl.errors import DelayRLError, DelayWarning
from delayrl.measure import ages, correlate, reading
from delayrl.measure.ages import TOLERANCE, rounded_up_steps
from delayrl.measure.correlate import Array

BLOCKS = 40
RESAMPLINGS = 200
LEAST_ROWS = 200
WINDOW_ROWS = 400  # least rows of a part of the log with its own estimate
WINDOWS = 8
WARM_UP = 0.05  # of the log, the part that is left out at its start by default


@dataclass(frozen=True)
class Pair:
    """The largest correlation between the increments of a command and an observation, and its lag in seconds."""

    command: str
    observation: str
    lag: float
    r: float


@dataclass(frozen=True)
class Estimated:
    """A delay in seconds, and in steps of a control period.

    By correlation, `delay` is the dead time, from a command to the first row that reacts; `low` and `high` are the 95 %
    interval of a block bootstrap, widened by a row on each side. By stamps, they are the median, and the 2.5th and
    97.5th percentiles.
    """

    method: str  # "stamps" (exact, for each observation) or "correlation" (an estimate)
    path: str  # of the log
    delay: float
    low: float
    high: float
    row: float  # spacing of the rows in seconds, which is the resolution of a correlation
    period: float  # of control, in seconds
    rows: int  # how many were used
    warm_up: float  # seconds left out at the start
    steps: tuple[int, ...]  # the delay of each window or observation, in steps, in order of time
    step: int  # `delay` in steps
    span: tuple[float, float]  # the shortest and the longest delay to train for, in seconds; see `train_with`
    step_span: tuple[int, int]  # the same for a sensor in step with the loop, in steps; see `in_step`
    strength: float | None = None  # of the strongest lag; chance reaches 1 in one of a thousand logs
    peak: Pair | None = None  # largest correlation of increments; its lag includes the plant's own lag
    pairs: tuple[Pair, ...] = ()  # the strongest pairs
    renewed: float | None = None  # correlation only: seconds between two changes of the observation, the median
    windows: tuple[tuple[float, float], ...] = ()  # (middle in seconds, dead time) of each part that shows one
    replay: tuple[tuple[int, int], ...] = ()  # stamps only: what `save` writes, see `ages.replay`
    echoes: tuple[str, ...] = ()  # correlation only: observations that repeat a command
    longest: float = 0.0  # the largest delay of a window or an observation, in seconds
    slowest_warm_up: float | None = None  # stamps only: the largest delay during the warm-up, in seconds
    drift: float | None = None  # stamps only: growth of the smallest delays, in parts per million: clocks run apart
    curve: tuple[tuple[float, float, float], ...] = ()  # (dead time, strength, r of the best pair's increments) by lag

    @property
    def train_with(self) -> str:
        """The argument for `delayrl train --delay`, for a sensor at any phase of the control loop.

        With stamps it covers the smallest delay to the 99th percentile of the ages that observations reach before the
        next one arrives, so lost ones count. By correlation it covers the dead time, which is known to a row, or the
        10th to the 90th percentile of windows that differ, for a sensor with the period of the loop. The law is of each
        episode, or of each message if ages vary within one.
        """
        (low, high), period = np.array(self.span) / self.period, float(self.method != "stamps")  # theirs include it
        return self._law(*any_phase(low, high, period), self._varies)

    @property
    def in_step(self) -> str:
        """The argument for a sensor in step with the control loop: the steps, or a law if they differ, as `train_with`.

        With stamps, LOW is the smallest delay, and HIGH the 99th percentile of the ages before the next observation
        arrives. With windows, they are the 10th and 90th, because a window is short and its estimate is rough.
        """
        return self._law(*self.step_span, self.method == "stamps" or self._varies)

    def _law(self, low: int, high: int, varies: bool) -> str:
        return str(high if low == high else uniform(low, high) if varies else PerEpisode(uniform(low, high)))

    @property
    def _varies(self) -> bool:
        """Whether ages vary within an episode: by more than a sensor's phase or an estimate's scatter explains."""
        # by correlation `span` has one row more, and the delay of a part is known to one row
        alike = min(self.row, self.period) if self.method == "stamps" else 2 * self.row
        return self.span[1] - self.span[0] > alike + TOLERANCE * self.period

    @property
    def counts(self) -> dict[int, int]:
        """How many windows or observations had each number of steps."""
        return dict(sorted(Counter(self.steps).items()))

    def save(self, path: str | Path) -> None:
        """Write a delay for each control step, one a line, for `--delay recorded:FILE`.

        Raises:
            DelayRLError: a delay by correlation, which is that of a part of the log and not of a step.
        """
        if not self.replay:
            hint = f"train with --delay {self.train_with}"
            raise DelayRLError(f"{self.path}: only stamps give a delay of each step to save, not a correlation; {hint}")
        Path(path).write_text("".join(f"{step}\n" for step in ages.of_each_step(self.replay)))

    def json(self) -> dict[str, Any]:
        """Return a dict for `json.dumps`."""
        fields = {"kind": "log", **asdict(self), "train_with": self.train_with, "in_step": self.in_step}
        del fields["replay"]
        return fields | {"steps": {str(step): count for step, count in self.counts.items()}}


def from_log(
    path: str | Path,
    period: float | None = None,
    *,
    time: str | None = None,
    commands: Sequence[str] | None = None,
    observations: Sequence[str] | None = None,
    episode: str | None = None,
    stamp: str | None = None,
    received: str | None = None,
    unit: str | None = None,
    longest: float | None = None,
    warm_up: float | None = None,
    seed: int = 0,
) -> Estimated:
    """Estimate the delay from a log.

    Args:
        path: a CSV or Parquet file.
        period: of control, in seconds; by default the spacing of the rows.
        time: column of the time stamps; by default `time`, `timestamp` or `t`.
        commands: columns, or beginnings of their names; by default `command`, `cmd`, `action`.
        observations: the same; by default `observation`, `obs`.
        episode: column that changes where a new recording begins; by default `episode` or `episode_index`, if any.
        stamp: column of the time when an observation was made, by default `stamp`. If there is a column `received` too,
            the delays are exact, and commands are ignored.
        received: column of the time when the observation arrived, by default `received`.
        unit: of time stamps: s (the default), ms, us or ns.
        longest: the longest delay to look for, in seconds; by default 100 rows, or a tenth of a short log.
        warm_up: seconds to leave out at the start; by default a twentieth of the log.
        seed: of the bootstrap.

    Raises:
        DelayRLError: the log cannot be used, or shows no delay beyond chance.
    """
    path, given, unit = Path(path), unit, "s" if unit is None else unit
    if unit not in reading.UNITS:
        raise DelayRLError(f"time stamps are in {', '.join(reading.UNITS)}; got {unit!r}")
    for value, name, least in ((period, "period", 1e-9), (longest, "longest", 1e-9), (warm_up, "warm-up", 0)):
        if value is not None and not (isinstance(value, Real) and np.isfinite(value) and value >= least):
            raise DelayRLError(f"--{name} is a time in seconds; got {value}")
    if not isinstance(seed, Integral) or seed < 0:
        raise DelayRLError(f"--seed is a whole number from 0; got {seed!r}")
    table = reading.Table(path)
    exact = reading.read_stamps(table, stamp, received, episode, unit)
    if exact is not None:
        estimated = _from_stamps(path, *exact, period, warm_up)
    else:
        log, row = reading.resample(reading.read_signals(table, time, commands, observations, episode, unit))
        log, echoes = _without_echoes(log)
        warm = WARM_UP * len(log.time) * row if warm_up is None else warm_up
        estimated = replace(_correlated(path, log, row, period or row, longest, warm, seed), echoes=echoes)
    if doubt := reading.doubt(estimated.row, estimated.period, given, estimated.method):
        warnings.warn(f"{path}: {doubt}", DelayWarning, stacklevel=2)
    return estimated


def _without_echoes(log: reading.Log) -> tuple[reading.Log, tuple[str, ...]]:
    """Return the log without observations that repeat a command, and their names. If all do, they stay."""
    echo = correlate.echoes(log.commands, log.observations, log.episode)
    names = tuple(name for name, repeats in zip(log.observation_names, echo, strict=True) if repeats)
    if echo.all() or not names:
        return log, names
    left = tuple(name for name in log.observation_names if name not in names)
    return replace(log, observations=log.observations[:, ~echo], observation_names=left), names


def _from_stamps(
    path: Path, made: Array, arrived: Array, episode: Array, period: float | None, warm_up: float | None
) -> Estimated:
    delays, gaps, inside = arrived - made, np.diff(made), episode[1:] == episode[:-1]
    if (back := inside & (gaps < 0)).any():
        hint = "sort the rows by when observations were made, or name a column with --episode that changes where a new "
        raise DelayRLError(f"{path}, row {int(np.argmax(back)) + 2}: the stamp goes back; {hint}recording begins")
    if delays.min() < 0:
        row = int(np.argmin(delays))
        hint = "the clocks differ by at least that; synchronise them (PTP, NTP), or stamp both ends with one clock"
        if delays.max() < 0:
            hint = "--stamp and --received are swapped, or " + hint
        raise DelayRLError(f"{path}, row {row + 1}: arrived {-delays[row]:.6g} s before it was made: {hint}")
    # a row of the control loop may show the observation of the row before
    first = np.append(True, ~inside | (gaps > 0))
    if first.sum() < 10:
        raise DelayRLError(f"{path} has {first.sum()} different stamps: too short, at least 10 are needed")
    row_spacing = float(np.median(gaps[inside & (gaps > 0)]))
    # each recording begins this long after the one before, whatever its clock says
    pause = 2 * reading.GAP * row_spacing
    start = np.append(0.0, np.cumsum(np.where(inside, gaps, pause)))[first]
    made, delays = made[0] + start, delays[first]
    warm = WARM_UP * float(start[-1]) if warm_up is None else warm_up
    used = start >= warm
    if used.sum() < 10:
        raise DelayRLError(f"{path}: {used.sum()} rows are left after a warm-up of {warm:g} s: too few")
    kept, period = delays[used], period or row_spacing
    continuous = ages.without_pauses(made[used], row_spacing)
    oldest = np.quantile(ages.at_the_next(continuous, kept), 0.99)
    most = np.quantile(ages.steps_before_the_next(continuous, kept, period), 0.99, method="nearest")
    steps = tuple(rounded_up_steps(d, period) for d in kept)
    parts = np.array_split(np.arange(len(kept)), min(10, len(kept) // 2))
    times, least = np.array([(made[used][part].mean(), kept[part].min()) for part in parts]).T
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
        drift=float(np.polyfit(times, least, 1)[0]) * 1e6,
    )


def _correlated(
    path: Path, log: reading.Log, row: float, period: float, longest: float | None, warm: float, seed: int
) -> Estimated:
    commands, observations, episode = _used(path, log, row, warm)
    rows = len(episode)
    lags = min(100, rows // 10) if longest is None else int(np.ceil(longest / row)) + 1
    if lags > rows // 6:
        tried = f"a delay of {lags * row:g} s: at most {rows // 6 * row:.3g} s"
        raise DelayRLError(f"{path}: {rows} rows of {row:g} s are too few to look for {tried}")
    u, y = correlate.innovations(commands, observations, episode)
    blocks = int(np.clip(rows // (2 * lags), WINDOWS, BLOCKS)) // WINDOWS * WINDOWS  # windows are whole blocks
    sums, size = correlate.blocks(u, y, lags, blocks)
    correlation = correlate.correlation(sums, size, lags)
    first = correlate.onset(correlation)
    if first is None:
        hint = "A longer log, other columns, or commands with some random variation may show one"
        unseen = f"no delay found up to {lags * row:.3g} s: no observation follows a command beyond chance"
        raise DelayRLError(f"{path}: {unseen}. {hint}")
    low, high = _interval(sums, size, lags, row, seed)
    windows, count = [], min(WINDOWS, rows // WINDOW_ROWS)
    for part in np.array_split(np.arange(len(sums)), count) if count > 1 else []:
        lag = correlate.onset(correlate.correlation(sums[part], size, lags))
        if lag is not None:
            windows.append((float(warm + part.mean() * size * row + size * row / 2), (lag - 1) * row))
    pairs, r = _pairs(log, commands, observations, episode, lags, row)
    strength = correlate.strength(correlation)[0]
    delay, steps = (first - 1) * row, tuple(rounded_up_steps(d, period) for _, d in windows)
    step = rounded_up_steps(delay, period)
    spread = [d for _, d in windows] if len(windows) > 1 else [delay]
    fewest, highest = np.quantile([rounded_up_steps(d, period) for d in spread], (0.1, 0.9), method="nearest")
    shortest, most = np.quantile(spread, (0.1, 0.9))
    return Estimated(
        method="correlation",
        path=str(path),
        delay=delay,
        low=low,
        high=high,
        row=row,
        period=period,
        rows=rows,
        warm_up=warm,
        steps=steps,
        step=step,
        span=(float(shortest), float(most) + row),
        step_span=(int(fewest), int(highest)),
        strength=float(strength.max()),
        peak=pairs[0],
        pairs=pairs[:10],
        renewed=_renewed(observations, episode) * row,
        windows=tuple(windows),
        longest=max([delay, *(d for _, d in windows)]),
        curve=tuple((lag * row, float(strength[lag]), float(r[lag])) for lag in range(lags)),
    )


def _used(path: Path, log: reading.Log, row: float, warm: float) -> tuple[Array, Array, Array]:
    """Return commands, observations and episodes after the warm-up. Raises DelayRLError if they show nothing."""
    used = log.time >= warm - row / 2
    if used.sum() < LEAST_ROWS:
        counted = f"{used.sum()} rows after a warm-up of {warm:g} s"
        raise DelayRLError(f"{path} is too short: {counted}; {LEAST_ROWS} are needed, better 1,000")
    commands, observations = log.commands[used], log.observations[used]
    for values, what in ((commands, "command"), (observations, "observation")):
        if (values == values[0]).all():
            raise DelayRLError(f"{path}: after a warm-up of {warm:g} s every {what} is constant")
    return commands, observations, log.episode[used]


def _interval(sums: Array, size: int, lags: int, row: float, seed: int) -> tuple[float, float]:
    """Return the 95 % interval of the dead time: blocks are drawn again, with replacement."""
    random, dead_times = np.random.default_rng(seed), []
    for _ in range(RESAMPLINGS):
        weights = np.bincount(random.integers(0, len(sums), len(sums)), minlength=len(sums)).astype(float)
        lag = correlate.onset(correlate.correlation(sums, size, lags, weights))
        if lag is not None:
            dead_times.append((lag - 1) * row)
    low, high = np.quantile(dead_times, (0.025, 0.975)) if dead_times else (0.0, lags * row)
    return max(0.0, float(low) - row), float(high) + row  # the log does not show what happens between two rows


def _renewed(observations: Array, episode: Array) -> float:
    """Return how many rows lie between two changes of the observation, the median."""
    changed = (observations[1:] != observations[:-1]).any(1) | (episode[1:] != episode[:-1])
    return float(np.median(np.diff(np.flatnonzero(changed)))) if changed.sum() > 1 else 1.0


def _pairs(
    log: reading.Log, commands: Array, observations: Array, episode: Array, lags: int, row: float
) -> tuple[tuple[Pair, ...], Array]:
    """Return all pairs, the strongest correlation of increments first, and the correlations of the first pair, [L]."""
    u, y = correlate.increments(commands, episode), correlate.increments(observations, episode)
    near = correlate.correlation(*correlate.blocks(u, y, lags, 1), lags).near
    pairs: list[tuple[Pair, Array]] = []
    for i, command in enumerate(log.command_names):
        for j, observation in enumerate(log.observation_names):
            lag, r = correlate.peak(near[:, i, j])
            pairs.append((Pair(command, observation, lag * row, r), near[:, i, j]))
    pairs.sort(key=lambda pair: -abs(pair[0].r))
    return tuple(pair for pair, _ in pairs), pairs[0][1]
