"""Which of two agents is better: by hand, against SciPy, and against bootstraps that are written out."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from synthetic import Standing, curve, standing

from delayrl.report import statistics as s
from delayrl.report.comparisons import Comparison
from delayrl.report.markdown import markdown
from delayrl.report.page import payload
from delayrl.report.summary import Summary, summarise
from delayrl.report.wording import signed

RETURNS = st.lists(st.integers(-5, 5).map(float), min_size=1, max_size=8)


def test_probability_of_improvement_by_hand() -> None:
    """1 is above neither of 2 and 3; 3 is above 2 and ties with 3; 5 is above both."""
    assert s.probability_of_improvement([1, 3, 5], [2, 3]) == 3.5 / 6
    assert s.probability_of_improvement([[1, 3], [4, 4]], [[2, 2], [4, 0]]).tolist() == [0.5, 0.75]


@given(RETURNS, RETURNS)
def test_probability_of_improvement_is_mann_whitneys(one: list[float], other: list[float]) -> None:
    statistic = stats.mannwhitneyu(one, other).statistic
    assert s.probability_of_improvement(one, other) == pytest.approx(statistic / (len(one) * len(other)))
    assert s.probability_of_improvement(other, one) == pytest.approx(1 - s.probability_of_improvement(one, other))


def test_interval_agrees_with_a_bootstrap_written_out() -> None:
    """Two tasks, six runs against five on each; runs are drawn within their agent and task."""
    random = np.random.default_rng(1)
    pairs = [(random.normal(0.5, 1, 6), random.normal(0, 1, 5)), (random.normal(9, 1, 6), random.normal(9, 1, 5))]
    drawn = [
        np.mean([s.probability_of_improvement(random.choice(x, x.size), random.choice(y, y.size)) for x, y in pairs])
        for _ in range(20_000)
    ]
    found = s.improvement_interval(pairs)
    np.testing.assert_allclose(found, np.percentile(drawn, s.expanded_percentiles([6, 5, 6, 5])), atol=0.02)


def test_few_runs_have_no_interval() -> None:
    enough, few = np.arange(5.0), np.arange(4.0)
    assert not np.isnan(s.improvement_interval([(enough, enough)])).any()
    for pair in ((enough, few), (few, enough)):
        assert np.isnan(s.improvement_interval([(enough, enough), pair])).all()


Cells = tuple[list[Standing], list[dict[str, Any]]]


def runs(delay: int, env: str = "delayrl/Ant-v4", steps: int = 300, **finals: list[float]) -> Cells:
    """Cells and their rows: the last returns are those given, one for each seed."""
    cells = {name.replace("_", "-"): len(values) for name, values in finals.items()}
    made = {name: standing(name, env, delay, seeds, steps=steps) for name, seeds in cells.items()}
    before = [0.0] * (steps // 100 - 1)
    return [*made.values()], [
        row
        for cell, values in zip(made.values(), finals.values(), strict=True)
        for seed, value in enumerate(values)
        for row in curve(cell, seed, [*before, value])
    ]


def compared(*parts: Cells) -> tuple[Summary, dict[tuple, Comparison]]:
    cells, every = ([x for part in parts for x in part[i]] for i in range(2))
    summary = summarise(every, cells)
    return summary, {(c.delay, c.one, c.other): c for c in summary.comparisons}


SAC, RANDOM = [80.0, 100.0, 120.0, 140.0], [0.0, 20.0]
"""Ant's anchors: 110 and 0, of random's mean over training."""
ANT = runs(0, sac=SAC, random=RANDOM)


def test_agents_meet_on_the_tasks_that_both_have_ended_on() -> None:
    """Not where one is absent, has not ended, or has another budget; nor do anchors."""
    running = standing("dida", "delayrl/Ant-v4", 5, 2, state="running", step=200, steps=300)
    summary, comparisons = compared(
        ANT,
        runs(5, bpql=[60.0, 110.0], ad_sac=[35.0, 60.0, 110.0]),
        runs(25, bpql=[10.0, 10.0], ad_sac=[35.0, 35.0]),
        runs(50, bpql=[10.0, 10.0]),
        runs(5, "delayrl/Hopper-v4", bpql=[0.0, 0.0]),
        runs(5, "delayrl/Swimmer-v4", bpql=[0.0, 0.0]),
        runs(5, "delayrl/Swimmer-v4", steps=200, ad_sac=[9.0, 9.0]),
        ([running], [row for seed in range(2) for row in curve(running, seed, [0, 999])]),
    )
    assert [*comparisons] == [(5, "bpql", "ad-sac"), (25, "bpql", "ad-sac"), (None, "bpql", "ad-sac")]
    five, longer, both = comparisons.values()
    assert (five.tasks, five.runs, both.tasks, both.runs) == (1, (2, 3), 2, (4, 5))
    assert five.probability.value == pytest.approx((1.5 + 2.5) / 6)
    assert longer.probability.value == 0
    assert both.probability.value == pytest.approx(five.probability.value / 2)
    anchors = [r for r in summary.results.values() if r.is_anchor]
    low, high = anchors[0].random_anchor.value, anchors[0].reference_anchor.value
    assert five.difference.value == pytest.approx((85 - 205 / 3) / (high - low))
    assert longer.difference.value == pytest.approx(-25 / (high - low))
    assert both.difference.value == pytest.approx((five.difference.value + longer.difference.value) / 2)
    turned = five.turned()
    assert (turned.one, turned.other, turned.runs) == ("ad-sac", "bpql", (3, 2))
    assert turned.probability.value == pytest.approx(1 - five.probability.value)
    assert np.isnan([*five.difference[1:], *turned.difference[1:]]).all(), "there are fewer than five runs"
    assert turned.turned().difference.value == five.difference.value


def test_interval_of_the_difference_agrees_with_a_bootstrap_written_out() -> None:
    """Two delays of one task, whose anchors are drawn once for both, and another task; unequal numbers of runs."""
    random = np.random.default_rng(0)
    hopper = {"sac": [300.0, 500.0, 400.0], "random": [0.0, 50.0]}
    finals = {
        ("Ant", 5): (random.normal(90, 4, 5), random.normal(40, 4, 7)),
        ("Ant", 25): (random.normal(80, 4, 5), random.normal(20, 4, 6)),
        ("Hopper", 5): (random.normal(300, 20, 6), random.normal(250, 20, 5)),
    }
    parts = [
        runs(delay, f"delayrl/{task}-v4", bpql=one.tolist(), vdpo=other.tolist())
        for (task, delay), (one, other) in finals.items()
    ]
    _, comparisons = compared(ANT, runs(0, "delayrl/Hopper-v4", **hopper), *parts)
    # random does not learn: its anchor is its mean over training, here a third of its last return
    anchors = {"Ant": (np.array(RANDOM) / 3, SAC), "Hopper": (np.array(hopper["random"]) / 3, hopper["sac"])}
    drawn = []
    for _ in range(20_000):
        means = {task: [random.choice(x, len(x)).mean() for x in pair] for task, pair in anchors.items()}
        apart = []
        for (task, _), (one, other) in finals.items():
            low, high = means[task]
            apart.append((random.choice(one, one.size).mean() - random.choice(other, other.size).mean()) / (high - low))
        drawn.append(np.mean(apart))
    found = comparisons[None, "bpql", "vdpo"].difference
    ends = s.expanded_percentiles([x.size for pair in finals.values() for x in pair])
    np.testing.assert_allclose(found[1:], np.percentile(drawn, ends), atol=0.02)
    assert comparisons[None, "bpql", "vdpo"].turned().difference[1:] == (-found.high, -found.low)
    one_anchor = [(np.mean(one) - np.mean(other)) for one, other in finals.values()]
    scales = [110 - 10 / 3, 110 - 10 / 3, 400 - 25 / 3]
    assert found.value == pytest.approx(np.mean(np.array(one_anchor) / scales))


def test_without_anchors_there_is_a_probability_and_no_difference() -> None:
    high, low = [60.0, 110.0, 70.0, 80.0, 90.0], [10.0, 20.0, 15.0, 5.0, 12.0]
    summary, comparisons = compared(runs(5, bpql=high, vdpo=low))
    (comparison,) = comparisons.values()
    assert comparison.probability == (1, 1, 1)
    assert comparison.clear
    assert comparison.turned().clear
    assert math.isnan(comparison.difference.value)
    table = markdown(summary, "t", {}).split("### Which is better")[1].split("###")[0]
    grey = '<span style="color:#888">1 task, 5 and 5 runs</span>'
    assert f"| 5 | bpql |  | **1.00**<br>1.00 to 1.00<br>{grey} |" in table
    assert f"| 5 | vdpo † | **0.00**<br>0.00 to 0.00<br>{grey} |  |" in table
    shown = payload(summary, "t")["comparisons"]
    assert [(c["clear"], c["texts"]) for c in shown] == [
        (True, ("1.00", "1.00 to 1.00", "", "1 task, 5 and 5 runs")),
        (True, ("0.00", "0.00 to 0.00", "", "1 task, 5 and 5 runs")),
    ]


def test_what_overlaps_is_not_clear() -> None:
    one, other = [1.0, 2.0, 3.0, 4.0, 5.0], [0.5, 2.5, 2.6, 3.5, 4.5]
    _, comparisons = compared(runs(5, bpql=one, vdpo=other))
    (comparison,) = comparisons.values()
    assert comparison.probability.low < 0.5 < comparison.probability.high
    assert not comparison.clear
    few, _ = compared(runs(5, bpql=[60.0, 61.0], vdpo=[10.0, 11.0]))
    assert not few.comparisons[0].clear
    assert "| 5 | bpql |  | 1.00<br><span" in markdown(few, "t", {})


def test_a_difference_has_a_sign_unless_it_is_nothing() -> None:
    assert [signed(x) for x in (0.123, -0.126, -0.001, 0.004)] == ["+0.12", "-0.13", "0.00", "0.00"]
