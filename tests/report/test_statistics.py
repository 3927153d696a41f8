"""Statistics of many runs: numbers worked out by hand, and the same by brute force."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy import stats

from delayrl.report import statistics as s

FLOATS = st.floats(-1e6, 1e6)


def sure(*scores: ArrayLike) -> list[s.Stratum]:
    """Tasks whose anchors are known exactly, 0 and 1, so that returns are scores."""
    return [s.Stratum(np.zeros(2), np.ones(2), [np.asarray(x, float)]) for x in scores]


def mean(scores: s.Floats) -> s.Floats:
    return scores.mean(-1)


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


def test_smoothed_by_hand() -> None:
    np.testing.assert_allclose(s.smoothed([1, 2, 3, 4, 5, 6, 12]), [1, 1.5, 2, 2.5, 3, 4, 6])
    np.testing.assert_allclose(s.smoothed([[7.0] * 9, [1.0, 2] + [3] * 7])[:, :2], [[7, 7], [1, 1.5]])


def test_area_by_hand() -> None:
    """Each evaluation stands for the steps since the one before."""
    np.testing.assert_allclose(s.area([10, 20, 40], [[1, 2, 5], [3, 3, 3]]), [(10 + 20 + 100) / 40, 3])


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
    low, high = s.stratified_bootstrap(sure(*strata), s.interquartile_mean)
    exact = np.percentile(every, s.expanded_percentiles([3, 3]))
    np.testing.assert_allclose([low, high], exact, atol=0.3)


def test_bootstrap_agrees_with_scipy() -> None:
    scores = np.random.default_rng(1).normal(size=30)
    low, high = s.stratified_bootstrap(sure(scores), s.interquartile_mean)
    reference = stats.bootstrap(
        (scores,),
        lambda x, axis: s.interquartile_mean(x),
        method="percentile",
        confidence_level=1 - s.expanded_percentiles([30])[0] / 50,
        n_resamples=20_000,
        rng=2,
    ).confidence_interval
    np.testing.assert_allclose([low, high], [reference.low, reference.high], atol=0.03)


def test_bootstrap_keeps_runs_in_their_task() -> None:
    """Tasks that differ and whose runs do not: resampling within them changes nothing."""
    low, high = s.stratified_bootstrap(sure([1, 1, 1], [9, 9, 9]), mean)
    assert low == high == 5


def test_anchors_are_resampled_with_the_runs() -> None:
    """Two runs each of agent, random and reference: 4 × 4 × 4 equally likely resamples, all of them counted."""
    returns, random, reference = np.array([40.0, 70.0]), np.array([0.0, 10.0]), np.array([90.0, 130.0])
    twice = [list(itertools.product(x, repeat=2)) for x in (returns, random, reference)]
    every = [(np.mean(x) - np.mean(r)) / (np.mean(df) - np.mean(r)) for x, r, df in itertools.product(*twice)]
    low, high = s.stratified_bootstrap([s.Stratum(random, reference, [returns])], mean)
    np.testing.assert_allclose([low, high], np.percentile(every, s.expanded_percentiles([2])), atol=0.02)


def test_conditions_of_one_task_share_its_anchors() -> None:
    """Equal returns differ by nothing then; with anchors drawn for each, they would."""
    anchors, returns = (np.array([0.0, 1.0]), np.array([9.0, 15.0])), np.array([5.0, 5.0])
    difference = lambda x: x[..., :2].mean(-1) - x[..., 2:].mean(-1)  # noqa: E731
    assert s.stratified_bootstrap([s.Stratum(*anchors, [returns, returns])], difference) == (0, 0)
    low, high = s.stratified_bootstrap([s.Stratum(*anchors, [returns])] * 2, difference)
    assert low < 0 < high


def test_no_interval_where_the_reference_may_be_worse_than_random() -> None:
    stratum = s.Stratum(np.array([0.0, 10.0]), np.array([5.0, 50.0]), [np.array([20.0, 30.0])])
    assert all(np.isnan(s.stratified_bootstrap([stratum], mean)))


@pytest.mark.parametrize("runs", [5, 25])
def test_bootstrap_covers_as_often_as_it_says(runs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain percentile interval of five runs covers a mean 84 times in 100."""
    monkeypatch.setattr(s, "REPETITIONS", 2000)
    random = np.random.default_rng(0)
    hits = {2: 0, 1: 0}
    for _ in range(400):
        both = sure(random.normal(size=runs), random.normal(3, 1, runs))
        for tasks, middle in ((2, 1.5), (1, 0)):
            low, high = s.stratified_bootstrap(both[:tasks], mean)
            hits[tasks] += low <= middle <= high
    for found in hits.values():
        assert 0.90 <= found / 400 <= 0.98


