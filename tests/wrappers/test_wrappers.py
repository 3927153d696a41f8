"""Constant delays, from the first step on; the wrappers need no JAX."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import (
    FrameStackObservation,
    NormalizeObservation,
    RescaleAction,
    TimeLimit,
    TransformObservation,
)

import delayrl
from delayrl.errors import DelayWarning
from delayrl.wrappers import AugmentedObservation, Delayed
from delayrl.wrappers.layers import check_spaces, seconds_of


def rollout(env: gym.Env, steps: int, seed: int = 0) -> tuple[list, list, list]:
    env.action_space.seed(1)
    obs, info = env.reset(seed=seed)
    observations, infos, actions = [obs], [info], []
    for _ in range(steps):
        actions.append(env.action_space.sample())
        obs, _, terminated, truncated, info = env.step(actions[-1])
        observations.append(obs)
        infos.append(info)
        if terminated or truncated:
            break
    return observations, infos, actions


@pytest.mark.parametrize("delay", [0, 1, 3, 7])
@pytest.mark.parametrize("task", ["Reacher-v5", "Hopper-v5", "Pendulum-v1"])
def test_shift(task: str, delay: int) -> None:
    """At step t the agent sees s_{t-d}, d = min(t, Δ), and the d actions since."""
    true, _, _ = rollout(gym.make(task), 30)
    seen, infos, actions = rollout(delayrl.make(task, delay), 30)
    assert len(seen) > 8
    for t, (obs, info) in enumerate(zip(seen, infos, strict=True)):
        age = min(t, delay)
        assert info["age"] == age
        np.testing.assert_array_equal(obs, true[t - age])
        np.testing.assert_array_equal(info["truth"], true[t])
        np.testing.assert_array_equal(info["actions"][:age], actions[t - age : t] or info["actions"][:0])
        assert not info["actions"][age:].any()
        assert info["mask"].tolist() == [True] * age + [False] * (delay - age)


def test_reset_forgets() -> None:
    """A second episode shows nothing of the first."""
    env = delayrl.make("Reacher-v5", 3)
    first, infos, _ = rollout(env, 20, seed=4)
    again, infos_again, _ = rollout(env, 20, seed=4)
    np.testing.assert_array_equal(first, again)
    assert [i["age"] for i in infos] == [i["age"] for i in infos_again] == [0, 1, 2] + [3] * 18


def test_augmented_is_flat() -> None:
    plain = delayrl.make("Pusher-v5", 4)
    env = AugmentedObservation(delayrl.make("Pusher-v5", 4))
    seen, infos, _ = rollout(plain, 10)
    flat, _, _ = rollout(env, 10)
    assert env.observation_space.shape == (23 + 4 * 7 + 1,)
    for obs, info, x in zip(seen, infos, flat, strict=True):
        np.testing.assert_allclose(x, np.concatenate([obs, info["actions"].ravel(), [info["age"] / 4]]))
        assert env.observation_space.contains(x)


def test_augmented_over_other_wrappers() -> None:
    """The outer wrappers' observation, the actions in the delay's own units, the age; the checker finds no fault."""
    plain = rescaled_actions(delayrl.make("Pusher-v5", 4))
    halved = TransformObservation(rescaled_actions(delayrl.make("Pusher-v5", 4)), lambda obs: obs / 2, None)
    env = AugmentedObservation(TimeLimit(halved, 8))
    seen, infos, _ = rollout(plain, 20)
    flat, _, _ = rollout(env, 20)
    assert len(flat) == 9
    for obs, info, x in zip(seen, infos, flat, strict=False):
        np.testing.assert_allclose(x, np.concatenate([obs / 2, info["actions"].ravel(), [info["age"] / 4]]))
        assert env.observation_space.contains(x)
    assert max(abs(x[23:-1]).max() for x in flat) > 1  # Pusher's range is ±2, the agent's is ±1


def rescaled_actions(env: gym.Env) -> gym.Env:
    return RescaleAction(env, np.float32(-1), np.float32(1))


def test_augmented_and_normalised() -> None:
    """The first S numbers are what NormalizeObservation shows without us, number for number."""
    env = AugmentedObservation(NormalizeObservation(Delayed(gym.make("Pendulum-v1"), 3)))
    without = NormalizeObservation(Delayed(gym.make("Pendulum-v1"), 3))
    for ours, theirs in zip(rollout(env, 20)[0], rollout(without, 20)[0], strict=True):
        np.testing.assert_array_equal(ours[:3], theirs)
        assert env.observation_space.contains(ours)
    made_again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert made_again.observation_space == env.observation_space


def test_what_cannot_be_augmented() -> None:
    once = AugmentedObservation(delayrl.make("Pendulum-v1", 2))
    for env, words in (
        (TimeLimit(gym.make("Pendulum-v1"), 3), "wrap the task in Delayed first"),
        (TimeLimit(once, 3), "augmented already"),
        (FrameStackObservation(delayrl.make("Pendulum-v1", 2), 2), "flat vectors; got Box"),
    ):
        with pytest.raises(delayrl.DelayRLError, match=words):
            AugmentedObservation(env)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("augmented", [False, True])
def test_gymnasium_checker(augmented: bool) -> None:
    env = delayrl.make("Reacher-v5", 3)
    check_env(AugmentedObservation(env) if augmented else env, skip_render_check=True)


@pytest.mark.parametrize(
    ("delay", "words"),
    [(-1, "negative"), (2.5, "whole"), ("x", "not a number"), (True, "whole"), (51, "longer than an episode")],
)
def test_bad_delays(delay: object, words: str) -> None:
    with pytest.raises(delayrl.DelayRLError, match=words):
        delayrl.make("Reacher-v5", delay)  # type: ignore[arg-type]


def test_images_and_unbounded_actions() -> None:
    class Images(gym.Env):
        observation_space = gym.spaces.Box(0, 1, (3, 3))
        action_space = gym.spaces.Box(-1, 1, (1,))

    class Unbounded(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (3,))
        action_space = gym.spaces.Box(-np.inf, np.inf, (1,))

    with pytest.raises(delayrl.DelayRLError, match="flat vectors; got Box"):
        Delayed(Images(), 1)
    with pytest.raises(delayrl.DelayRLError, match="bounded"):
        Delayed(Unbounded(), 1)


def test_what_an_environment_must_have(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refusals say what to do instead; a step in milliseconds is noticed by the frames."""
    monkeypatch.setattr("delayrl.wrappers.layers._warned", set())
    numbers, actions = gym.spaces.Box(-1, 1, (3,)), gym.spaces.Box(-1, 1, (2,))
    cases = [
        (gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), actions, "nothing here learns from images; observe the pose"),
        (numbers, gym.spaces.Discrete(4), r"got Discrete\(4\): let the environment take a Box"),
        (numbers, gym.spaces.Box(-np.inf, np.inf, (2,)), "give the actuators' limits"),
    ]
    for observations, given, words in cases:
        with pytest.raises(delayrl.DelayRLError, match=words):
            check_spaces("Dog", observations, given)
    env = gym.make("Pendulum-v1").unwrapped
    env.dt, env.metadata = 50, {"render_fps": 20}
    with pytest.warns(DelayWarning, match="takes 50 s by its dt or tau, and its render_fps says 0.05 s"):
        assert seconds_of(env) == 50


