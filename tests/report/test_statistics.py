"""Statistics of many runs: numbers worked out by hand, and the same by brute force."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from delayrl.report import statistics as s

FLOATS = st.floats(-1e6, 1e6)


def test_mean_and_sample_deviation() -> None:
    assert s.mean_std([1, 2, 3, 6]) == (3.0, pytest.approx(math.sqrt(14 / 3)))
    mean, std = s.mean_std([7])
    assert mean == 7
    assert math.isnan(std)
    assert all(math.isnan(x) for x in s.mean_std([]))


def test_normalised_by_hand() -> None:
    np.testing.assert_allclose(s.normalised([-43, -7, -25, 11], -43, -7), [0, 1, 0.5, 1.5])


def test_no_normalised_return_where_the_reference_is_not_better_than_random() -> None:
    assert np.isnan(s.normalised([1.0, 2.0], 5, 5)).all()
    assert np.isnan(s.normalised([1.0, 2.0], 5, 4)).all()


def test_steps_to_threshold_is_the_first_crossing() -> None:
    curves = [[0, 5, 3, 9], [0, 1, 2, 3], [5, 0, 0, 0]]
    np.testing.assert_array_equal(s.steps_to_threshold([10, 20, 30, 40], curves, 5), [20, math.nan, 10])
    assert math.isnan(s.steps_to_threshold([], [], 5))


def test_interquartile_mean_by_hand() -> None:
    assert s.interquartile_mean([8, 1, 100, 2, 3, 4, -50, 5]) == (2 + 3 + 4 + 5) / 4
    assert s.interquartile_mean([4]) == 4
    assert s.interquartile_mean([1, 2, 9]) == 4  # a quarter of three is none


@given(st.lists(FLOATS, min_size=1, max_size=40))
def test_interquartile_mean_is_scipys_trimmed_mean(scores: list[float]) -> None:
    assert s.interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25), rel=1e-9, abs=1e-6)


def test_bootstrap_agrees_with_every_possible_resample() -> None:
    """Two tasks of three runs: 27 × 27 equally likely resamples, all of them counted."""
    strata = [np.array([0.0, 1.0, 5.0]), np.array([10.0, 11.0, 30.0])]
    every = [
        stats.trim_mean([*a, *b], 0.25)
        for a in itertools.product(strata[0], repeat=3)
        for b in itertools.product(strata[1], repeat=3)
    ]
    low, high = s.stratified_bootstrap(strata, s.interquartile_mean, repetitions=40_000)
    exact = np.percentile(every, [2.5, 97.5])
    np.testing.assert_allclose([low, high], exact, atol=0.3)


def test_bootstrap_agrees_with_scipy() -> None:
    scores = np.random.default_rng(1).normal(size=30)
    low, high = s.stratified_bootstrap([scores], s.interquartile_mean, repetitions=20_000)
    reference = stats.bootstrap(
        (scores,), lambda x, axis: s.interquartile_mean(x), method="percentile", n_resamples=20_000, rng=2
    ).confidence_interval
    np.testing.assert_allclose([low, high], [reference.low, reference.high], atol=0.03)


def test_bootstrap_keeps_runs_in_their_task() -> None:
    """Tasks that differ and whose runs do not: resampling within them changes nothing."""
    low, high = s.stratified_bootstrap([[1, 1, 1], [9, 9, 9]], lambda x: x.mean(-1))
    assert low == high == 5


def test_bootstrap_covers_as_often_as_it_says() -> None:
    random = np.random.default_rng(0)
    hits = 0
    for trial in range(200):
        low, high = s.stratified_bootstrap(
            [random.normal(size=25), random.normal(3, 1, 25)], lambda x: x.mean(-1), 400, seed=trial
        )
        hits += low <= 1.5 <= high
    assert 0.88 <= hits / 200 <= 0.99


def test_one_run_has_no_interval() -> None:
    assert all(np.isnan(s.stratified_bootstrap([[1.0, 2.0], [3.0]], s.interquartile_mean)))


def test_performance_profile_by_hand() -> None:
    np.testing.assert_allclose(s.performance_profile([0.5, 1.0, 1.5, 2.0], [0, 1, 2, 3]), [1, 0.5, 0, 0])
    batch = s.performance_profile([[0.0, 1.0], [2.0, 3.0]], [0.5, 2.5])
    np.testing.assert_allclose(batch, [[0.5, 0], [1, 0.5]])


@given(st.lists(FLOATS, min_size=1, max_size=20), st.lists(FLOATS, min_size=1, max_size=10))
def test_performance_profile_counts(scores: list[float], thresholds: list[float]) -> None:
    counted = [sum(score > t for score in scores) / len(scores) for t in thresholds]
    np.testing.assert_allclose(s.performance_profile(scores, thresholds), counted)


def test_curves_share_their_steps() -> None:
    steps, curves = s.common_steps([{10: 1, 20: 2, 30: 3}, {30: 6, 10: 5, 40: 7}])
    assert steps.tolist() == [10, 30]
    assert curves.tolist() == [[1, 3], [5, 6]]
    steps, curves = s.common_steps([])
    assert steps.size == 0
    assert curves.shape == (0, 0)
