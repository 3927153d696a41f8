"""What version 0.1 wrote still opens: a run that was stopped, and a bundle. Tables: tests/bench/test_results.py."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import delayrl
from delayrl.deploy import load_bundle
from delayrl.run.folder import Run

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
    arrays = Run(stopped).latest().arrays("agent")
    assert {"belief_opt_state.0.count", "reference.actor_opt_state.0.count"} <= arrays.keys()
    assert not [name for name in arrays if "memory" in name]
    action = delayrl.load(stopped).act(np.zeros(4), {"age": 2, "actions": np.zeros((3, 1))})
    assert np.isfinite(action).all()


@pytest.mark.thorough
def test_a_run_is_resumed(stopped: Path) -> None:
    before = Run(stopped).read("rows")
    run = delayrl.train("vdpo", "InvertedPendulum-v5", out=stopped, progress=False, **OPTIONS)
    assert run.latest().complete
    assert run.latest().step == 480
    assert run.read("rows")[: len(before)] == before
    assert {row["step"] for row in run.read("rows")} == {160, 320, 480}


def test_a_bundle_is_loaded() -> None:
    bundle = load_bundle(DATA / "bundle-0.1")
    assert bundle.max_age == 3
    assert np.isfinite(bundle(np.zeros(4), np.zeros((3, 1)), 3)).all()
