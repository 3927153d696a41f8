"""The tables of who is clearly above whom, from results whose answer is known."""

from dataclasses import replace

import pairs
import pytest
from finished import result

from delayrl.report.results import Result

ENV, STEPS = "InvertedDoublePendulum-v5", 30_000


def of(agent: str, delay: int | str, returns: list[list[float]], steps: int = STEPS, **overrides: str) -> Result:
    plain = result(agent, 5, returns, **overrides)
    condition = replace(plain.condition, env=ENV, delay=delay, steps=steps)
    return replace(plain, place=plain.place._replace(env=ENV, delay=delay), condition=condition)


def test_an_arm_names_those_that_it_is_clearly_above() -> None:
    """At the end and over training apart; who waits has the same plant; other delays are left out."""
    late = "uniform:1:5"
    results = [
        of("sac", 0, [[0.0, 3900.0], [0.0, 3901.0]]),
        of("bpql", late, [[0.0, 100.0], [0.0, 101.0]]),
        of("any-age", late, [[900.0, 100.0], [901.0, 102.0]]),
        of("bpql", f"{late}@wait", [[0.0, 0.0], [0.0, 90.0]]),
        of("lifting", 5, [[0.0, 3000.0], [0.0, 3001.0]]),
    ]
    body = [line.strip("|").strip().split(" | ") for line in pairs.table(results, ENV, late).splitlines()[2:]]
    assert [line[0] for line in body] == [
        "**1** `sac`, no delay (2 seeds)",
        "**2** `any-age` (2 seeds)",
        "**3** `bpql` (2 seeds)",
        "**4** `bpql`, `@wait` (2 seeds)",
    ]
    assert [line[4:6] for line in body] == [["2–4", "2–4"], ["", "3, 4"], ["", ""], ["", ""]]
    assert body[0][1:4] == ["1.00", "3,900&nbsp;±&nbsp;1", "1,950&nbsp;±&nbsp;0"]


def test_an_arm_counts_once_with_most_seeds() -> None:
    """Other budgets, protocols and precisions, what has not ended and unknown arms are left out; ° marks older rows."""
    five = [[1.0, 2.0 + seed] for seed in range(5)]
    whole = of("bpql", 5, five)
    official = replace(whole, place=whole.place._replace(setting=whole.place.setting._replace(protocol="official")))
    results = [
        whole,
        of("bpql", 5, five[:3]),
        official,
        replace(whole, seeds=9),
        of("bpql", 5, five * 2, steps=STEPS * 2),
        of("bpql", 5, five * 2, precision="float32"),
        of("bpql", 5, five, batch_size="64"),
        of("any-age", 5, five, critic_norm="none"),
    ]
    marked = {("`bpql`", (ENV, 5))}
    body = [line.split(" | ")[0] for line in pairs.table(results, ENV, 5, marked).splitlines()[2:]]
    assert sorted(body) == ["| **1** `bpql` °", "| **2** `any-age`, `critic_norm=none`"]


@pytest.mark.parametrize(
    ("numbers", "text"), [([], ""), ([2], "2"), ([2, 3], "2, 3"), ([1, 3, 4, 5, 9], "1, 3–5, 9"), ([1, 2, 3], "1–3")]
)
def test_ranges_name_each_number_once(numbers: list[int], text: str) -> None:
    assert pairs.ranges(numbers) == text