def test_percentiles_of_few_runs_are_expanded() -> None:
    """An interval of five runs ends at the percentiles 0.1 and 99.9, of very many at 2.5 and 97.5."""
    low, high = s.expanded_percentiles([5])
    assert low == pytest.approx(100 * stats.norm.cdf(-stats.t.ppf(0.975, 4) * math.sqrt(5 / 4)))
    assert low + high == 100
    assert s.expanded_percentiles([10_000])[0] == pytest.approx(2.5, abs=0.01)
    assert s.expanded_percentiles([1, 1]) == (0, 100)
    assert s.expanded_percentiles([5, 5])[0] > 4 * low  # two conditions know more of the spread than one


def test_bootstrap_covers_a_normalised_mean_only_with_the_anchors_uncertainty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Agent and reference are equal, so that the true value is 1, and the reference is as uncertain as the agent."""
    monkeypatch.setattr(s, "REPETITIONS", 400)
    random = np.random.default_rng(0)
    hits = {"resampled": 0, "taken as exact": 0}
    for _ in range(200):
        returns, reference = random.normal(10, 2, 25), random.normal(10, 2, 25)
        for name, anchor in (("resampled", reference), ("taken as exact", np.full(25, reference.mean()))):
            low, high = s.stratified_bootstrap([s.Stratum(np.zeros(2), anchor, [returns])], mean)
            hits[name] += low <= 1 <= high
    assert 0.88 <= hits["resampled"] / 200 <= 0.99
    assert hits["taken as exact"] / 200 < 0.88


def test_one_run_has_no_interval() -> None:
    assert all(np.isnan(s.stratified_bootstrap(sure([1.0, 2.0], [3.0]), s.interquartile_mean)))
    for anchors in ((np.zeros(1), np.ones(2)), (np.zeros(2), np.ones(1))):
        assert all(np.isnan(s.stratified_bootstrap([s.Stratum(*anchors, [np.array([1.0, 2.0])])], mean)))


def test_interval_of_steps_agrees_with_every_possible_resample() -> None:
    steps, curves = [10, 20, 30, 40], np.array([[0.0, 3, 6, 8], [1.0, 5, 9, 9], [0.0, 1, 2, 4]])
    reference = np.array([4.0, 6.0])
    every = sorted(
        next((step for step, x in zip(steps, curves[list(a)].mean(0), strict=True) if x >= np.mean(b)), math.inf)
        for a in itertools.product(range(3), repeat=3)
        for b in itertools.product(reference, repeat=2)
    )
    assert s.bootstrap_steps(steps, curves, reference) == (every[0], every[-1])  # of 108; all, with three runs
    assert every[0] == 20
    assert every[-1] == math.inf
    assert s.bootstrap_steps(steps, curves + 100, reference) == (10, 10)
    assert s.bootstrap_steps(steps, curves - 100, reference) == (math.inf, math.inf)


def test_interval_of_steps_needs_two_runs_of_either() -> None:
    for runs, seeds in ((1, 2), (2, 1), (2, 0)):
        assert np.isnan(s.bootstrap_steps([10], np.ones((runs, 1)), np.ones(seeds))).all()


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


def test_an_evaluation_at_step_0_alone_has_no_area() -> None:
    assert np.isnan(s.area([0], [[3.0], [4.0]])).all()
