"""Which runs of the small tasks are collected."""

from pathlib import Path

import numpy as np
import small

from delayrl.run.folder import RunFolder

CONFIG = {"agent": "sac", "preset": "small", "env": "X-v0", "delay": 0, "hyperparameters": {}, "schedule": {"steps": 9}}


def test_a_run_without_a_checkpoint_does_not_stop_the_others(tmp_path: Path, capsys) -> None:
    """Killed before its first one, it has not ended; nor has one that goes on."""
    for seed, complete in enumerate((True, None, False)):
        run = RunFolder(tmp_path / "sac" / f"seed{seed}")
        run.create(CONFIG)
        if complete is not None:
            run.save(9, {"w": np.zeros(1)}, None, {}, complete=complete)
    assert small.complete_runs(tmp_path) == [tmp_path / "sac" / "seed0"]
    assert f"left out: {tmp_path}/sac/seed1 has no checkpoint yet" in capsys.readouterr().out
