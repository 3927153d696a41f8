"""SAC, and agents built on it, whose critics have batch norm and no target critics (`critic_norm=batch`)."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from learners import seen

import delayrl
from conftest import TINY, quick, record, replay_of, sample
from delayrl.agents.critics import in_training, plain
from delayrl.agents.sac import SAC
from delayrl.agents.vdpo import VDPO
from delayrl.core import networks
from delayrl.core.types import Spec, Window
from delayrl.errors import DelayRLError

SPEC = Spec(10, 2, 3)
AGENT = SAC("augmented", hidden=(8, 8), batch_size=16, actor_every=1, entropy_unit="scaled", critic_norm="batch")
update = jax.jit(AGENT.update)


@pytest.fixture(scope="module")
def windows() -> Window:
    transitions, _ = record("Reacher-v5", 3, 120)
    return sample(replay_of(transitions, SPEC, 200), jax.random.key(0), 16, 3, 3, jnp.int32(0))


@pytest.mark.thorough
def test_update_by_hand(windows: Window) -> None:
    """The critics' step follows a loss whose targets are numbers, from the same pass over both batches."""
    state, key = AGENT.init(SPEC, jax.random.key(1)), jax.random.key(2)
    after, metrics = update(state, windows, key, jnp.int32(0))
    actor_later, critic_later = AGENT._inputs(windows, windows.n_step)
    _, critic_now = AGENT._inputs(windows, 0)
    action, log_prob = networks.sample(AGENT.policy(state.actor, actor_later), jax.random.split(key)[0])
    now = jnp.concatenate([critic_now, windows.action[:, 3]], -1)
    later = jnp.concatenate([critic_later, action], -1)
    both = jnp.concatenate([now, later])
    following = np.asarray(in_training(state.critic, both)[0][:, 16:])
    y = np.zeros(16)
    for i, k in enumerate(np.asarray(windows.n_step)):
        y[i] = sum(0.99**j * float(windows.reward[i, 3 + j]) for j in range(k))
        going_on = not bool(windows.terminated[i, 3 + k - 1])
        value = following[:, i].min() - float(jnp.exp(state.log_temperature)) * float(log_prob[i])
        y[i] += 0.99**k * going_on * value

    def loss(critics: list) -> jax.Array:
        return ((in_training(critics, both)[0][:, :16] - y) ** 2).mean(-1).sum()

    value, gradient = jax.jit(jax.value_and_grad(loss))(state.critic)
    np.testing.assert_allclose(metrics["critic_loss"], value, rtol=1e-4)
    change, _ = optax.adam(1e-3).update(gradient, state.critic_opt_state)
    expected = optax.apply_updates(state.critic, change)
    for ours, theirs in zip(jax.tree.leaves(after.critic), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)
    for ours, theirs in zip(
        jax.tree.leaves(after.critic_opt_state[0].mu), jax.tree.leaves(gradient), strict=True
    ):  # a step of Adam alone would show signs
        np.testing.assert_allclose(ours, 0.1 * theirs, rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(after.target[1][0].mean, 0.01 * both.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(after.target[1][0].variance, 0.99 + 0.01 * both.var(0), rtol=1e-4)


def test_actor_climbs_the_plain_critics(windows: Window) -> None:
    """Its step is SAC's on critics that have the running moments in their layers."""
    state = AGENT.init(SPEC, jax.random.key(1))
    after, _ = update(state, windows, jax.random.key(2), jnp.int32(0))
    expected = state._replace(critic=plain(after.critic, after.target), target=[None, None])
    actor_input, critic_input = AGENT._inputs(windows, 0)
    for key in jax.random.split(jax.random.split(jax.random.key(2))[1], AGENT.actor_updates):
        policy_key, temperature_key = jax.random.split(key)
        expected = AGENT.improve_actor(expected, actor_input, critic_input, policy_key)
        expected = AGENT.adjust_temperature(expected, actor_input, -2.0, temperature_key)
    for ours, theirs in zip(jax.tree.leaves(after.actor), jax.tree.leaves(expected.actor), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_vdpo_acts_by_the_plain_critics(rng: np.random.Generator) -> None:
    """Its reference's critics choose between two actions, one sample at a time."""
    agent = VDPO(replace(AGENT, actor_sees="current"), behaviour="lower-q", width=8, layers=1)
    state = agent.init(SPEC, jax.random.key(0))
    moments = jax.tree.map(lambda x: x + jax.random.uniform(jax.random.key(1), x.shape), state.reference.target)
    state = state._replace(reference=state.reference._replace(target=moments))
    shown = seen(3, 3, rng, truth=True)
    chosen = agent.act(state, shown, jax.random.key(3), explore=True)
    read = state.reference._replace(critic=plain(state.reference.critic, moments))
    by_plain = replace(agent, reference=replace(agent.reference, critic_norm="none"))
    same = by_plain.act(state._replace(reference=read), shown, jax.random.key(3), explore=True)
    np.testing.assert_allclose(chosen, same, rtol=1e-5)


def test_ad_sac_needs_target_critics() -> None:
    agent = replace(TINY["ad-sac"], learner=replace(TINY["ad-sac"].learner, critic_norm="batch"))
    with pytest.raises(DelayRLError, match="critic_norm=batch"):
        agent.init(SPEC, jax.random.key(0))


@pytest.mark.parametrize("name", quick(["sac", "bpql", "any-age", "lifting"], "bpql"))
def test_it_trains(name: str, tmp_path: Path) -> None:
    run = delayrl.train(
        name, "Reacher-v5", 0 if name == "sac" else 3, preset="small", critic_norm="batch", hidden=[8, 8], batch_size=8,
        steps=120, random_steps=100, evaluate_every=120, evaluation_episodes=1, progress=False, out=tmp_path / "run",
    )  # fmt: skip
    assert np.isfinite(delayrl.evaluate(run, episodes=1)["mean_return"])
