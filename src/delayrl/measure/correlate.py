"""Estimate dead time from signals: after how many rows does an observation first react to a command?

The levels of two slow signals correlate at any lag. So both signals are reduced to their *innovations*: the part of
each row that a linear model of the past does not predict. (The innovation of a random walk is its increment; here the
model is fitted, not assumed.) The model of the commands also reads the observations. Otherwise the feedback of a policy
would look like an effect of its commands. The cross-correlation of the innovations is then the response to a command
without the signal's own inertia. The dead time ends at the

    onset: the first lag that is significant and at least a fifth as strong as the strongest.

The null distribution comes from the same signals, shifted by more than the longest delay in question. `docs/measure.md`
has the accuracy of this and of simpler methods, on plants with a known delay.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ORDER = 10  # rows of the past in a model; fewer if the log is short for its width
ECHO = 0.95  # correlation of increments at which an observation is a command that comes back, and no plant's answer
CHANCE = 1e-3  # probability that any lag of unrelated signals is taken for an onset; about 5e-3 with 200 rows
SHARE = 0.2  # least strength of the onset, relative to the strongest lag: nonlinear feedback leaves traces before it
OUTLIER = 5.0  # standard deviations at which innovations are clipped: falls, collisions, wrap-around of angles


@dataclass(frozen=True)
class Correlation:
    """Correlations of lagged commands with observations, [lags, U, Y]; lags are in rows.

    `near` has the lags 1..L. `far` has lags beyond 2L, where only chance correlates. Both come from `rows` rows.
    """

    near: Array
    far: Array
    rows: float


def increments(values: Array, episode: Array) -> Array:
    """Return the standardised differences between rows; zero where a new episode begins."""
    change = np.diff(values, axis=0, prepend=values[:1])
    change[1:][episode[1:] != episode[:-1]] = 0
    return _standard(change)


def echoes(commands: Array, observations: Array, episode: Array) -> Mask:
    """Return which observations repeat a command of their row or the one before it, such as a set-point: [Y].

    The one before is a row back, or as many rows as commands are held. Increments of smooth commands are like those of
    some rows later, so an echo is most like a command at once.
    """
    u, y = increments(commands, episode), increments(observations, episode)
    held = np.diff(np.flatnonzero(np.diff(commands, axis=0).any(1)))
    before = int(np.median(held)) if len(held) else 1
    lags = [lag for lag in sorted({*range(2 * ORDER), before}) if lag < len(u)]
    r = np.abs([u[: len(u) - lag].T @ y[lag:] / len(u) for lag in lags])
    early = r[np.isin(lags, (0, 1, before))].max(0)
    return ((early > ECHO) & (early >= r.max(0))).any(0)


def innovations(commands: Array, observations: Array, episode: Array) -> tuple[Array, Array]:
    """Return the standardised innovations of both signals, [N, U] and [N, Y].

    They are zero in the first rows of an episode, where the past is too short. If commands are held for several rows,
    only the rows where they change count.
    """
    u, y = _standard(commands), _standard(observations)
    has_past = np.ones(len(u), bool)
    has_past[:ORDER] = False
    for back in range(1, ORDER + 1):
        has_past[back:] &= episode[back:] == episode[:-back]
    changes = np.diff(commands, axis=0, prepend=np.nan).any(1)
    commanded: Mask = has_past & changes if changes.mean() < 0.5 else has_past
    size = u.shape[1] + y.shape[1]
    u_order, y_order = (int(np.clip(rows.sum() // (20 * size), 1, ORDER)) for rows in (commanded, has_past))
    new_u = _residual(u, np.concatenate([_past(np.concatenate([u, y], 1), u_order), y], 1), commanded)
    others = _past(y, y_order)
    own = [np.concatenate([_past(y[:, [j]], ORDER), others], 1) for j in range(y.shape[1])]
    new_y = np.concatenate([_residual(y[:, [j]], own[j], has_past) for j in range(y.shape[1])], 1)
    return _standard(new_u, commanded) * (len(u) / max(int(commanded.sum()), 1)) ** 0.5, _standard(new_y, has_past)


def blocks(u: Array, y: Array, longest: int, count: int) -> tuple[Array, Array]:
    """Return sums of products of lagged u and y in `count` blocks of rows, [count, lags, U, Y], and of how many.

    The lags are 1..longest, followed by far lags, as many as the log allows. The first rows have no product at a lag.
    """
    size = len(u) // count
    rows = size * count
    far = range(2 * longest + 1, max(2 * longest + 2, min(rows // 2, 2 * longest + max(200, 2 * longest))))
    lags = [*range(1, longest + 1), *far]
    sums = np.empty((count, len(lags), u.shape[1], y.shape[1]))
    target = y[:rows].reshape(count, size, -1)
    for i, lag in enumerate(lags):
        lagged = np.zeros((rows, u.shape[1]))
        lagged[lag:] = u[: rows - lag]
        sums[:, i] = lagged.reshape(count, size, -1).transpose(0, 2, 1) @ target
    ends = size * np.arange(1, count + 1)[:, None]
    return sums, np.clip(ends - np.array(lags), 0, size)


def correlation(sums: Array, products: Array, longest: int, weights: Array | None = None) -> Correlation:
    """Combine blocks of products into correlations; each block counts `weights` times, [count].

    A sum of fewer products is scaled as if chance had more, so that N r² of unrelated signals is alike at all lags. Far
    lags with less than half of the most are left out.
    """
    weights = np.ones(len(sums)) if weights is None else weights
    total = weights @ products
    rows = float(total.max())
    r = np.tensordot(weights, sums, 1) / np.sqrt(np.maximum(total, 1) * rows)[:, None, None]
    known = total[longest:] >= min(rows / 2, total[longest:].max())
    return Correlation(r[:longest], r[longest:][known], rows)


def strength(c: Correlation) -> tuple[Array, Array]:
    """Return the significance of each near lag, and its strength relative to the strongest lag, both [L].

    A lag is significant above 1. The significance is the larger of two statistics: the sum of squares over all pairs,
    for an effect on many pairs, and the largest square, for an effect on a single one.
    """
    lags, pairs = len(c.near), c.near[0].size
    chance = CHANCE / 2 / lags
    spread = np.maximum(c.rows * (c.far**2).mean(0), 1.0)  # of N r², 1 for white signals
    near, far = c.rows * c.near**2 / spread, c.rows * c.far**2 / spread
    total, null = near.sum((1, 2)), far.sum((1, 2))
    excess = np.maximum(total - null.mean(), 0)
    by_sum = excess / (_tail(null, chance) - null.mean())
    by_largest = near.max((1, 2)) / NormalDist().inv_cdf(1 - chance / pairs / 2) ** 2
    return np.maximum(by_sum, by_largest), excess / max(excess.max(), 1e-12)


def onset(c: Correlation) -> int | None:
    """Return the lag, in rows, at which observations first react to a command; the dead time is up to a row less."""
    significance, share = strength(c)
    lags = np.flatnonzero((significance > 1) & (share > SHARE)) + 1
    return int(lags[0]) if lags.size else None


def peak(r: Array) -> tuple[float, float]:
    """Return the lag with the largest |r| of lags 1..L, refined by a parabola through three lags, and the r there."""
    i = int(np.argmax(np.abs(r)))
    shift = 0.0
    if 0 < i < len(r) - 1:
        before, top, after = np.abs(r[i - 1 : i + 2])
        bend = before - 2 * top + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return i + 1 + float(shift), float(r[i])


def _tail(null: Array, chance: float) -> float:
    """Return what a sum of squares exceeds with this probability, for a scaled χ² with the null's mean and variance."""
    mean, variance = float(null.mean()), max(float(null.var()), 1e-12)
    if mean <= 0:  # these rows have no far lags, so nothing is known of chance
        return math.inf
    freedom = 2 * mean**2 / variance
    z, c = NormalDist().inv_cdf(1 - chance), 2 / (9 * freedom)
    return mean * (1 - c + z * c**0.5) ** 3  # the cube-root approximation of Wilson and Hilferty


