"""Which runs of the small tasks are collected."""

import sys
from pathlib import Path

import numpy as np
import small

import delayrl
from delayrl.run.folder import RunFolder

CONFIG = {"agent": "sac", "preset": "small", "env": "X-v0", "delay": 0, "hyperparameters": {}, "schedule": {"steps": 9}}


def test_a_run_without_a_checkpoint_does_not_stop_the_others(tmp_path: Path, monkeypatch, capsys) -> None:
    """Killed before its first one, it has not ended; nor has one that goes on."""
    monkeypatch.chdir(tmp_path)
    for seed, complete in enumerate((True, None, False)):
        run = RunFolder(Path("runs/small/walk/sac") / f"seed{seed}")
        run.create(CONFIG)
        if complete is not None:
            run.save(9, {"w": np.zeros(1)}, None, {}, complete=complete)
    collected: list[Path] = []
    monkeypatch.setattr(small, "collect", lambda out, runs, *_, **__: collected.extend(runs))
    monkeypatch.setattr(delayrl, "train", lambda *_, **__: None)
    monkeypatch.setattr(sys, "argv", ["small.py", "walk", "sac"])
    small.main()
    assert [path.name for path in collected] == ["seed0"]
    assert "left out: runs/small/walk/sac/seed1 has no checkpoint yet" in capsys.readouterr().out
