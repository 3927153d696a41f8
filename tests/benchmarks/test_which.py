"""The table that says which agent is best where."""

import sys
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2] / "benchmarks"), str(Path(__file__).parents[1] / "report")]

import which  # noqa: E402
from synthetic import curve, standing  # noqa: E402

from delayrl.report.summary import summarise  # noqa: E402


def lines_of(env: str, delays: dict[tuple[str, int], list[float]], **changes: Any) -> list[list[str]]:
    """Lines of agents with these final returns, one for each seed."""
    cells = {(agent, d): standing(agent, env, d, len(x), steps=300, **changes) for (agent, d), x in delays.items()}
    rows = [
        row
        for key, cell in cells.items()
        for seed, value in enumerate(delays[key])
        for row in curve(cell, seed, [0.0, 0.0, value])
    ]
    return which.lines(summarise(rows, [*cells.values()]).results.values())


def test_an_agent_is_lower_where_five_runs_a_side_say_so() -> None:
    """Three runs tell nothing apart; an agent alone has no line."""
    high, low, close = [10.0, 11, 12, 13, 14], [0.0, 1, 2, 3, 4], [9.0, 11, 12, 13, 14]
    anchors = {("sac", 0): [20.0, 20.0], ("random", 0): [0.0, 0.0]}
    finals = {("bpql", 5): low, ("vdpo", 5): high, ("a-sac", 5): close, ("dida", 5): low[:3], ("bpql", 25): low}
    many = lines_of("Ant-v4", finals | anchors)
    assert many == [
        ["Ant-v4", "5", "`paper`", "300", "3 to 5", "`vdpo` 0.60", "`a-sac` 0.59, `dida` 0.05", "`bpql` 0.10"]
    ]
    few = lines_of("Ant-v4", {("bpql", 5): low[:3], ("vdpo", 5): high[:3]})
    assert few == [["Ant-v4", "5", "`paper`", "300", "3", "`vdpo` 11.0 raw", "`bpql` 1.00 raw", ""]]


def test_other_options_are_left_out() -> None:
    cells = [standing("bpql", "Ant-v4", 5, 2, steps=300, overrides=x) for x in ({}, {"critic_norm": "layer"})]
    cells += [standing("vdpo", "Ant-v4", 5, 2, steps=300)]
    rows = [row for cell in cells for seed in range(2) for row in curve(cell, seed, [0.0, 0.0, 1.0])]
    ((*_, best, others, lower),) = which.lines(summarise(rows, cells).results.values())
    assert (best, others, lower) == ("`bpql` 1.00 raw", "`vdpo` 1.00 raw", "")
