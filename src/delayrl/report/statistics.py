"""Statistics of many runs, as functions on arrays.

A *score* is one number for each run: its normalised return. Runs of different tasks are never exchanged for each other
when uncertainty is estimated: they are different *strata*. Method: Agarwal et al., "Deep reinforcement learning at the
edge of the statistical precipice", NeurIPS 2021. The anchors that a return is normalised by are runs too, and are
resampled with the others. Intervals are expanded for few runs: Hesterberg, "What teachers should know about the
bootstrap", The American Statistician 69, 2015.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, stdtrit

Floats = NDArray[np.float64]
NAN = math.nan
SMOOTHED = 5
"""Evaluations that a smoothed curve averages."""
REPETITIONS = 20_000
"""Resamples of a bootstrap. With 5,000, chance decided the bounds of five runs, which lie at half a percent."""
FEWEST = 5
"""With fewer runs of either of two agents, an interval of which is better would mislead."""


class Stratum(NamedTuple):
    """Runs of one task: returns of its anchors, [seeds], and of each condition that is normalised by them, [runs]."""

    random: Floats
    reference: Floats
    returns: Sequence[Floats]


def mean_std(values: ArrayLike) -> tuple[float, float]:
    """Return the mean, and the standard deviation with n - 1; NaN without a value, or with only one."""
    x = np.asarray(values, float)
    return (float(x.mean()) if x.size else NAN), (float(x.std(ddof=1)) if x.size > 1 else NAN)


def normalised(returns: ArrayLike, random: float, reference: float) -> Floats:
    """Return the paper's Ret_nor, (R - random) / (reference - random); NaN unless reference > random."""
    x = np.asarray(returns, float)
    return (x - random) / (reference - random) if reference > random else np.full(x.shape, NAN)


def steps_to_threshold(steps: ArrayLike, returns: ArrayLike, threshold: ArrayLike) -> Floats:
    """Return the first of the steps, [N], at which each curve, [..., N], reaches the threshold; NaN if none does."""
    steps, reached = np.asarray(steps, float), np.asarray(returns, float) >= threshold
    if not steps.size:
        return np.full(reached.shape[:-1], NAN)
    return np.where(reached.any(-1), steps[reached.argmax(-1)], NAN)


def smoothed(returns: ArrayLike) -> Floats:
    """Average each evaluation of curves, [..., N], with the SMOOTHED - 1 before it, or as many as there are."""
    x = np.asarray(returns, float)
    return np.stack([x[..., max(0, n - SMOOTHED) : n].mean(-1) for n in range(1, x.shape[-1] + 1)], -1)


def area(steps: ArrayLike, returns: ArrayLike) -> Floats:
    """Return the area under curves, [..., N], divided by the last of the steps, [N]: the mean return over training.

    Each evaluation stands for the steps since the one before it. NaN if there was none after step 0.
    """
    lengths = np.diff(np.asarray(steps, float), prepend=0)
    return np.asarray(returns, float) @ lengths / (lengths.sum() or NAN)


def interquartile_mean(scores: ArrayLike) -> Floats:
    """Average the middle half of the last axis: a quarter of the scores, rounded down, is cut at either end."""
    x = np.sort(np.asarray(scores, float), axis=-1)
    cut = x.shape[-1] // 4
    return x[..., cut : x.shape[-1] - cut].mean(-1)


