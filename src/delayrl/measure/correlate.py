"""Dead time from signals: when does an observation first know of a command?

Levels of two slow signals correlate at any lag. So both are reduced to what is new in each row: an *innovation*, what
a linear model of the signal's own past does not predict. (The increment is the innovation of a random walk; the model
is fitted instead of assumed.) The model of the commands has the observations too, so that what a policy only reads off
the observations is no news: without that, feedback looks like an effect. The cross-correlation of the innovations is
then the response to a command with the signal's own inertia removed, and

    onset: the first lag that is significant, and at least a fifth of the strongest

is where the dead time ends. The null distribution comes from the same signals shifted by more than any delay that is
looked for. `docs/measure.md` has the accuracy of this, and of simpler ways, on plants with a known delay.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MEMORY = 10  # rows of the past in a model, fewer where the log is short for its width
CHANCE = 1e-3  # that one of all lags of unrelated signals is taken for an onset
SHARE = 0.2  # of the strongest lag that the onset must have: nonlinear feedback leaves traces before it
OUTLIER = 5.0  # standard deviations at which innovations are cut: falls, collisions, wrap-around of angles


@dataclass(frozen=True)
class Correlation:
    """Correlations of lagged commands with observations: r[lag, command, observation], lags in rows.

    `near` are lags 1..L, `far` are lags beyond 2L, where only chance correlates; both are from `rows` rows.
    """

    near: Array
    far: Array
    rows: float


def increments(values: Array, episode: Array) -> Array:
    """Differences from row to row, standardised; zero where a new episode begins."""
    change = np.diff(values, axis=0, prepend=values[:1])
    change[1:][episode[1:] != episode[:-1]] = 0
    return _standard(change)


def innovations(commands: Array, observations: Array, episode: Array) -> tuple[Array, Array]:
    """What is new in each row of both, standardised, [N, U] and [N, Y]; zero where an episode is too young to say.

    A command that is held for rows is news only where it changes: between changes there is nothing to be predicted.
    """
    u, y = _standard(commands), _standard(observations)
    whole = np.ones(len(u), bool)
    whole[:MEMORY] = False
    for back in range(1, MEMORY + 1):
        whole[back:] &= episode[back:] == episode[:-back]
    changes = np.diff(commands, axis=0, prepend=np.nan).any(1)
    event: Mask = whole & changes if changes.mean() < 0.5 else whole
    size = u.shape[1] + y.shape[1]
    memory, for_y = (int(np.clip(rows.sum() // (20 * size), 1, MEMORY)) for rows in (event, whole))
    new_u = _unpredicted(u, np.concatenate([_past(np.concatenate([u, y], 1), memory), y], 1), event)
    others = _past(y, for_y)
    own = [np.concatenate([_past(y[:, [j]], MEMORY), others], 1) for j in range(y.shape[1])]
    new_y = np.concatenate([_unpredicted(y[:, [j]], own[j], whole) for j in range(y.shape[1])], 1)
    return _standard(new_u, event) * (len(u) / max(int(event.sum()), 1)) ** 0.5, _standard(new_y, whole)


def blocks(u: Array, y: Array, longest: int, count: int) -> tuple[Array, Array]:
    """Sums of products of lagged u and y in `count` consecutive blocks of rows.

    Returns:
        sums [count, lags, U, Y] for lags 1..longest and then as many far ones as there is room for; rows of each block.
    """
    size = len(u) // count
    rows = size * count
    lags = [*range(1, longest + 1), *_far(longest, rows)]
    sums = np.empty((count, len(lags), u.shape[1], y.shape[1]))
    target = y[:rows].reshape(count, size, -1)
    for i, lag in enumerate(lags):
        late = np.zeros((rows, u.shape[1]))
        late[lag:] = u[: rows - lag]
        sums[:, i] = late.reshape(count, size, -1).transpose(0, 2, 1) @ target
    return sums, np.full(count, float(size))


def correlation(sums: Array, rows: Array, longest: int, weights: Array | None = None) -> Correlation:
    """Correlations over blocks, each counted `weights` times."""
    weights = np.ones(len(sums)) if weights is None else weights
    total = float(weights @ rows)
    r = np.tensordot(weights, sums, 1) / total
    return Correlation(r[:longest], r[longest:], total)


def strength(c: Correlation) -> tuple[Array, Array]:
    """Significance of each near lag, above 1 if it is no chance, and its share of the strongest lag, both [L].

    Two statistics: the sum of squares over all pairs (many pairs answer) and the largest square (one pair does).
    """
    lags, pairs = len(c.near), c.near[0].size
    chance = CHANCE / 2 / lags
    spread = np.maximum(c.rows * (c.far**2).mean(0), 1.0)  # of N r², 1 for white signals
    near, far = c.rows * c.near**2 / spread, c.rows * c.far**2 / spread
    total, null = near.sum((1, 2)), far.sum((1, 2))
    excess = np.maximum(total - null.mean(), 0)
    by_sum = excess / (_tail(null, chance) - null.mean())
    by_one = near.max((1, 2)) / NormalDist().inv_cdf(1 - chance / pairs / 2) ** 2
    return np.maximum(by_sum, by_one), excess / max(excess.max(), 1e-12)


def onset(c: Correlation) -> int | None:
    """First lag, in rows, at which observations know of a command: the dead time is between it and one row less."""
    significance, share = strength(c)
    found = np.flatnonzero((significance > 1) & (share > SHARE))
    return int(found[0]) + 1 if found.size else None


def resampled(sums: Array, rows: Array, longest: int, times: int, random: np.random.Generator) -> Iterator[Correlation]:
    """Block bootstrap: correlations over blocks drawn with replacement."""
    for _ in range(times):
        weights = np.bincount(random.integers(0, len(sums), len(sums)), minlength=len(sums)).astype(float)
        yield correlation(sums, rows, longest, weights)


def peak(r: Array) -> tuple[float, float]:
    """Lag of the largest |r| of lags 1..L, between rows by a parabola through three, and that r (with its sign)."""
    i = int(np.argmax(np.abs(r)))
    shift = 0.0
    if 0 < i < len(r) - 1:
        before, top, after = np.abs(r[i - 1 : i + 2])
        bend = before - 2 * top + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return i + 1 + float(shift), float(r[i])


def _far(longest: int, rows: int) -> range:
    return range(2 * longest + 1, max(2 * longest + 2, min(rows // 2, 2 * longest + max(200, 2 * longest))))


def _tail(null: Array, chance: float) -> float:
    """What a sum of squares exceeds with this chance: a scaled χ² with the null's mean and variance."""
    mean, variance = float(null.mean()), max(float(null.var()), 1e-12)
    freedom = 2 * mean**2 / variance
    # by Wilson and Hilferty's cube root
    z, c = NormalDist().inv_cdf(1 - chance), 2 / (9 * freedom)
    return mean * (1 - c + z * c**0.5) ** 3


