"""Random actions instead of the agent's: how many, which, from which seed, and what is shown and stored."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import delayrl
from delayrl.core.protocol import Protocol
from delayrl.envs.probe import Walk
from delayrl.training.actor import Actor
from delayrl.wrappers import Delayed, NoisyActions
from short_runs import assert_same_replay, killed_and_resumed, train

gym.register(
    "delayrl/NoisyWalk-v0",
    entry_point=Walk,
    max_episode_steps=50,
    additional_wrappers=(NoisyActions.wrapper_spec(probability=0.4),),
)


class Recorder(gym.Env):
    """Keeps the actions that it gets."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(np.array([-3, 1], np.float32), np.array([-1, 5], np.float32))

    def reset(self, *, seed: int | None = None, options: Any = None):
        super().reset(seed=seed)
        self.taken: list[np.ndarray] = []
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray):
        self.taken.append(np.array(action))
        return np.zeros(1, np.float32), float(action[0]), False, False, {"kept": len(self.taken)}


def played(env: gym.Env, seed: int | None, steps: int, action=(-2.0, 3.0)) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """What the environment got in an episode with one constant action, and its infos."""
    env.reset(seed=seed)
    infos = [env.step(np.array(action, np.float32))[-1] for _ in range(steps)]
    return np.stack(env.unwrapped.taken), infos  # type: ignore[attr-defined]


def test_a_share_of_the_actions_is_uniformly_random() -> None:
    taken, infos = played(NoisyActions(Recorder(), 0.3), 0, 4000)
    replaced = (taken != (-2, 3)).any(axis=1)
    assert replaced.mean() == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / 4000))
    noise = (taken[replaced] - (-3, 1)) / (2, 4)  # the box is [-3, -1] x [1, 5]
    assert noise.min() > 0
    assert noise.max() < 1
    np.testing.assert_allclose(noise.mean(axis=0), 0.5, atol=4 * np.sqrt(1 / 12 / replaced.sum()))
    np.testing.assert_allclose(noise.var(axis=0), 1 / 12, atol=0.01)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 4 / np.sqrt(replaced.sum())
    assert taken.dtype == np.float32
    np.testing.assert_array_equal([info["executed"] for info in infos], taken)
    assert [info["kept"] for info in infos] == list(range(1, 4001))  # what the task itself tells is left alone


@pytest.mark.parametrize(("probability", "share"), [(0.0, 0.0), (1.0, 1.0)])
def test_never_and_always(probability: float, share: float) -> None:
    taken, _ = played(NoisyActions(Recorder(), probability), 0, 100)
    assert (taken != (-2, 3)).any(axis=1).mean() == share


def test_the_reset_seed_fixes_the_random_actions() -> None:
    """And an episode without a seed goes on with new ones."""
    env = NoisyActions(Recorder(), 0.5)
    first, _ = played(env, 7, 50)
    unseeded, _ = played(env, None, 50)
    again, _ = played(env, 7, 50)
    other, _ = played(env, 8, 50)
    np.testing.assert_array_equal(again, first)
    assert not np.array_equal(unseeded, first)
    assert not np.array_equal(other, first)


def test_noise_and_travel_times_have_streams_of_their_own() -> None:
    """The delay does not change the noise, nor the noise the delay."""
    free, _ = played(NoisyActions(Recorder(), 0.5), 7, 50)
    late, infos = played(Delayed(NoisyActions(Recorder(), 0.5), "uniform:0:4"), 7, 50)
    _, quiet = played(Delayed(NoisyActions(Recorder(), 0.0), "uniform:0:4"), 7, 50)
    np.testing.assert_array_equal(late, free)
    assert [info["age"] for info in infos] == [info["age"] for info in quiet]


