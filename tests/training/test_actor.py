"""One seed's environment: what is stored of it, and who may see the truth."""

from pathlib import Path

import numpy as np
import pytest

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.core.protocol import OFFICIAL
from delayrl.delays import as_delay
from delayrl.envs import make
from delayrl.run.folder import Run
from delayrl.training.actor import Actor
from delayrl.training.loop import hidden_steps
from short_runs import train


@pytest.mark.parametrize("what", ["reward", "observation"])
def test_nan_from_the_environment(what: str, tmp_path: Path, monkeypatch) -> None:
    """The run stops with one line; its last good checkpoint stays, and goes on when the environment is mended."""
    from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv

    step, calls = ReacherEnv.step, 0

    def nan(self, action):
        nonlocal calls
        calls += 1
        obs, reward, *rest = step(self, action)
        if calls > 250:  # 100 steps, 100 of evaluation, and then 50
            obs, reward = (obs * np.nan, reward) if what == "observation" else (obs, np.nan)
        return obs, reward, *rest

    monkeypatch.setattr(ReacherEnv, "step", nan)
    with pytest.raises(delayrl.DelayRLError, match=f"{what} that is not finite"):
        train("bpql", tmp_path / "run")
    monkeypatch.setattr(ReacherEnv, "step", step)
    assert Run(tmp_path / "run").latest().step >= 100
    assert train("bpql", tmp_path / "run").latest().step == 300


def test_official_protocol(tmp_path: Path) -> None:
    """One start state for all episodes, time limits as terminations, a random first action: stated in every row."""
    run = train("a-sac", tmp_path / "run", protocol="official", steps=150)
    rows = run.read("rows")
    assert {row["reset_seed"] for row in rows} == {0}
    assert {row["protocol"] for row in rows} == {"official"}
    assert len({row["return"] for row in rows if row["step"] == 100}) == 2  # the first actions differ
    actor = Actor(make("Reacher-v5", 3, rescale=True), 7, privileged=False, protocol=OFFICIAL)
    first = actor.truth
    steps = [actor.step(np.zeros(2, np.float32)) for _ in range(50)]
    assert steps[-1].done
    assert steps[-1].terminated
    np.testing.assert_array_equal(actor.truth, first)


@pytest.mark.parametrize("agent", list(AGENTS))
def test_unprivileged_agents_are_not_given_the_truth(agent: str) -> None:
    preset = AGENTS[agent].presets["small"]
    delay = as_delay(0 if agent == "sac" else 3)
    actor = Actor(make("Reacher-v5", delay, rescale=True), 0, preset.agent.privileged)
    for _ in range(5):
        actor.step(np.zeros(2, np.float32))
    assert (actor.seen.truth is not None) == preset.agent.privileged
    assert hidden_steps(actor, delay) == (0 if preset.agent.privileged else actor.seen.age)


def test_training_shows_what_the_wrapper_shows() -> None:
    """Actions are stored as they were executed: the history that the actor sees is in [-1, 1], bit for bit."""
    actor = Actor(make("Pusher-v5", 3, rescale=True), 0, privileged=False)
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1, 1, 7).astype(np.float32) for _ in range(5)]
    for action in actions:
        actor.step(action)
    np.testing.assert_array_equal(actor.seen.actions, actions[-3:])
