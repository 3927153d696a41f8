"""The ladder's tables, from results whose answer is known."""

import json
from dataclasses import replace
from pathlib import Path

import ladder
import pytest
from finished import result
from scipy import stats

import delayrl
from delayrl.report.results import NO_ANCHOR
from delayrl.run.cell import Cell
from delayrl.run.condition import Condition


def test_the_ladder_pairs_seeds_by_place() -> None:
    """An arm whose first seeds have not ended would be paired with others."""
    cells = [
        Cell(Condition("bpql", "X-v0", 25, preset="matched"), seeds, str(seeds)) for seeds in ((0, 1), (2, 3), (3,))
    ]
    ladder.check_seeds(cells[:2])
    with pytest.raises(delayrl.DelayRLError, match=r"`bpql` has ended for seeds \[0, 1, 3\]"):
        ladder.check_seeds([cells[0], cells[2]])
    with pytest.raises(delayrl.DelayRLError, match=r"seeds \[0, 0, 1, 1\]"):
        ladder.check_seeds([cells[0], cells[0]])


def test_the_ladder_compares_each_arm_with_its_base() -> None:
    """Seed by seed, over training and at the end, with how many seeds got away."""
    base = result("bpql", 25, [[1000.0, 1000.0], [1200.0, 1200.0]])
    whole = result("any-age", 25, [[2500.0, 2500.0], [2500.0, 1500.0], [9000.0, 9000.0]])
    arm = result("any-age", 25, [[2000.0, 2000.0], [2400.0, 1400.0]], pull_weight=0.0)
    rows = ladder.table([whole, arm, base], {"`any-age`, `pull_weight=0.0`": (7.25, 1.5)}).splitlines()[2:]
    lines = [line.strip("| ").split(" | ") for line in rows]
    assert lines[1][0] == "`any-age`, `pull_weight=0.0`"
    assert lines[1][2] == "-300 (-2,841 to +2,241)"  # gaps of 500 and 100, t = 12.706; the third seed has no other
    assert lines[1][4] == "-300 (-2,841 to +2,241)"
    assert lines[1][5:] == ["1 of 2", "1.23", "7.2 (1.50)"]
    assert lines[0][2] == "+1,150 (-3,297 to +5,597)"  # over training gaps of 1,500 and 800 from BPQL
    assert lines[0][4] == "+900 (-6,724 to +8,524)"  # at the end 1,500 and 300
    assert [lines[2][2], lines[2][4]] == ["", ""]
    assert ladder.name(result("sac", 0, [[0.0], [1.0]])) == "`sac`, no delay"
    smaller = result("any-age", 25, [[2000.0, 2000.0], [2000.0, 1000.0]], batch_size=128)
    changed = result("any-age", 25, [[1000.0, 1000.0], [1000.0, 1000.0]], batch_size=128, n_steps=5)
    rows = ladder.table([whole, smaller, changed]).splitlines()[2:]
    gaps = [row.strip("| ").split(" | ")[2].strip("*").split(" ")[0] for row in rows]
    assert gaps == ["", "-500", "-750"]  # each from any-age that has its batches
    assert ladder.base_of(result("bpql", 25, [[0.0]], critic_norm="layer")) == "`bpql`"
    assert ladder.base_of(result("sac", 0, [[0.0]], critic_norm="layer")) == ""
    assert ladder.base_of(result("bpql", 25, [[0.0]], batch_size=128, critic_norm="batch")) == ladder.HALF
    whole = result("any-age", 25, [[0.0]], batch_size=128, critic_norm="batch")
    assert ladder.base_of(whole) == "`any-age`, `batch_size=128`"
    flat = result("any-age", 25, [[0.0]], batch_size=128, encoder="mlp", pull_weight=1.0, second_age="zero")
    assert ladder.base_of(flat) == "`any-age`, `batch_size=128`, `encoder=mlp`"


def test_update_times_are_paired_by_round(tmp_path: Path) -> None:
    """The medians of the rounds' milliseconds and of their ratios; a round that met other work met it on both sides."""
    rows = [{"versions": {}}, {"arm": "`any-age`", "ms": [2.0, 4.0, 90.0]}, {"arm": "`bpql`", "ms": [1.0, 2.0, 30.0]}]
    (tmp_path / "arms.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert ladder.update_times(tmp_path / "arms.jsonl") == {"`any-age`": (4.0, 2.0), "`bpql`": (2.0, 1.0)}
    assert ladder.update_times(tmp_path / "none.jsonl") == {}


def test_the_goals_of_the_ladder() -> None:
    """Ratios above the random policy, and Welch's interval of the difference of raw returns."""
    base = result("bpql", 25, [[1000.0, 1000.0], [1200.0, 1200.0]])
    whole = result("any-age", 25, [[2500.0, 2500.0], [2500.0, 1500.0], [9000.0, 9000.0]])
    (line,) = [line.strip("| ").split(" | ") for line in ladder.goals([whole, base]).splitlines()[2:]]
    assert line[:4] == ["`any-age`", "`bpql`", "", f"{(4500 + 100) / 1200:.2f}"]
    welch = stats.ttest_ind([2500.0, 1500, 9000], [1000.0, 1200], equal_var=False).confidence_interval()
    bare = replace(base, reference_anchor=NO_ANCHOR)  # the released settings are of a preset without delay-free SAC
    assert ladder.goals([whole, bare]) == ladder.goals([whole, base])
    assert line[6] == f"+{13000 / 3 - 1100:,.0f} ({welch.low:+,.0f} to {welch.high:+,.0f})"
