"""Pictures of runs: their names are text, not formulas."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from delayrl.errors import DelayRLError
from delayrl.play import plots
from delayrl.play.run import Run
from short_runs import full_disk


def test_names_with_two_dollar_signs(tmp_path: Path) -> None:
    """A task's keyword argument may hold them, such as a path. Between them matplotlib reads a formula."""
    name = 'my_tasks:Arm(model="$HOME/my_$arm")'
    row = {"agent": name, "env": name, "delay": name, "seed": 0, "policy": "agent", "step": 1, "return": 1.0}
    row |= {"episode": 0, "reset_seed": 1, "length": 9}
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "rows.jsonl").write_text(json.dumps(row) + "\n")
    config = {"format": 1, "preset": "small", "hyperparameters": {}, "schedule": {"steps": 1}}
    (folder / "config.json").write_text(json.dumps(config | row))
    plots.curve(Run(folder), tmp_path / "curve.png")
    plots.against_delay([row | {"delay": 1, "returns": [1.0], "episodes": 1}], tmp_path / "delays.png")
    plots.curves([(name, np.ones(1), np.ones((2, 1)))], tmp_path / "curves.png", name)
    assert len(list(tmp_path.glob("*.png"))) == 3


def test_a_full_disk_keeps_the_picture_that_was_there(tmp_path: Path, monkeypatch) -> None:
    picture = tmp_path / "delays.png"
    picture.write_bytes(b"older")
    monkeypatch.setattr(os, "fsync", full_disk)
    row = {"agent": "sac", "env": "E", "seed": 0, "policy": "agent", "step": 1, "delay": 1, "returns": [1.0]}
    with pytest.raises(DelayRLError, match=r"cannot write to .*delays.png: the disk is full"):
        plots.against_delay([row | {"episodes": 1}], picture)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("delays.png", b"older")]