def _past(values: Array, order: int) -> Array:
    """Return the rows t-1 … t-order side by side, [N, order · columns]; zeros before the first row."""
    padded = np.concatenate([np.zeros((order, values.shape[1])), values])
    return np.concatenate([padded[order - back : len(padded) - back] for back in range(1, order + 1)], 1)


def _residual(target: Array, known: Array, rows: Mask) -> Array:
    """Return the residual of a least-squares fit over the chosen rows; zero elsewhere."""
    residual = np.zeros_like(target)
    a, b = known[rows], target[rows]
    a, b = a - a.mean(0), b - b.mean(0)
    gram = a.T @ a
    gram[np.diag_indices_from(gram)] += 1e-8 * np.trace(gram) / len(gram) + 1e-12
    residual[rows] = b - a @ np.linalg.solve(gram, a.T @ b)
    return residual


def _standard(values: Array, counted: Mask | None = None) -> Array:
    """Scale columns to mean 0 and deviation 1, and to zero if constant; with `counted` rows, also clip outliers."""
    chosen = values if counted is None else values[counted]
    spread = chosen.std(0)
    varies = spread > 1e-12 * (1 + np.abs(chosen).max(0))
    scaled = np.where(varies, (values - chosen.mean(0)) / np.where(varies, spread, 1), 0)
    if counted is None:
        return scaled
    scaled[np.logical_not(counted)] = 0
    return np.clip(scaled, -OUTLIER, OUTLIER)
