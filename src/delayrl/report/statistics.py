"""Statistics of many runs, as functions on arrays (NumPy alone).

A *score* is one number for each run. Scores of several tasks are a list of arrays, one for each task: *strata*. Runs
of different tasks are never exchanged for each other when uncertainty is estimated. Method: Agarwal et al., "Deep
reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
NAN = math.nan


def mean_std(values: ArrayLike) -> tuple[float, float]:
    """Return the mean, and the standard deviation with n - 1; NaN without a value, or with only one."""
    x = np.asarray(values, float)
    return (float(x.mean()) if x.size else NAN), (float(x.std(ddof=1)) if x.size > 1 else NAN)


def normalised(returns: ArrayLike, random: float, reference: float) -> Floats:
    """Return the paper's Ret_nor, (R - random) / (reference - random); NaN unless reference > random."""
    x = np.asarray(returns, float)
    return (x - random) / (reference - random) if reference > random else np.full(x.shape, NAN)


def steps_to_threshold(steps: ArrayLike, returns: ArrayLike, threshold: float) -> Floats:
    """Return the first of the steps, [N], at which each curve, [..., N], reaches the threshold; NaN if none does."""
    steps, reached = np.asarray(steps, float), np.asarray(returns, float) >= threshold
    if not steps.size:
        return np.full(reached.shape[:-1], NAN)
    return np.where(reached.any(-1), steps[reached.argmax(-1)], NAN)


def interquartile_mean(scores: ArrayLike) -> Floats:
    """Average the middle half of the last axis: a quarter of the scores, rounded down, is cut at either end."""
    x = np.sort(np.asarray(scores, float), axis=-1)
    cut = x.shape[-1] // 4
    return x[..., cut : x.shape[-1] - cut].mean(-1)


def stratified_bootstrap(
    strata: Sequence[ArrayLike], statistic: Callable[[Floats], Floats], repetitions: int = 2000, seed: int = 0
) -> tuple[Floats, Floats]:
    """Estimate the 95 % percentile interval of a statistic of pooled scores, resampling runs within their stratum.

    Args:
        strata: scores of each task, at least one in each.
        statistic: of scores [repetitions, runs], along the last axis; returns [repetitions, ...].
        repetitions: how many resamples.
        seed: the same scores and seed give the same interval.

    Returns:
        Lower and upper bound; NaN where a stratum has fewer than two runs, because their spread is then unknown.
    """
    arrays = [np.asarray(scores, float) for scores in strata]
    random = np.random.default_rng(seed)
    drawn = [x[random.integers(x.size, size=(repetitions, x.size))] for x in arrays]
    values = statistic(np.concatenate(drawn, axis=-1))
    tail = 50 * (1 - 0.95)
    low, high = np.percentile(values, [tail, 100 - tail], axis=0)
    known = min(x.size for x in arrays) > 1
    return (low, high) if known else (np.full_like(low, NAN), np.full_like(high, NAN))


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Floats:
    """Return the fraction of the scores, [..., runs], above each threshold, [T], as [..., T]."""
    x, thresholds = np.sort(np.asarray(scores, float), axis=-1), np.asarray(thresholds, float)
    flat = x.reshape(-1, x.shape[-1])
    above = np.stack([x.shape[-1] - np.searchsorted(row, thresholds, side="right") for row in flat])
    return (above / x.shape[-1]).reshape(*x.shape[:-1], thresholds.size)


def common_steps(runs: Sequence[Mapping[int, float]]) -> tuple[NDArray[np.int64], Floats]:
    """Return the steps that all runs have, [N], and the returns there, [runs, N]: every mean is over the same runs."""
    if not runs:
        return np.zeros(0, np.int64), np.zeros((0, 0))
    steps = sorted(set(runs[0]).intersection(*runs[1:]))
    return np.array(steps, np.int64), np.array([[run[step] for step in steps] for run in runs], float)