def test_the_history_and_the_replay_hold_the_agents_actions() -> None:
    """While the true observations follow from those that were executed."""
    actor = Actor(delayrl.make("delayrl/NoisyWalk-v0", 3, rescale=True), 0, privileged=False)
    rng = np.random.default_rng(0)
    issued, moved = [], []
    for _ in range(50):
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        issued.append(action)
        transition = actor.step(action)
        np.testing.assert_array_equal(transition.action, action)
        moved.append(transition.next_obs - transition.obs)
        if not transition.done:
            age = int(actor.seen.age)
            np.testing.assert_array_equal(actor.seen.actions[:age], issued[-age:])
    differs = ~np.isclose(np.ravel(moved), np.ravel(issued), atol=1e-5)
    assert 0.2 < differs.mean() < 0.6


def test_replaying_an_episode_repeats_its_noise() -> None:
    """Resuming depends on it."""
    env = delayrl.make("delayrl/NoisyWalk-v0", 2, rescale=True)
    actor = Actor(env, 3, privileged=False)
    for step in range(70):
        actor.step(np.array([np.sin(step)], np.float32))
    truth, episode, actions = actor.truth.copy(), actor.episode, np.stack(actor.actions)
    actor.start_episode(0)
    actor.replay_episode(episode, actions)
    np.testing.assert_array_equal(actor.truth, truth)


@pytest.mark.parametrize(("start_states", "different"), [("own", 4), ("same", 1)])
def test_each_episode_has_noise_of_its_own(start_states, different: int) -> None:
    """Even where, as in the released code, all of them start in the same state."""
    protocol = Protocol(start_states=start_states)
    actor = Actor(delayrl.make("delayrl/NoisyWalk-v0", 1, rescale=True), 0, False, protocol)
    starts, moves = set(), set()
    for _ in range(4):
        steps = [actor.step(np.zeros(1, np.float32)) for _ in range(50)]
        starts.add(float(steps[0].obs[0]))
        moves.add(tuple(np.ravel([step.next_obs - step.obs for step in steps]) != 0))
    assert len(starts) == different
    assert len(moves) == 4


def test_killed_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a noisy task by its id, in the middle of an episode: the same transitions as uninterrupted."""
    options = {"env": "delayrl/NoisyReacher-v4", "delay": 2}
    whole = train("random", tmp_path / "whole", **options)
    cut = killed_and_resumed("random", tmp_path / "cut", monkeypatch, **options)
    assert cut.rows() == whole.rows()
    assert_same_replay(cut, whole)


def test_the_papers_noisy_tasks() -> None:
    """AD-SAC's: one action in ten is random, on the same physics."""
    noisy = delayrl.make("delayrl/NoisyPusher-v4")
    wrapper = noisy.env
    assert isinstance(wrapper, NoisyActions)
    assert wrapper.probability == 0.1
    assert NoisyActions(Recorder(), np.float32(0.5)).probability == 0.5
    quiet = delayrl.make("delayrl/Pusher-v4")
    for env in (noisy, quiet):
        env.reset(seed=4)
    for _ in range(40):
        obs, *_, info = noisy.step(np.zeros(7, np.float32))
        expected, *_ = quiet.step(info["executed"])
        np.testing.assert_array_equal(obs, expected)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: NoisyActions(Recorder(), 1.5), "from 0 to 1; got 1.5"),
        (lambda: NoisyActions(Recorder(), -0.1), "from 0 to 1; got -0.1"),
        (lambda: NoisyActions(Recorder(), "0.1"), "from 0 to 1; got '0.1'"),
        (lambda: NoisyActions(Delayed(Recorder(), 1), 0.1), "goes inside Delayed"),
        (lambda: NoisyActions(NoisyActions(Recorder(), 0.1), 0.1), "random actions already"),
        (lambda: NoisyActions(gym.make("CartPole-v1"), 0.1), "continuous"),
    ],
)
def test_errors(make, words: str) -> None:
    with pytest.raises(delayrl.DelayRLError, match=words) as error:
        make()
    assert "\n" not in str(error.value)
