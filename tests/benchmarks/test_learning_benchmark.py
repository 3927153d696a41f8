"""Time to a return, and the ladder's table, from rows whose answer is known."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import front
import ladder
import numpy as np
import pytest
import timed
from learning import times
from scipy import stats

import delayrl
from delayrl.report.results import NO_ANCHOR, Anchor, Curves, Place, Result, Setting
from delayrl.run.cell import Cell, Progress
from delayrl.run.condition import Condition
from delayrl.run.cost import Cost
from delayrl.training.recorder import Recorder


def write(folder: Path, side: str, seed: int, returns: list[float | None]) -> None:
    """A run that is evaluated every 1,000 steps, a minute apart."""
    config = {"side": side, "preset": "matched", "set": [], "env": "X-v0", "delay": 5, "seed": seed, "minutes": 3.0}
    lines: list[dict] = [{"config": config, "versions": {"cores": 2}}]
    lines += [{"step": 1000 * i, "seconds": 60.0 * i, "return": value} for i, value in enumerate(returns, 1)]
    (folder / f"{side}-{seed}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_time_to_a_return(tmp_path: Path) -> None:
    """The first evaluation that is as high, in the median over all seeds; a last line may have none."""
    write(tmp_path, "bpql", 0, [0.0, 1000.0, 900.0, 2500.0])
    write(tmp_path, "bpql", 1, [0.0, 0.0, 0.0, 1200.0])
    write(tmp_path, "bpql", 2, [0.0, 0.0, 2400.0, 2400.0])
    write(tmp_path, "released", 0, [-5.0, None])
    slow = times.Run([1000, 2000, 3000], [500.0, 560.0, 620.0], [0.0, 0.0, 0.0], 9.0)
    assert times.speed(slow) == pytest.approx(1000 / 60)  # not before it learns
    slowing = times.Run(list(range(8)), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0], [0.0] * 8, 9.0)
    assert times.speed(slowing) == pytest.approx(2 / 4)  # the last quarter
    text = times.section(tmp_path, tmp_path / "times.png")
    cells = {
        line.split(" | ")[1]: line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| 5")
    }
    ours, theirs = cells["`bpql`, `matched`"], cells["VDPO, released code"]
    assert ours[2:6] == ["3", "3.0 min (3,000 steps)", "4.0 min (4,000 steps; 2 of 3 seeds)", "–"]
    assert ours[6:] == ["1,100", "16.7"]  # within the three minutes that all sides have
    assert theirs[2:] == ["1", "–", "–", "–", "-5", "–"]
    assert "after 3 minutes" in text
    assert "- commit unknown: `bpql`, `matched` Δ = 5 seed 0; " in text
    late = [times.Run([1], [60.0], [value], 3.0) for value in (0.0, 0.0, 3000.0)]
    assert times.cell(late, 1000) == "– (1 of 3 seeds)"
    fast = [times.Run([1], [24.0], [3000.0], 3.0)]
    assert [times.ratio(late, fast, 1000), times.ratio(fast, late, 1000)] == ["> 2.5", "< 0.4"]
    assert times.ratio(late, late, 1000) == "–"
    most = [times.Run([1], [seconds], [value], 3.0) for seconds, value in ((48.0, 3000.0), (96.0, 3000.0), (60.0, 0.0))]
    assert times.ratio(most, fast, 1000) == "4.0"  # who does not reach it is last, not at its end
    pairs = {"ours": fast, "slow": [times.Run([1, 2], [60.0, 180.0], [1500.0, 0.0], 3.0)]}
    assert times.ratios({5: pairs}, "ours").splitlines()[2:] == ["| 5 | slow | 2.5 | > 7.5 | > 7.5 |"]
    mixed = [times.Run([1], [24.0], [3000.0], 3.0), times.Run([1, 2], [24.0, 96.0], [0.0, 0.0], 3.0)]
    assert times.ratio(mixed, fast, 1000) == "> 2.5"  # 24 s, and more than 96
    assert (tmp_path / "times.png").stat().st_size > 5_000


def test_options_on_the_command_line_are_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers, lists and truths reach `train` as such, names as text; the file of rows is named by the words."""
    seen: dict[str, object] = {}
    monkeypatch.setattr(Recorder, "evaluate", Recorder.evaluate)  # which a timed run replaces
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "0")
    monkeypatch.setattr(delayrl, "train", lambda *_, **options: seen.update(options))
    words = ["batch_size=64", "hidden=[8,8]", "online=true", "precision=bfloat16", "steps=500"]
    command = ["timed.py", "bpql", "X-v0", "--delay", "5", "--out", str(tmp_path), "--set", *words]
    monkeypatch.setattr(sys, "argv", command)
    timed.main()
    names = ("batch_size", "hidden", "online", "precision", "steps")
    assert [seen[name] for name in names] == [64, [8, 8], True, "bfloat16", 500]
    (file,) = tmp_path.iterdir()
    assert file.name == f"bpql-matched-{'-'.join(words)}-X-v0-delay5-seed0.jsonl"
    assert json.loads(file.read_text().splitlines()[0])["config"]["set"] == words


REFERENCE = Anchor(np.full(2, 3900.0), np.zeros(2), "sac, no delay")


