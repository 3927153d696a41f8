"""The table that says which agent is best where."""

from pathlib import Path
from typing import Any

import pytest
import which
from synthetic import Standing, curve, standing

from delayrl.errors import DelayRLError
from delayrl.report.results import Result
from delayrl.report.summary import summarise

HIGH, LOW, CLOSE = [10.0, 11, 12, 13, 14], [0.0, 1, 2, 3, 4], [9.0, 11, 12, 13, 14]
Cells = list[tuple[Standing, list[float]]]


def cell(agent: str, finals: list[float], delay: int | str = 5, env: str = "Ant-v4", **changes: Any) -> Any:
    """A cell with these final returns, one for each seed."""
    return standing(agent, env, delay, len(finals), steps=300, **changes), finals


def results(cells: Cells) -> list[Result]:
    rows = [row for made, finals in cells for s, x in enumerate(finals) for row in curve(made, s, [0.0, 0.0, x])]
    return [*summarise(rows, [made for made, _ in cells]).results.values()]


def lines(*cells: Any) -> list[list[str]]:
    return which.lines(results([*cells]))


def test_an_agent_is_lower_where_five_runs_a_side_say_so() -> None:
    """Three runs tell nothing apart, and lead nowhere where others have five; an agent alone has no line."""
    anchors = cell("sac", [20.0, 20.0], 0), cell("random", [0.0, 0.0], 0)
    finals = (
        cell("bpql", LOW),
        cell("vdpo", HIGH),
        cell("a-sac", CLOSE),
        cell("dida", [99.0] * 3),
        cell("bpql", LOW, 25),
    )
    case = ["Ant-v4, delay 5, `paper`, 300 steps"]
    many = ["`vdpo` 0.60 (5)", "`a-sac` 0.59 (5), `dida` 4.95 (3)", "`bpql` 0.10 (5)", ""]
    assert lines(*anchors, *finals) == [case + many]
    assert lines(cell("bpql", LOW[:3]), cell("vdpo", HIGH[:3])) == [
        [*case, "`vdpo` 11.0 raw (3)", "`bpql` 1.00 raw (3)", "", ""]
    ]


def test_who_waits_is_compared_on_the_same_plant() -> None:
    """And is told from the agent that takes each observation as it comes."""
    late, waits = cell("bpql", LOW, "uniform:1:5"), cell("bpql", HIGH, "uniform:1:5@wait")
    assert lines(late, waits) == [
        ["Ant-v4, delay uniform:1:5, `paper`, 300 steps", "`bpql@wait` 12.0 raw (5)", "", "`bpql` 2.00 raw (5)", ""]
    ]


def test_one_high_run_makes_no_other_agent_lower() -> None:
    """The best by its mean, which loses nine of ten runs."""
    ((*_, best, apart, lower, _),) = lines(cell("vdpo", [100.0] + [0.0] * 9), cell("bpql", [5.0] * 10))
    assert (best, apart, lower) == ("`vdpo` 10.0 raw (10)", "`bpql` 5.00 raw (10)", "")


def test_what_has_not_ended_is_still_to_be_run() -> None:
    """Also where some seeds have; each task, delay, budget and protocol has its own line."""
    running = standing("vdpo", "Ant-v4", 5, (5, 6), id="later", state="todo", step=0, steps=300), []
    first = [cell("bpql", LOW), cell("a-sac", CLOSE), cell("vdpo", HIGH), running]
    other = [cell(agent, HIGH, "uniform:1:5") for agent in ("bpql", "a-sac")]
    official = [cell(agent, HIGH, protocol="official", id=f"{agent} o") for agent in ("bpql", "a-sac")]
    table = which.lines(results(first + other + official))
    assert [case for case, *_ in table] == [
        "Ant-v4, delay 5, `paper`, 300 steps",
        "Ant-v4, delay 5, `paper`, 300 steps, protocol `official`",
        "Ant-v4, delay uniform:1:5, `paper`, 300 steps",
    ]
    assert table[0][1:] == ["`a-sac` 11.8 raw (5)", "", "`bpql` 2.00 raw (5)", "`vdpo`"]


def test_a_cell_of_two_grids_counts_once() -> None:
    """The one with more runs that have all ended."""
    few, many = results([cell("bpql", LOW), cell("vdpo", HIGH)]), results([cell("bpql", LOW * 2)])
    assert which.lines(few + many) == which.lines(many + few)
    ((*_, lower, _),) = which.lines(few + many)
    assert lower == "`bpql` 2.00 raw (10)"


def test_other_options_are_left_out_and_budgets_are_not() -> None:
    normed = cell("bpql", HIGH, overrides={"critic_norm": "layer"})
    budget = {"precision": "bfloat16", "evaluate_every": 100}
    ((*_, best, apart, lower, todo),) = lines(normed, cell("bpql", LOW, overrides=budget), cell("vdpo", CLOSE))
    assert (best, apart, lower, todo) == ("`vdpo` 11.8 raw (5)", "", "`bpql` 2.00 raw (5)", "")
    assert lines(normed, cell("vdpo", CLOSE)) == []


def test_tokens_are_a_budget_and_random_steps_an_option() -> None:
    """VDPO has tokens in `evidence-1`: it is still to be run before it has ended, and compared once it has."""
    budget = {"precision": "bfloat16", "tokens": 1280}
    vdpo = standing("vdpo", "Ant-v4", 5, 5, state="todo", step=0, steps=300, overrides=budget), []
    first = cell("bpql", LOW), cell("a-sac", CLOSE)
    ((*_, todo),) = lines(*first, vdpo)
    assert todo == "`vdpo`"
    ((*_, best, _, _, todo),) = lines(*first, cell("vdpo", HIGH, overrides=budget))
    assert (best, todo) == ("`vdpo` 12.0 raw (5)", "")
    assert lines(cell("bpql", LOW), cell("vdpo", HIGH, overrides=budget | {"random_steps": 20_000})) == []


def test_a_missing_table_is_said() -> None:
    with pytest.raises(DelayRLError, match="there is no table"):
        which.section([Path("none.sqlite")])