def stratified_bootstrap(strata: Sequence[Stratum], statistic: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Estimate the 95 % interval of a statistic of pooled scores.

    Resamples runs within their condition, and the runs of the anchors, whose means then normalise all conditions of
    their stratum. The same returns always give the same interval.

    Args:
        strata: one for each task, with at least one run in each of its arrays.
        statistic: of scores [REPETITIONS, runs], along the last axis; returns [REPETITIONS, ...].

    Returns:
        Lower and upper bound. NaN where a condition or an anchor has fewer than two runs, because their spread is then
        unknown, and where the reference is no better than random in a resample.
    """
    random = np.random.default_rng(0)
    scores, known = [], True
    for stratum in strata:
        low, high = (_resample(random, x).mean(1, keepdims=True) for x in stratum[:2])
        scores += [(_resample(random, x) - low) / np.where(high > low, high - low, 1) for x in stratum.returns]
        sizes = [x.size for x in (stratum.random, stratum.reference, *stratum.returns)]
        known = known and min(sizes) > 1 and bool((high > low).all())
    percentiles = expanded_percentiles([x.size for stratum in strata for x in stratum.returns])
    low, high = np.percentile(statistic(np.concatenate(scores, axis=-1)), percentiles, axis=0)
    return (low, high) if known else (np.full_like(low, NAN), np.full_like(high, NAN))


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """Estimate the 95 % interval of a mean by resampling its values; NaN with fewer than two."""
    x = np.asarray(values, float)
    if x.size < 2:
        return NAN, NAN
    means = _resample(np.random.default_rng(0), x).mean(1)
    low, high = np.percentile(means, expanded_percentiles([x.size]))
    return float(low), float(high)


def bootstrap_steps(steps: ArrayLike, curves: Floats, reference: Floats) -> tuple[float, float]:
    """Estimate the 95 % interval of the step at which the mean of curves reaches the mean of a reference.

    Args:
        steps: of the evaluations, [N].
        curves: [runs, N], resampled by runs.
        reference: returns of the reference's runs, [seeds], resampled too.

    Returns:
        Lower and upper bound, each one of the steps, or infinite where the curve does not reach the reference. NaN with
        fewer than two runs or seeds.
    """
    if min(len(curves), len(reference)) < 2:
        return NAN, NAN
    random = np.random.default_rng(0)
    means = _resample(random, curves).mean(1)
    thresholds = _resample(random, reference).mean(1, keepdims=True)
    reached = np.nan_to_num(steps_to_threshold(steps, means, thresholds), nan=math.inf)
    # a method that interpolates nothing
    low, high = np.percentile(reached, expanded_percentiles([len(curves)]), method="inverted_cdf")
    return float(low), float(high)


def probability_of_improvement(one: ArrayLike, other: ArrayLike) -> Floats:
    """Return how often a run of `one`, [..., n], is above a run of `other`, [..., m]; a tie counts half."""
    x, y = np.asarray(one, float), np.asarray(other, float)
    return (1 + np.sign(x[..., :, None] - y[..., None, :]).mean((-1, -2))) / 2


def improvement_interval(pairs: Sequence[tuple[Floats, Floats]]) -> tuple[float, float]:
    """Estimate the 95 % interval of the mean probability of improvement over tasks.

    Args:
        pairs: final returns of two agents, [n] and [m], for each task; runs are resampled within their agent and task.

    Returns:
        Lower and upper bound; NaN with fewer than FEWEST runs of either on a task.
    """
    if min(x.size for pair in pairs for x in pair) < FEWEST:
        return NAN, NAN
    random = np.random.default_rng(0)
    resampled = [[_resample(random, x) for x in pair] for pair in pairs]
    means = np.mean([probability_of_improvement(*pair) for pair in resampled], axis=0)
    low, high = np.percentile(means, expanded_percentiles([x.size for pair in pairs for x in pair]))
    return float(low), float(high)


def expanded_percentiles(sizes: Sequence[int]) -> tuple[float, float]:
    """Return the percentiles of resamples at which a 95 % interval ends, given how many runs each condition has.

    Resamples of few runs vary too little: by (n - 1) / n of the variance, and by the normal distribution's quantiles
    instead of Student's. Both are made up for (Hesterberg 2015); with many runs it is 2.5 and 97.5.
    """
    runs = sum(sizes)
    freedom = runs - len(sizes)
    tail = 100 * float(ndtr(-stdtrit(freedom, 0.975) * math.sqrt(runs / freedom))) if freedom else 0.0
    return tail, 100 - tail


def _resample(random: np.random.Generator, values: Floats) -> Floats:
    """Draw as many of the values, along the first axis, as there are, with replacement: [REPETITIONS, ...]."""
    return values[random.integers(len(values), size=(REPETITIONS, len(values)))]


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Floats:
    """Return the fraction of the scores, [..., runs], above each threshold, [T], as [..., T]."""
    x = np.asarray(scores, float)
    return np.stack([(x > threshold).mean(-1) for threshold in np.asarray(thresholds, float)], -1)


def common_steps(runs: Sequence[Mapping[int, float]]) -> tuple[NDArray[np.int64], Floats]:
    """Return the steps that all runs have, [N], and the returns there, [runs, N]: every mean is over the same runs."""
    if not runs:
        return np.zeros(0, np.int64), np.zeros((0, 0))
    steps = sorted(set(runs[0]).intersection(*runs[1:]))
    return np.array(steps, np.int64), np.array([[run[step] for step in steps] for run in runs], float)
