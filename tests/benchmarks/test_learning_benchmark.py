"""Time to a return, and the ladder's table, from rows whose answer is known."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path[:0] = [str(Path(__file__).parents[2] / "benchmarks")]

import ladder  # noqa: E402
from learning import times  # noqa: E402

from delayrl.report.results import Curves, Place, Result, Setting  # noqa: E402
from delayrl.run.cell import Progress  # noqa: E402
from delayrl.run.condition import Condition  # noqa: E402
from delayrl.run.cost import Cost  # noqa: E402


def write(folder: Path, side: str, seed: int, returns: list[float | None]) -> None:
    """A run that is evaluated every 1,000 steps, a minute apart."""
    config = {"side": side, "preset": "matched", "set": [], "env": "X-v0", "delay": 5, "seed": seed}
    lines: list[dict] = [{"config": config, "versions": {"cores": 2}}]
    lines += [{"step": 1000 * i, "seconds": 60.0 * i, "return": value} for i, value in enumerate(returns, 1)]
    (folder / f"{side}-{seed}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_time_to_a_return(tmp_path: Path) -> None:
    """The first evaluation that is as high, the median over the seeds that have one; a last line may have none."""
    write(tmp_path, "bpql", 0, [0.0, 1000.0, 900.0, 2500.0])
    write(tmp_path, "bpql", 1, [0.0, 0.0, 0.0, 1200.0])
    write(tmp_path, "released", 0, [-5.0, None])
    text = times.section(tmp_path, tmp_path / "times.png")
    cells = {
        line.split(" | ")[1]: line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| 5")
    }
    ours, theirs = cells["`bpql`, `matched`"], cells["VDPO, released code"]
    assert ours[2:6] == ["2", "3.0 min (3,000 steps)", "4.0 min (4,000 steps; 1 of 2 seeds)", "–"]
    assert ours[6:] == ["1,850", "4", "16.7"]
    assert theirs[2:] == ["1", "–", "–", "–", "-5", "2", "16.7"]
    assert (tmp_path / "times.png").stat().st_size > 5_000


def result(agent: str, delay: int, returns: list[list[float]], **overrides: float) -> Result:
    condition = Condition(agent, "X-v0", delay, preset="matched", overrides={"precision": "bfloat16", **overrides})
    place = Place(Setting("corrected", "matched"), "X-v0", delay, agent)
    curves = Curves(np.arange(1, len(returns[0]) + 1), np.array(returns))
    cost = Cost(100, {}, (8,), 1.234e9)
    return Result(place, condition, Progress("done", 2), len(returns), False, False, curves, cost=cost)


def test_the_ladder_compares_with_bpql() -> None:
    """The mean of an arm's curves over that of BPQL's, and how many seeds got away."""
    base = result("bpql", 25, [[1000.0, 1000.0], [1200.0, 1200.0]])
    arm = result("any-age", 25, [[2000.0, 2000.0], [2400.0, 1400.0]], pull_weight=0.0)
    lines = ladder.table([arm, base]).splitlines()[2:]
    cells = [line.strip("| ").split(" | ") for line in lines]
    assert cells[0][:2] == ["`any-age`, `pull_weight=0.0`", "2"]
    own = ladder.area(arm).mean()
    assert float(cells[0][3]) == pytest.approx(own / 1100, abs=0.01)
    assert cells[0][4].startswith(f"+{own - 1100:,.0f} (")
    assert cells[0][7:] == ["1 of 2", "1.23"]
    assert cells[1][3:5] == ["", ""]
    assert ladder.name(result("sac", 0, [[0.0], [1.0]])) == "`sac`, no delay"
    whole = result("any-age", 25, [[2500.0, 2500.0], [2500.0, 1500.0], [9000.0, 9000.0]])
    line = ladder.table([whole, arm, base]).splitlines()[3].strip("| ").split(" | ")
    assert line[5] == "+300 (-2,241 to +2,841)"  # gaps of 500 and 100, t = 12.706; the third seed has no other
    assert ladder.front([base]).splitlines()[2] == "| `bpql` | 25 |  | 1,100 ± 141 | 1,000 · 1,200 | 0 | 1.23 |"
