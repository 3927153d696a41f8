"""Estimate the delay of a running system from its log: exactly from stamps of the observations, or by correlation."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral, Real
from pathlib import Path

import numpy as np

from delayrl.errors import DelayRLError, DelayWarning
from delayrl.measure import correlate, reading
from delayrl.measure.dead_time import by_correlation
from delayrl.measure.estimated import Estimated
from delayrl.measure.stamps import by_stamps


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
        estimated = by_stamps(path, *exact, period, warm_up)
    else:
        log, row = reading.resample(reading.read_signals(table, time, commands, observations, episode, unit))
        log, echoes = _without_echoes(log)
        warm = reading.WARM_UP * len(log.time) * row if warm_up is None else warm_up
        estimated = replace(by_correlation(path, log, row, period or row, longest, warm, seed), echoes=echoes)
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
