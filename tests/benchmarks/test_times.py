"""Time to a return, from rows whose answer is known."""

import json
from pathlib import Path

import pytest
from learning import times


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
    heads = [{"versions": {"jax": "0.11", "commit": None, "cores": 2}}, {"versions": {"jax": "0.12", "commit": "abc"}}]
    assert times.made_with(heads) == "jax 0.11 and 0.12, commit abc"
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
    later = [
        times.Run([1], [seconds], [value], 9.0) for seconds, value in ((60.0, 3000.0), (90.0, 3000.0), (70.0, 0.0))
    ]
    assert times.ratio([times.Run([1], [180.0], [0.0], 9.0)], later, 1000) == "> 2.0"  # over 90 s, not over 70
    assert (tmp_path / "times.png").stat().st_size > 5_000
