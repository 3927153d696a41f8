"""What an evaluation plays, and what its rows say."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from delayrl.agents.random import Random
from delayrl.core.types import Spec
from delayrl.delays import as_delay
from delayrl.envs.making import make
from delayrl.errors import DelayRLError
from delayrl.play.evaluation import EVALUATION, Episodes, reset_seed
from delayrl.run.condition import resolve
from delayrl.training import recorder
from delayrl.training.recorder import Recorder
from delayrl.training.state import Ways
from delayrl.training.tracking import Tracker

STATE = Random().init(Spec(2, 1, 2), jax.random.key(0))
SEEDS, RETURNS, LENGTHS = [5, 6], np.array([[1.0, 2.0], [4.0, 8.0]]), np.array([[7, 6], [5, 4]])


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Two seeds, two episodes; their recorder, the rows it appends, what it tracks, what its evaluator is given."""
    rows, tracked, given = [], [], []

    def tracker(kind: None, path: int, step: int) -> Any:
        return SimpleNamespace(write=lambda step, values: tracked.append((path, step, values)))

    monkeypatch.setattr(recorder, "Tracker", tracker)

    def started(protocol: str) -> Any:
        setup = resolve("random", "delayrl/Counter-v0", 2, "small", protocol, {"evaluation_episodes": 2})
        folders = [SimpleNamespace(path=seed, append=lambda kind, new: rows.extend(new)) for seed in SEEDS]
        keys, spec = jax.vmap(jax.random.key)(np.array(SEEDS)), Spec(2, 1, 2)
        group: Any = SimpleNamespace(setup=setup, seeds=SEEDS, folders=folders, keys=keys, spec=spec, apply=map)
        group.ways, env = Ways(), make("delayrl/Counter-v0", as_delay(2))
        state: Any = SimpleNamespace(step=0, learner=SimpleNamespace(agent=STATE), actors=[SimpleNamespace(env=env)])
        made = Recorder(group, state)
        made._evaluators = {"agent": lambda *args: given.append(args) or Episodes(RETURNS, LENGTHS)}  # type: ignore
        return made

    return SimpleNamespace(started=started, rows=rows, tracked=tracked, given=given)


def test_rows_are_of_their_seed_and_episode(played: Any) -> None:
    played.started("corrected").evaluate(100, STATE)
    found = [(r["seed"], r["step"], r["episode"], r["return"], r["length"], r["reset_seed"]) for r in played.rows]
    assert found == [
        (seed, 100, e, RETURNS[i, e], LENGTHS[i, e], reset_seed(seed, EVALUATION, 100, e))
        for i, seed in enumerate(SEEDS)
        for e in range(2)
    ]
    assert played.tracked == [(5, 100, {"return/agent": 1.5}), (6, 100, {"return/agent": 6.0})]


def test_every_evaluation_has_start_states_and_noise_of_its_own(played: Any) -> None:
    made = played.started("corrected")
    for step in (100, 200):
        made.evaluate(step, STATE)
    starts = [seed for _, resets, *_ in played.given for row in resets for seed in row]
    assert len(set(starts)) == 8
    keys = [tuple(jax.random.key_data(key).tolist()) for _, _, of_seeds, *_ in played.given for key in of_seeds]
    assert len(set(keys)) == 4


def test_official_evaluation_has_the_runs_start_state(played: Any) -> None:
    """One start state for each seed, but travel times and openings of their own."""
    played.started("official").evaluate(100, STATE)
    ((_, resets, _, opening, travel),) = played.given
    assert resets == [[5, 5], [6, 6]]
    assert travel == [[reset_seed(seed, EVALUATION, 100, e) for e in range(2)] for seed in SEEDS]
    assert opening.shape == (2, 2, 1, 1)
    assert len(np.unique(opening)) == 4
    for actions, numbers in zip(opening, travel, strict=True):  # not the draws of which start states are made
        for own, number in zip(actions, numbers, strict=True):
            assert own[0, 0] != np.float32(np.random.default_rng(number).uniform(-1, 1))


def test_what_is_not_finite_is_not_written(played: Any) -> None:
    with pytest.raises(DelayRLError, match="q is nan at step 1000 of seed 6: training diverged"):
        played.started("corrected").log(1000, {"q": np.array([1.0, np.nan])}, True)


def test_tensorboard_goes_on_where_the_run_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stopped run had logged after its checkpoint is not shown, what it had logged at its step is (TensorBoard
    hides `purge_step` and what comes after); the file is closed with the run.
    """
    done = []

    def writer(folder: str, purge_step: int) -> Any:
        done.append((folder, purge_step))
        return SimpleNamespace(add_scalar=lambda *values: done.append(values), close=lambda: done.append("closed"))

    monkeypatch.setitem(sys.modules, "tensorboardX", SimpleNamespace(SummaryWriter=writer))
    tracker = Tracker("tensorboard", tmp_path, 300)
    tracker.write(400, {"return/agent": 1.5})
    tracker.close()
    assert done == [(str(tmp_path / "tensorboard"), 301), ("return/agent", 1.5, 400), "closed"]
    nothing = Tracker(None, tmp_path, 0)
    nothing.write(400, {"return/agent": 1.5})
    nothing.close()
