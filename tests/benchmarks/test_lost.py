"""The table that says how many episodes are lost."""

from pathlib import Path
from typing import Any

import lost
import pytest
from synthetic import Standing, standing

from delayrl.bench.results import Collected
from delayrl.errors import DelayRLError

ENV, HALF, END = "HalfCheetah-v5", 75_000, 100_000
HIGH, LOW = {HALF: [9000.0, 1000.0], END: [9000.0, 9000.0]}, {HALF: [50.0, 50.0], END: [50.0, 50.0]}
EARLY = {25_000: [-5000.0, 5000.0]}


def test_an_episode_is_lost_below_0_7_of_the_best_above_chance() -> None:
    """With chance at -100: 0.7 of (900 + 100) is reached by 600, not by 599. The first half does not count."""
    runs = {0: {50: [0.0] * 3, 75: [900.0, 600, 599], 100: [200.0, 200, 200]}}
    found = lost.measure(runs, -100)
    assert found.lost == pytest.approx(1 / 6)
    assert found.others == pytest.approx((900 + 600 + 3 * 200) / 5)
    assert (found.mean, found.change) == pytest.approx(((2099 + 600) / 6, 2099 / 3 - 200))
    hopeless = lost.measure({0: {75: [-400.0, -390, -380], 100: [0.0, 0, 0]}}, -100)
    assert (hopeless.lost, hopeless.others) == (0, -195)  # all of the first are below chance
    assert lost.measure({0: {75: [1499.0, 1500], 100: [4000.0, 4000]}}, 0).low == 0.25


def cell(agent: str, delay: int | str, runs: Any, env: str = ENV, **changes: Any) -> tuple[Standing, Any]:
    """A cell of `matched`, with returns of its seeds by policy and step."""
    id = changes.pop("id", f"{agent} {delay} {env} {changes}")
    return standing(agent, env, delay, 1, id, **({"steps": END, "preset": "matched"} | changes)), runs


def collected(*cells: tuple[Standing, Any]) -> Collected:
    """The table of some cells."""
    rows = [
        {"cell": made.id, "seed": seed, "policy": policy, "step": step, "return": value, "privileged": privileged}
        for (made, _), runs in cells
        for privileged in [made.condition.agent == "vdpo"]
        for seed, policies in runs.items()
        for policy, evaluations in policies.items()
        for step, returns in evaluations.items()
        for value in returns
    ]
    return Collected(rows, [made for made, _ in cells], [], "")


def test_the_table_has_each_policy_that_has_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By delay, the best first; of two files each seed once; nothing that is shorter, or is another arm or task.

    Nor a policy with a cell that runs. Chance is the mean of all evaluations of the random policy. With it at -1000,
    0.7 of 600 more is more than 100 more.
    """
    chance = {0: {"agent": {1: [-900.0], 10_000: [-1100.0]}}}
    first = collected(
        cell("random", 0, chance, steps=10_000, overrides={"random_steps": 1000}),
        cell("vdpo", 25, {0: {"agent": EARLY | LOW, "reference": EARLY | HIGH}}, overrides={"tokens": 1280}),
        cell("bpql", 5, {0: {"agent": {HALF: [-400.0, -600.0], END: [-400.0, -400.0]}}}),
        cell("any-age", 25, {0: {"agent": HIGH}}, state="running"),
        cell("lifting", 25, {0: {"agent": HIGH}}, id="ended"),
        cell("lifting", 25, {}, id="not begun", state="todo"),
        cell("bpql", 25, {0: {"agent": HIGH}}, overrides={"batch_size": 64}),
        cell("bpql", 25, {0: {"agent": HIGH}}, steps=50_000),
        cell("bpql", "uniform:1:25", {0: {"agent": HIGH}}),
        cell("bpql", 25, {0: {"agent": HIGH}}, env="Ant-v5"),
        cell("bpql", 25, {0: {"agent": HIGH}}, preset="small"),
    )
    second = collected(cell("vdpo", 25, {1: {"agent": {HALF: [90.0, 90.0], END: [50.0, 50.0]}}}))
    tables = {"first": first, "second": second}
    monkeypatch.setattr(lost, "rows_of", lambda *_: "")
    monkeypatch.setattr(lost, "read_table", lambda file: tables[file.name])
    _, _, *lines = lost.section([Path(name) for name in tables], tmp_path / "lost.png").strip().splitlines()
    assert lines == [
        "| 5 | `bpql` | 1 | -450 | 25 % | 100 % | -400 | 100 |",
        "| 25 | `vdpo` †, its reference without delay | 1 | 7,000 | 25 % | 25 % | 9,000 | 4,000 |",
        "| 25 | `vdpo` † | 2 | 60 | 0 % | 100 % | 60 | 20 |",
    ]


def test_a_seed_is_not_in_two_cells() -> None:
    """Else the episodes of two runs would be taken for one."""
    twice = collected(
        cell("vdpo", 25, {0: {"agent": LOW}}), cell("vdpo", 25, {0: {"agent": HIGH}}, overrides={"tokens": 1})
    )
    with pytest.raises(DelayRLError, match="seed 0 of `vdpo` † at delay 25 is in two cells"):
        lost.episodes(twice)