def result(agent: str, delay: int, returns: list[list[float]], **overrides: float) -> Result:
    condition = Condition(agent, "X-v0", delay, preset="matched", overrides={"precision": "bfloat16", **overrides})
    place = Place(Setting("corrected", "matched"), "X-v0", delay, agent)
    curves = Curves(np.arange(1, len(returns[0]) + 1), np.array(returns))
    cost = Cost(100, {}, (8,), 1.234e9)
    found = Result(place, condition, Progress("done", 2), len(returns), False, False, curves, cost=cost)
    return replace(found, random_anchor=Anchor(np.full(2, -100.0), np.zeros(2)), reference_anchor=REFERENCE)


def test_the_ladder_pairs_seeds_by_place() -> None:
    """An arm whose first seeds have not ended would be paired with others."""
    cells = [
        Cell(Condition("bpql", "X-v0", 25, preset="matched"), seeds, str(seeds)) for seeds in ((0, 1), (2, 3), (3,))
    ]
    ladder.check_seeds(cells[:2])
    with pytest.raises(delayrl.DelayRLError, match=r"`bpql` has ended for seeds \[0, 1, 3\]"):
        ladder.check_seeds([cells[0], cells[2]])


def test_the_ladder_compares_with_bpql() -> None:
    """The mean of an arm's curves over that of BPQL's, and how many seeds got away."""
    base = result("bpql", 25, [[1000.0, 1000.0], [1200.0, 1200.0]])
    arm = result("any-age", 25, [[2000.0, 2000.0], [2400.0, 1400.0]], pull_weight=0.0)
    lines = ladder.table([arm, base], {"`any-age`, `pull_weight=0.0`": 1.5}).splitlines()[2:]
    cells = [line.strip("| ").split(" | ") for line in lines]
    assert cells[0][:2] == ["`any-age`, `pull_weight=0.0`", "2"]
    own = ladder.area(arm).mean()
    assert float(cells[0][3]) == pytest.approx((own + 100) / 1200, abs=0.01)  # above the random policy's -100
    assert cells[0][4].startswith(f"+{own - 1100:,.0f} (")
    assert cells[0][7:] == ["1 of 2", "1.23", "1.50"]
    assert cells[1][3:5] == ["", ""]
    assert ladder.name(result("sac", 0, [[0.0], [1.0]])) == "`sac`, no delay"
    whole = result("any-age", 25, [[2500.0, 2500.0], [2500.0, 1500.0], [9000.0, 9000.0]])
    line = ladder.table([whole, arm, base]).splitlines()[3].strip("| ").split(" | ")
    assert line[5] == "+300 (-2,241 to +2,841)"  # gaps of 500 and 100, t = 12.706; the third seed has no other
    smaller = result("any-age", 25, [[2000.0, 2000.0], [2000.0, 1000.0]], batch_size=128)
    changed = result("any-age", 25, [[1000.0, 1000.0], [1000.0, 1000.0]], batch_size=128, n_steps=5)
    lines = [line.strip("| ").split(" | ") for line in ladder.table([whole, smaller, changed]).splitlines()[2:]]
    assert [line[5].split(" ")[0] for line in lines] == ["", "+500", "+750"]  # each with any-age that has its batches


def test_the_result_of_the_first_page(tmp_path: Path) -> None:
    """Each arm where it has ended, with most seeds, at the budget of its task; nothing for what has not run."""

    def of(agent: str, case: front.Case, returns: list[float], steps: int = 0, **overrides: float) -> Result:
        plain = result(agent, case[1], [[0.0, end] for end in returns], **overrides)
        condition = replace(plain.condition, env=case[0], steps=steps or front.STEPS[case[0]])
        return replace(plain, place=plain.place._replace(env=case[0]), condition=condition)

    late, later = front.CASES[1], front.CASES[3]
    few = replace(of("vdpo", late, [1000.0, 1200.0], tokens=1280), privileged=True)
    unfinished = replace(of("bpql", late, [3900.0] * 9), seeds=10)
    longer = of("bpql", late, [3900.0] * 9, steps=10**7)
    many = of("any-age", later, [10.0, 20.0, 30.0, 40.0, 50.0])
    sac = of("sac", (late[0], 0), [3900.0] * 5)
    chosen = front.choose([few, many, of("any-age", later, [0.0]), sac, unfinished, longer, of("dida", late, [1.0])])
    lines = [line.split(" | ") for line in front.table(chosen).splitlines()[2:]]
    assert [line[0] for line in lines] == ["| `sac`, no delay", "| `vdpo` †", "| `any-age`"]
    assert lines[0][1:] == ["**1.00**<br>3,900 ± 0"] * 3 + ["", "", " |"]
    assert lines[1][2] == "**0.30** (0.28 to 0.33; 2 seeds)<br>1,100 ± 141"
    assert lines[2][4] == "**0.03** (0.03 to 0.04)<br>30.0 ± 15.8"
    front.draw(chosen, tmp_path / "result.png")
    assert (tmp_path / "result.png").stat().st_size > 5_000


def test_update_times_are_paired_by_round(tmp_path: Path) -> None:
    """The median of the rounds' ratios; a round that met other work met it on both sides."""
    rows = [{"versions": {}}, {"arm": "`any-age`", "ms": [2.0, 4.0, 90.0]}, {"arm": "`bpql`", "ms": [1.0, 2.0, 30.0]}]
    (tmp_path / "arms.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert ladder.update_times(tmp_path / "arms.jsonl") == {"`any-age`": 2.0, "`bpql`": 1.0}
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
