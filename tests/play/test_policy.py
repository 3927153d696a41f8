"""A loaded policy acts in the task's units, and refuses what it was not trained for."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box

import delayrl
from conftest import TINY
from delayrl.core.types import Spec
from delayrl.play.evaluation import evaluate
from delayrl.play.policy import Policy
from delayrl.play.run import Run
from random_states import random_state


def test_load_and_act(vdpo: Run) -> None:
    """The loaded policy, in the task's own units, plays what evaluation played."""
    policy = delayrl.load(vdpo.path)
    result = evaluate(vdpo.path, episodes=2, seed=5)
    from delayrl.play.evaluation import HELD_OUT, reset_seed

    env = delayrl.make("Reacher-v5", delay=3)
    for episode in range(2):
        obs, info = env.reset(seed=reset_seed(5, HELD_OUT, episode))
        total, done = 0.0, False
        while not done:
            obs, reward, terminated, truncated, info = env.step(policy.act(obs, info))
            total += float(reward)
            done = terminated or truncated
        np.testing.assert_allclose(total, result["returns"][episode], rtol=1e-3)


def test_policy_in_other_units() -> None:
    """Pendulum's actions lie in ±2: `act` takes and gives them so."""
    env, scaled = delayrl.make("Pendulum-v1", 3), delayrl.make("Pendulum-v1", 3, rescale=True)
    spec, space = Spec(3, 1, 3), env.action_space
    policy = Policy(TINY["bpql"], random_state(TINY["bpql"], spec), spec, space.low, space.high)
    (obs, info), (obs2, info2) = env.reset(seed=1), scaled.reset(seed=1)
    from delayrl.core.views import seen_now

    for _ in range(6):
        action = policy.act(obs, info)
        seen = seen_now(obs2, info2, 3, privileged=False)
        inner = np.asarray(policy.agent.act(policy.state, seen, jax.random.key(0), explore=False))
        np.testing.assert_allclose(action, 2 * inner, atol=1e-4)
        obs, _, _, _, info = env.step(action)
        obs2, _, _, _, info2 = scaled.step(inner)


def test_an_action_is_in_the_tasks_range() -> None:
    """A task in double precision, whose range single precision does not hold, refuses what lies beyond."""
    space = Box(-0.1, np.float64([0.3, 0.7, 0.9]), (3,), np.float64)
    for sign in (-1, 1):
        agent = SimpleNamespace(act=lambda state, seen, key, explore, sign=sign: jnp.full(3, sign, jnp.float32))
        policy = Policy(agent, None, Spec(1, 3, 0), space.low, space.high)  # type: ignore[arg-type]
        action = policy.act(np.zeros(1), {"age": 0, "actions": []})
        assert space.contains(action.astype(np.float64))
        np.testing.assert_allclose(action, space.high if sign > 0 else space.low, rtol=1e-6)


def test_policy_refuses_what_it_does_not_know(vdpo: Run) -> None:
    policy = delayrl.load(vdpo.path)
    obs, actions = np.zeros(10), np.zeros((9, 2))
    with pytest.raises(delayrl.DelayRLError, match=r"ages 0\.\.3"):
        policy.act(obs, {"age": 4, "actions": actions})
    with pytest.raises(delayrl.DelayRLError, match="size 10"):
        policy.act(obs[:4], {"age": 1, "actions": actions})
    with pytest.raises(delayrl.DelayRLError, match="needs the 3 actions"):
        policy.act(obs, {"age": 3, "actions": actions[:2]})
    for wrong in (np.zeros(6), np.zeros((3, 1))):  # would be other actions for each joint
        with pytest.raises(delayrl.DelayRLError, match="rows of 2 numbers; got shape"):
            policy.act(obs, {"age": 3, "actions": wrong})
    assert policy.act(obs, {"age": 0, "actions": []}).shape == (2,)
    with pytest.raises(delayrl.DelayRLError, match="not finite"):
        policy.act(obs * np.nan, {"age": 1, "actions": actions})
    for info in ({}, {"age": 1}, {"actions": actions}):
        with pytest.raises(delayrl.DelayRLError, match=r"the info that `Delayed` gives: it has no age and actions"):
            policy.act(obs, info)
    for age in (2.7, None, "2"):
        with pytest.raises(delayrl.DelayRLError, match="an age is an integer"):
            policy.act(obs, {"age": age, "actions": actions})
    with pytest.raises(delayrl.DelayRLError, match="arrays of numbers"):
        policy.act(obs, {"age": 2, "actions": [[0, 0], [0]]})
    for wrong in ([["left", "right"]], [[None, None]], [[1j, 0]]):
        with pytest.raises(delayrl.DelayRLError, match="real numbers"):
            policy.act(obs, {"age": 1, "actions": wrong})
    unknown = np.vstack([actions[:2], [[np.nan, np.nan]]])  # what it does not read is not refused
    np.testing.assert_array_equal(*(policy.act(obs, {"age": 2, "actions": given}) for given in (actions, unknown)))
