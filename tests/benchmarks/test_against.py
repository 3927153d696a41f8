"""The table of any-age beside other agents."""

from typing import Any

import against
import numpy as np
import pytest
from ladder import paired
from learning.curves import bold
from synthetic import row, standing

from delayrl.report.summary import summarise


def cell(agent: str, finals: list[float], delay: int | str, **changes: Any) -> Any:
    changes["overrides"] = {"precision": "bfloat16", **changes.get("overrides", {})}
    made = standing(agent, against.ENV, delay, len(finals), **{"steps": 100_000, "preset": "matched", **changes})
    return made, finals


def test_rows_are_what_has_ended_at_the_same_delay() -> None:
    """An agent counts with most of its seeds; other presets, lengths and delays without any-age are left out."""
    five, ten = [1.0, 2, 3, 4, 5], [10.0, 11, 12, 13, 14] * 2
    cells = [
        cell("any-age", ten, 25),
        cell("bpql", five, 25, id="a"),
        cell("vdpo", ten[:5], 25),
        cell("bpql", five, 50),
    ]
    cells += [cell("lifting", five, 25, preset="small"), cell("a-sac", five, 25, steps=90_000)]
    rows = [
        row(made, s, made[0].condition.steps, x, 0, "agent") for made, finals in cells for s, x in enumerate(finals)
    ]
    cells.append((standing("dcac", against.ENV, 25, 5, steps=100_000, preset="matched", state="todo", step=0), []))
    results = summarise(rows, [made for made, _ in cells]).results.values()
    title, _, _, _, *body = against.table([*results]).splitlines()
    assert title == "**Δ = 25**: `any-age` ends at 12 ± 1 (10 seeds)."
    shown = [[text.strip() for text in line.strip("|").split("|")] for line in body]
    assert [line[:2] for line in shown] == [["`vdpo` †", "12 ± 2"], ["`bpql`", "3 ± 2"]]
    assert not shown[0][2].startswith("**")
    assert shown[1][2].startswith("**+9 (+")
    assert [line[2].endswith("§") for line in shown] == [False, True]


def test_seeds_that_were_added_stand_apart() -> None:
    """An agent with as many seeds is compared half by half, one with five with both halves of any-age."""
    planned, later = [1.0, 2, 3, 4, 5], [11.0, 12, 13, 14, 15]
    cells = [cell("any-age", planned + later, 25), cell("bpql", planned + later, 25), cell("lifting", planned, 25)]
    cells += [cell("lifting", later, 50), cell("any-age", later, 25, id="plain", overrides={"critic_norm": "none"})]
    rows = [row(made, s, made[0].condition.steps, x, 0, "agent") for made, ends in cells for s, x in enumerate(ends)]
    _, _, *body = against.added_table([*summarise(rows, [made for made, _ in cells]).results.values()]).splitlines()
    shown = [[text.strip().split(" (")[0] for text in line.strip("|").split("|")] for line in body]
    assert sorted(line[:3] for line in shown) == [["`bpql`", "+0", "+0"], ["`lifting`", "+0", "**+10"]]


def test_equal_critics_are_compared_too() -> None:
    """Any-age without layer normalisation stands beside agents without it, and not beside those with it."""
    five = [1.0, 2, 3, 4, 5]
    cells = [cell("any-age", five, 25), cell("any-age", five, 25, id="plain", overrides={"critic_norm": "none"})]
    cells += [cell("bpql", five, 25, id="a"), cell("bpql", five, 25, id="b", overrides={"critic_norm": "layer"})]
    rows = [row(made, s, made[0].condition.steps, x, 0, "agent") for made, ends in cells for s, x in enumerate(ends)]
    text = against.table([*summarise(rows, [made for made, _ in cells]).results.values()])
    shown = {
        part.split(" ends")[0]: {line.split(" | ")[0] for line in part.splitlines()[4:] if line}
        for part in text.split("**Δ = 25**: ")[1:]
    }
    assert shown == {
        "`any-age`": {"| `bpql`", "| `bpql`, `critic_norm=layer`", f"| {against.PLAIN}"},
        against.PLAIN: {"| `bpql`"},
    }


@pytest.mark.parametrize(
    ("values", "clear"),
    [
        ([0.04, 0.01, 0.02], [True, True, True]),  # 0.01 < 0.05 / 3, 0.02 < 0.05 / 2, 0.04 < 0.05
        ([0.04, 0.01, 0.03], [False, True, False]),  # 0.03 > 0.05 / 2, and what follows is not asked
        ([], []),
    ],
)
def test_holms_correction(values: list[float], clear: list[bool]) -> None:
    assert against.holm(values) == clear


@pytest.mark.parametrize(
    ("text", "clear"),
    [
        ("+9 (-1 to +19)", False),
        ("-9 (-19 to -1)", True),
        ("+9 (+1 to +1,900)", True),
        ("-0 (-0 to -0)", False),
        ("-0.0 (-0.0 to -0.0)", False),
        ("+0.2 (+0.1 to +0.3)", True),
        ("+3 (+0 to +6)", True),
    ],
)
def test_what_leaves_out_0_is_bold(text: str, clear: bool) -> None:
    assert bold(text) == (f"**{text}**" if clear else text)


def test_what_cannot_be_known_is_not_clear() -> None:
    """One seed has no interval, and no p-value."""
    assert against.holm([float("nan"), 1e-9]) == [False, True]
    assert bold("") == ""
    assert paired(np.array([3.0]), np.array([1.0, 2.0])) == ""


def test_simpler_arms_are_marked_where_they_differ() -> None:
    """The end counts before the whole of training, and what has not run is empty."""
    ends = {
        "any-age": ([5.0, 5.5], [10.0, 11.0]),
        "bpql": ([5.0, 5.5], [1.0, 2.0]),
        "half": ([1.0, 1.1], [10.0, 11.0]),
        "random": ([0.0, 0.0], [0.0, 0.0]),
        "sac": ([20.0, 20.0], [20.0, 20.0]),
    }
    cells, rows = [], []
    for label, (middle, end) in ends.items():
        agent, delay = {"half": "any-age"}.get(label, label), 0 if label in ("random", "sac") else 5
        changes = {"id": label, "overrides": {"batch_size": 128} if label == "half" else {}}
        made, _ = cell(agent, middle * 3, delay, **changes)
        cells.append(made)
        for seed, (early, late) in enumerate(zip(middle * 3, end * 3, strict=True)):
            rows += [row(made, seed, 50_000, early, 0, "agent"), row(made, seed, 100_000, late, 0, "agent")]
    _, _, *body = against.simpler_table([*summarise(rows, cells).results.values()]).splitlines()
    shown = {line.split("|")[1].strip(): [text.strip() for text in line.split("|")[3:5]] for line in body}
    assert list(shown) == [*against.SIMPLER]
    assert shown["`any-age`"] == ["0.53", ""]
    assert shown["`bpql`"] == ["0.08&nbsp;↓", ""]
    assert shown["`any-age`, `batch_size=128`"] == ["0.53&nbsp;(↓)", ""]
    assert shown["`bpql`, `critic_norm=layer`"] == ["", ""]