def _past(values: Array, memory: int) -> Array:
    """Rows t-1 … t-memory beside each other, [N, memory · columns]; zeros before the first."""
    padded = np.concatenate([np.zeros((memory, values.shape[1])), values])
    return np.concatenate([padded[memory - back : len(padded) - back] for back in range(1, memory + 1)], 1)


def _unpredicted(target: Array, known: Array, whole: Mask) -> Array:
    """Residual of a least-squares fit over the rows where `whole`; zero elsewhere."""
    rest = np.zeros_like(target)
    a, b = known[whole], target[whole]
    a, b = a - a.mean(0), b - b.mean(0)
    gram = a.T @ a
    gram[np.diag_indices_from(gram)] += 1e-8 * np.trace(gram) / len(gram) + 1e-12
    rest[whole] = b - a @ np.linalg.solve(gram, a.T @ b)
    return rest


def _standard(values: Array, counted: Mask | None = None) -> Array:
    """Mean 0 and deviation 1 over the counted rows, outliers cut; columns that do not vary become zero."""
    chosen = values if counted is None else values[counted]
    spread = chosen.std(0)
    alive = spread > 1e-12 * (1 + np.abs(chosen).max(0))
    scaled = np.where(alive, (values - chosen.mean(0)) / np.where(alive, spread, 1), 0)
    if counted is None:
        return scaled
    scaled[np.logical_not(counted)] = 0
    return np.clip(scaled, -OUTLIER, OUTLIER)
