"""The dead time of a running system, from its commands to the first row that reacts, by correlation."""

from pathlib import Path

import numpy as np

from delayrl.errors import DelayRLError
from delayrl.measure import correlate, reading
from delayrl.measure.ages import rounded_up_steps
from delayrl.measure.correlate import Array
from delayrl.measure.estimated import Estimated, Pair

BLOCKS = 40
RESAMPLINGS = 200
LEAST_ROWS = 200
WINDOW_ROWS = 400  # least rows of a part of the log with its own estimate
WINDOWS = 8


def by_correlation(
    path: Path, log: reading.Log, row: float, period: float, longest: float | None, warm: float, seed: int
) -> Estimated:
    """Return the dead time of a log with a row every `row` seconds, up to `longest`, after `warm` seconds.

    For the arguments see `from_log`. Raises DelayRLError if the log is too short, or shows no delay beyond chance.
    """
    commands, observations, episode = _used(path, log, row, warm)
    rows = len(episode)
    lags = min(100, rows // 10) if longest is None else int(np.ceil(longest / row)) + 1
    if lags > rows // 6:
        tried = f"a delay of {lags * row:g} s: at most {rows // 6 * row:.3g} s"
        raise DelayRLError(f"{path}: {rows} rows of {row:g} s are too few to look for {tried}")
    u, y = correlate.innovations(commands, observations, episode)
    blocks = int(np.clip(rows // (2 * lags), WINDOWS, BLOCKS)) // WINDOWS * WINDOWS  # windows are whole blocks
    sums, products = correlate.blocks(u, y, lags, blocks)
    correlation = correlate.correlation(sums, products, lags)
    first = correlate.onset(correlation)
    if first is None:
        hint = "A longer log, other columns, or commands with some random variation may show one"
        unseen = f"no delay found up to {lags * row:.3g} s: no observation follows a command beyond chance"
        raise DelayRLError(f"{path}: {unseen}. {hint}")
    low, high = _interval(sums, products, lags, row, seed)
    windows = _windows(sums, products, lags, min(WINDOWS, rows // WINDOW_ROWS), row, warm)
    pairs, r = _pairs(log, commands, observations, episode, lags, row)
    strength = correlate.strength(correlation)[0]
    renewed, wait = _renewed(observations, episode, row, period)
    delay, steps = (first - 1) * row, tuple(rounded_up_steps(d - wait, period) for _, d in windows)
    spread = [d for _, d in windows] if len(windows) > 1 else [delay]
    fewest, most = np.quantile([rounded_up_steps(d - wait, period) for d in spread], (0.1, 0.9), method="nearest")
    shortest, slowest = np.quantile(spread, (0.1, 0.9))
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
        step=rounded_up_steps(delay - wait, period),
        span=(float(shortest), float(slowest) + row),
        step_span=(int(fewest), int(most)),
        strength=float(strength.max()),
        peak=pairs[0],
        pairs=pairs[:10],
        renewed=renewed,
        wait=wait,
        windows=windows,
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


def _interval(sums: Array, products: Array, lags: int, row: float, seed: int) -> tuple[float, float]:
    """Return the 95 % interval of the dead time: blocks are drawn again, with replacement."""
    random, dead_times = np.random.default_rng(seed), []
    for _ in range(RESAMPLINGS):
        weights = np.bincount(random.integers(0, len(sums), len(sums)), minlength=len(sums)).astype(float)
        lag = correlate.onset(correlate.correlation(sums, products, lags, weights))
        if lag is not None:
            dead_times.append((lag - 1) * row)
    low, high = np.quantile(dead_times, (0.025, 0.975)) if dead_times else (0.0, lags * row)
    return max(0.0, float(low) - row), float(high) + row  # the log does not show what happens between two rows


def _windows(
    sums: Array, products: Array, lags: int, count: int, row: float, warm: float
) -> tuple[tuple[float, float], ...]:
    """Return the middle, in seconds, and the dead time of each of `count` parts of the log that shows one."""
    windows, size = [], int(products.max())  # rows of a block
    for part in np.array_split(np.arange(len(sums)), count) if count > 1 else []:
        lag = correlate.onset(correlate.correlation(sums[part], products[part], lags))
        if lag is not None:
            windows.append((float(warm + part.mean() * size * row + size * row / 2), (lag - 1) * row))
    return tuple(windows)


def _renewed(observations: Array, episode: Array, row: float, period: float) -> tuple[float, float]:
    """Return the time between two changes of the observation, the median, and the `Estimated.wait` that follows.

    For the wait, nine of ten changes must be as far apart: a coarse encoder that moves slowly repeats some rows too.
    """
    changed = (observations[1:] != observations[:-1]).any(1) | (episode[1:] != episode[:-1])
    gaps = np.diff(np.flatnonzero(changed)) * row if changed.sum() > 1 else np.array([row])
    return float(np.median(gaps)), max(0.0, min(float(np.quantile(gaps, 0.1)), period) - row)


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
