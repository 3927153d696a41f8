"""What version 0.1 wrote still opens: a run that was stopped, and a bundle. Tables: tests/bench/test_results.py."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import delayrl
from delayrl.deploy import load_bundle
from delayrl.play.run import Run
from delayrl.run.arrays import restore_tree
from short_runs import newest

DATA = Path(__file__).parents[1] / "data"
OPTIONS = {
    "delay": 3,
    "preset": "small",
    "seed": 5,
    "steps": 480,
    "random_steps": 120,
    "evaluate_every": 160,
    "evaluation_episodes": 2,
    "replay_capacity": 300,
    "hidden": [16, 16],
    "batch_size": 16,
    "width": 8,
    "layers": 2,
    "dropout": 0.1,
    "clone_every": 40,
    "clone_updates": 5,
}


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    return Path(shutil.copytree(DATA / "run-0.1", tmp_path / "run"))


def test_a_run_is_loaded(stopped: Path) -> None:
    """Its optimiser states have other names in the file."""
    assert [name for name in newest(stopped).arrays("agent") if "memory" in name]
    action = delayrl.load(stopped).act(np.zeros(4), {"age": 2, "actions": np.zeros((3, 1))})
    assert np.isfinite(action).all()


def test_a_state_may_have_a_memory_of_its_own() -> None:
    """The old name of optimiser states is only read where the agent has no leaf of that name."""
    arrays = {"memory.w": np.ones(2), "actor_memory.mu": np.zeros(3)}
    template = {"memory": {"w": np.zeros(2)}, "actor_opt_state": {"mu": np.ones(3)}}
    restored = restore_tree(template, arrays, Path("run"))
    assert restored["memory"]["w"].tolist() == [1, 1]
    assert restored["actor_opt_state"]["mu"].tolist() == [0, 0, 0]


@pytest.mark.thorough
def test_a_run_is_resumed(stopped: Path) -> None:
    before = Run(stopped).rows()
    run = delayrl.train("vdpo", "InvertedPendulum-v5", out=stopped, progress=False, tokens=0, **OPTIONS)
    assert newest(run).complete
    assert newest(run).step == 480
    assert run.rows()[: len(before)] == before
    assert {row["step"] for row in run.rows()} == {160, 320, 480}


def test_a_bundle_is_loaded() -> None:
    bundle = load_bundle(DATA / "bundle-0.1")
    assert bundle.max_age == 3
    assert np.isfinite(bundle(np.zeros(4), np.zeros((3, 1)), 3)).all()
