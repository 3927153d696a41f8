"""Which of two agents is better: by hand, against SciPy, and against every possible resample."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from synthetic import Standing, anchored, curve, standing

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


def test_interval_agrees_with_every_possible_resample() -> None:
    """Two tasks, three runs against two on each: (27 × 4)² equally likely resamples, all of them counted."""
    pairs = [(np.array([1.0, 4.0, 6.0]), np.array([3.0, 5.0])), (np.array([0.0, 1.0, 9.0]), np.array([2.0, 2.0]))]
    every = [
        [
            s.probability_of_improvement(x, y)
            for x in itertools.product(one, repeat=3)
            for y in itertools.product(other, repeat=2)
        ]
        for one, other in pairs
    ]
    exact = np.percentile([(a + b) / 2 for a, b in itertools.product(*every)], [2.5, 97.5])
    np.testing.assert_allclose(s.improvement_interval(pairs, repetitions=40_000), exact, atol=0.03)
    assert np.isnan(s.improvement_interval([(np.array([1.0]), np.array([1.0, 2.0]))])).all()


def compared(every: list[dict[str, Any]], cells: list[Standing]) -> tuple[Summary, dict[tuple, Comparison]]:
    summary = summarise(every, cells)
    return summary, {(c.delay, c.one, c.other): c for c in summary.comparisons}


def agents(delay: int, env: str = "delayrl/Ant-v4", **finals: list[float]) -> tuple[list[Standing], list[dict]]:
    """Cells with two evaluations, and their rows: the last returns are those given, one for each seed."""
    cells = {name: standing(name, env, delay, len(values), steps=300) for name, values in finals.items()}
    return [*cells.values()], [
        r
        for name, values in finals.items()
        for seed, v in enumerate(values)
        for r in curve(cells[name], seed, [0, 0, v])
    ]


def ant() -> tuple[list[Standing], list[dict]]:
    """The anchors of Ant: 10 and 110."""
    cells = {name: standing(name, "delayrl/Ant-v4", 0, 2, steps=300) for name in ("sac", "random")}
    return [*cells.values()], anchored(cells)


def test_agents_meet_on_the_tasks_that_both_have_ended_on() -> None:
    parts = [
        ant(),
        agents(5, bpql=[60.0, 110.0], vdpo=[35.0, 60.0, 110.0]),
        agents(25, bpql=[10.0, 10.0], vdpo=[35.0, 35.0]),
        agents(50, bpql=[10.0, 10.0]),
        agents(5, "delayrl/Hopper-v4", bpql=[0.0, 0.0]),
    ]
    cells, every = ([x for part in parts for x in part[i]] for i in range(2))
    running = standing("dida", "delayrl/Ant-v4", 5, 2, state="running", step=200, steps=300)
    every += [r for seed in range(2) for r in curve(running, seed, [0, 999])]
    _, comparisons = compared(every, [*cells, running])
    assert [*comparisons] == [(5, "bpql", "vdpo"), (25, "bpql", "vdpo"), (None, "bpql", "vdpo")]
    five, longer, both = comparisons.values()
    assert five.probability.value == pytest.approx((1.5 + 2.5) / 6)
    assert five.difference.value == pytest.approx((85 - 205 / 3) / 100)
    assert not five.clear
    assert longer.probability == (0, 0, 0)
    assert longer.clear
    assert longer.difference.value == pytest.approx(-0.25)
    assert longer.difference.low < -0.25 < longer.difference.high  # the anchors are not known exactly
    assert both.tasks == 2
    assert both.probability.value == pytest.approx(five.probability.value / 2)
    assert both.difference.value == pytest.approx((five.difference.value - 0.25) / 2)
    turned = five.turned()
    assert (turned.one, turned.other) == ("vdpo", "bpql")
    assert turned.probability.value == pytest.approx(1 - five.probability.value)
    assert turned.probability.low == pytest.approx(1 - five.probability.high)
    assert turned.difference.high == pytest.approx(-five.difference.low)
    assert turned.turned().probability.low == pytest.approx(five.probability.low)


def test_conditions_of_a_task_share_its_anchors() -> None:
    """Agents that return the same differ by nothing, however uncertain the anchors are."""
    parts = [ant(), agents(5, bpql=[60.0, 60.0], vdpo=[60.0, 60.0]), agents(25, bpql=[40.0, 40.0], vdpo=[40.0, 40.0])]
    cells, every = ([x for part in parts for x in part[i]] for i in range(2))
    _, comparisons = compared(every, cells)
    assert {c.probability for c in comparisons.values()} == {(0.5, 0.5, 0.5)}
    np.testing.assert_allclose([c.difference for c in comparisons.values()], np.zeros((3, 3)), atol=1e-12)


def test_without_anchors_there_is_a_probability_and_no_difference() -> None:
    cells, every = agents(5, bpql=[60.0, 110.0], vdpo=[10.0, 20.0])
    summary, comparisons = compared(every, cells)
    (comparison,) = comparisons.values()
    assert comparison.probability == (1, 1, 1)
    assert math.isnan(comparison.difference.value)
    text = markdown(summary, "t", {})
    table = text.split("### Which is better")[1].split("###")[0]
    assert "| 5 | bpql |  | **1.00**<br>1.00 to 1.00 |" in table
    assert "| 5 | vdpo † | **0.00**<br>0.00 to 0.00 |  |" in table
    shown = payload(summary, "t")["comparisons"]
    assert [(c["clear"], c["texts"]) for c in shown] == [
        (True, ("1.00", "1.00 to 1.00", "")),
        (True, ("0.00", "0.00 to 0.00", "")),
    ]


def test_one_run_has_no_interval_and_is_not_clear() -> None:
    cells, every = agents(5, bpql=[60.0], vdpo=[10.0])
    summary, comparisons = compared(every, cells)
    (comparison,) = comparisons.values()
    assert not comparison.clear
    assert "| 5 | bpql |  | 1.00 |" in markdown(summary, "t", {})


def test_a_difference_has_a_sign_unless_it_is_nothing() -> None:
    assert [signed(x) for x in (0.123, -0.126, -0.001, 0.004)] == ["+0.12", "-0.13", "0.00", "0.00"]
