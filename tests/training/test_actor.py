"""One seed's environment: what is stored of it, and who may see the truth."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.core.protocol import Protocol
from delayrl.delays import as_delay
from delayrl.envs.making import make
from delayrl.play.evaluation import TRAINING, reset_seed
from delayrl.training.actor import Actor
from delayrl.training.loop import hidden_steps
from delayrl.wrappers import Delayed
from short_runs import newest, train


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
    assert newest(tmp_path / "run").step >= 100
    assert newest(train("bpql", tmp_path / "run")).step == 300


def test_an_environment_that_writes_into_its_own_array() -> None:
    """The replay gets the state before the step and the one after it, not the same array twice."""

    class Reusing(gym.ObservationWrapper):
        array = np.zeros(10, np.float32)

        def observation(self, observation: np.ndarray) -> np.ndarray:
            self.array[:] = [*observation[:9], self.unwrapped.data.time]
            return self.array

    task = Delayed(RescaleAction(Reusing(gym.make("Reacher-v5")), np.float32(-1), np.float32(1)), 3)
    actor = Actor(task, 7, privileged=False)
    steps = [actor.step(np.zeros(2, np.float32)) for _ in range(50)]
    times = np.array([(step.obs[-1], step.next_obs[-1]) for step in steps])
    np.testing.assert_allclose(times, 0.02 * np.stack([np.arange(50), np.arange(1, 51)], 1), rtol=1e-5)


def test_actions_beyond_their_range() -> None:
    """A forgotten tanh would make returns that nobody can compare."""
    actor = Actor(make("Reacher-v5", 3, rescale=True), 7, privileged=False)
    actor.step(np.ones(2, np.float32))
    with pytest.raises(delayrl.DelayRLError, match=r"policy of seed 7 gives actions beyond \[-1, 1\]"):
        actor.step(np.array([0.5, -1.01], np.float32))
    with pytest.raises(delayrl.DelayRLError, match="not finite: training diverged"):
        actor.step(np.array([0.5, np.nan], np.float32))


def test_official_protocol(tmp_path: Path) -> None:
    """One start state for all episodes, time limits as terminations, a random first action: stated in every row."""
    run = train("a-sac", tmp_path / "run", protocol="official", steps=150)
    rows = run.rows()
    assert {row["reset_seed"] for row in rows} == {0}
    assert {row["protocol"] for row in rows} == {"official"}
    assert len({row["return"] for row in rows if row["step"] == 100}) == 2  # the first actions differ
    actor = Actor(make("Reacher-v5", 3, rescale=True), 7, privileged=False, protocol=AGENTS["a-sac"].official)
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


def counter(seed: int = 0) -> Actor:
    return Actor(make("delayrl/Counter-v0", 2, rescale=True), seed, privileged=False)


def test_true_steps_are_stored() -> None:
    """Not what the delay shows: states, ages before and after, and the end; each episode from its own seed."""
    actor, bare = counter(), make("delayrl/Counter-v0")
    for episode in range(5):
        _, info = bare.reset(seed=reset_seed(0, TRAINING, episode))
        length = int(info["truth"][1])
        for t in range(length):
            np.testing.assert_array_equal(actor.truth, [t, length])
            step = actor.step(np.float32([t / 10]))
            np.testing.assert_array_equal([step.obs, step.next_obs], [[t, length], [t + 1, length]])
            assert (step.age, step.next_age) == (min(t, 2), min(t + 1, 2))
            assert (step.action, step.reward) == (np.float32(t / 10), t + 1)
            assert step.terminated == step.done == (t + 1 == length)
        assert actor.episode == episode + 1
        assert not actor.actions


@pytest.mark.parametrize("limit", ["bootstraps", "terminates"])
def test_time_limit(limit: str) -> None:
    """It ends the episode; that no value follows, is said under the protocol alone that says so."""
    protocol = Protocol(time_limit=limit)  # type: ignore[arg-type]
    actor = Actor(make("delayrl/Walk-v0", 2, rescale=True), 0, privileged=False, protocol=protocol)
    steps = [actor.step(np.zeros(1, np.float32)) for _ in range(50)]
    assert [bool(step.done) for step in steps] == [False] * 49 + [True]
    assert [bool(step.terminated) for step in steps] == [False] * 49 + [limit == "terminates"]


def test_one_start_state_has_many_travel_times() -> None:
    protocol = Protocol(start_states="same")
    actor = Actor(make("delayrl/Walk-v0", "uniform:0:3", rescale=True), 7, privileged=False, protocol=protocol)
    starts, ages = [], []
    for _ in range(3):
        starts.append(actor.truth.tolist())
        ages.append([int(actor.step(np.zeros(1, np.float32)).next_age) for _ in range(50)])
    assert starts[0] == starts[1] == starts[2]
    assert ages[0] != ages[1] != ages[2]


def test_a_resumed_episode_is_the_same() -> None:
    """The same seed and actions lead to the same state, with its history."""
    actor, again = counter(), counter()
    while actor.episode < 3 or len(actor.actions) < 3:
        actor.step(np.float32([0.1 * len(actor.actions)]))
    again.replay_episode(actor.episode, np.array(actor.actions))
    np.testing.assert_array_equal(again.truth, actor.truth)
    np.testing.assert_array_equal(again.actions, actor.actions)
    for one, other in zip(again.seen[:3], actor.seen[:3], strict=True):
        np.testing.assert_array_equal(one, other)