def test_an_episode_in_which_nothing_is_observed(monkeypatch) -> None:
    """A delay as long as the episode, as the paper's Reacher at 50 steps: s_0 is shown to the end, ever older."""
    monkeypatch.setattr("delayrl.wrappers.layers._warned", set())
    with pytest.warns(DelayWarning, match=r"of 50 steps nothing after the start .* Reacher-v5 \(50 steps\)") as warned:
        env = delayrl.make("Reacher-v5", 50)
    if sys.version_info >= (3, 12):  # before, the stack is counted, and make goes one call deeper than Delayed
        assert warned[0].filename == __file__
    observations, infos, actions = rollout(env, 60)
    assert len(actions) == 50
    for step, (obs, info) in enumerate(zip(observations, infos, strict=True)):
        np.testing.assert_array_equal(obs, observations[0])
        assert info["age"] == step
        np.testing.assert_array_equal(info["actions"][:step], np.reshape(actions[:step], (step, 2)))
    with pytest.warns(DelayWarning, match="nothing after the start"):
        delayrl.make("Reacher-v5", 49)
    delayrl.make("Reacher-v5", 48)
    delayrl.make("Reacher-v5", "1+action=48")
    delayrl.make("Reacher-v5", "uniform:1:50")


def test_an_action_of_another_shape_is_refused() -> None:
    env = delayrl.make("Pendulum-v1", 3)
    env.reset(seed=0)
    for action in (0.0, [0.0, 1.0], [[0.0]]):
        with pytest.raises(delayrl.DelayRLError, match=r"an action has the shape \(1,\); got one of "):
            env.step(action)


def test_what_is_no_environment_is_refused() -> None:
    with pytest.raises(
        delayrl.DelayRLError, match=r"takes an environment; got 'Pendulum-v1': gymnasium.make makes one"
    ):
        Delayed("Pendulum-v1", 3)  # type: ignore[arg-type]
    with pytest.raises(delayrl.DelayRLError, match="DelayedVector takes a vector"):
        Delayed(gym.make_vec("Pendulum-v1", 2), 3)  # type: ignore[arg-type]
    with pytest.raises(delayrl.DelayRLError, match=r"got None$"):
        delayrl.make(gym.Env, 3)
