"""The table that says how many episodes are lost."""

import json
import sqlite3
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import lost

from delayrl.bench.results import TABLES

LEARNER = {"env": "HalfCheetah-v5", "preset": "matched", "protocol": "corrected", "steps": 100_000, "overrides": {}}
CHANCE = {"agent": "random", "delay": 0, "steps": 10_000}
LATE = {"agent": "vdpo", "delay": 25, "overrides": {"precision": "bfloat16", "tokens": 1280}}


def write(file: Path, *cells: tuple[dict[str, Any], str, dict[str, dict[int, list[float]]]]) -> Path:
    """Write a table of cells of one seed: what was trained, its state, and returns by policy and step."""
    with sqlite3.connect(file) as table:
        table.executescript(TABLES)
        for number, (changes, state, policies) in enumerate(cells):
            cell = LEARNER | changes | {"seeds": [0]}
            shared = {"privileged": cell["agent"] == "vdpo"}
            table.execute("INSERT INTO cells VALUES (?, ?, ?, ?, 0, 0)", (str(number), number, json.dumps(cell), state))
            table.execute("INSERT INTO runs VALUES (?, ?, 0, ?, '{}', '{}')", (number, str(number), json.dumps(shared)))
            for policy, evaluations in policies.items():
                for step, returns in evaluations.items():
                    rows = [(number, step, policy, i, 0, x, 1, "{}") for i, x in enumerate(returns)]
                    table.executemany("INSERT INTO rows VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
    return file


def test_an_episode_is_lost_below_0_7_of_the_best_above_chance() -> None:
    """With chance at -100: 0.7 of (900 + 100) is reached by 600, not by 599. The first half does not count."""
    runs = {0: {50: [0.0] * 3, 75: [900.0, 600, 599], 100: [200.0, 200, 200]}}
    found = lost.measure(runs, -100)
    assert found.lost == pytest.approx(1 / 6)
    assert found.others == pytest.approx((900 + 600 + 3 * 200) / 5)
    assert (found.mean, found.change) == pytest.approx(((2099 + 600) / 6, 2099 / 3 - 200))


def test_the_table_has_each_policy_that_has_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not what still runs, nor arms of other batches; a reference has a line of its own; the best comes first."""
    monkeypatch.setattr(lost, "rows_of", lambda *_: "")
    monkeypatch.setattr(lost, "read_table", lambda _: None)
    high, low = {75_000: [90.0, 10.0], 100_000: [90.0, 90.0]}, {75_000: [50.0, 50.0], 100_000: [50.0, 50.0]}
    file = write(
        tmp_path / "some.sqlite",
        (CHANCE, "done", {"agent": {1: [9.0], 10_000: [0.0]}}),
        (LATE, "done", {"agent": low, "reference": high}),
        ({"agent": "bpql", "delay": 25}, "running", {"agent": high}),
        ({"agent": "bpql", "delay": 25, "overrides": {"batch_size": 128}}, "done", {"agent": high}),
    )
    _, _, *lines = lost.section([file, file], tmp_path / "lost.png").strip().splitlines()
    assert lines == [
        "| 25 | `vdpo` †, its reference without delay | 1 | 70 | 25 % | 90 | 40 |",
        "| 25 | `vdpo` † | 1 | 50 | 0 % | 50 | 0 |",
    ]
