"""The ladder's arms with CrossQ's critics: against batch norm written out, and trained by its name."""

from dataclasses import fields
from pathlib import Path

import crossq
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import delayrl
from conftest import record, replay_of, sample
from delayrl.agents.registry import AGENTS, Registration
from delayrl.agents.sac import SAC
from delayrl.core import networks
from delayrl.core.types import Spec, Window

SPEC = Spec(10, 2, 3)
AGENT = crossq.CrossQ(
    actor_sees="augmented", hidden=(8, 8), batch_size=16, actor_every=1, n_steps=3, entropy_unit="scaled", momentum=0.9
)
update = jax.jit(AGENT.update)


@pytest.fixture(scope="module")
def windows() -> Window:
    transitions, _ = record("Reacher-v5", 3, 120)
    return sample(replay_of(transitions, SPEC, 200), jax.random.key(0), 16, 3, 3, jnp.int32(0))


def written_out(critic: dict, x: np.ndarray) -> np.ndarray:
    """Batch norm, linear, ReLU, batch norm, …, with NumPy."""
    for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
        x = np.maximum(x, 0) if number else x
        x = (x - x.mean(0)) / np.sqrt(x.var(0) + 1e-3) * np.asarray(norm["scale"]) + np.asarray(norm["shift"])
        x = x @ np.asarray(layer["w"]) + np.asarray(layer["b"])
    return x[:, 0]


def drawn(seed: int) -> tuple[dict, np.ndarray]:
    """A critic with norms of any scale and shift, and a batch far from mean 0 and deviation 1."""
    keys = jax.random.split(jax.random.key(seed), 8)
    critic = crossq.critic_init(keys[0], (5, 8, 8, 1))
    critic["norms"] = [
        {"scale": 1 + jax.random.normal(key, (size,)), "shift": jax.random.normal(key, (size,))}
        for key, size in zip(keys[1:], (5, 8, 8), strict=False)
    ]
    return critic, np.asarray(3 + 2 * jax.random.normal(keys[5], (32, 5)))


def test_values_are_batch_norms() -> None:
    critic, x = drawn(0)
    q, moments = crossq.in_training(critic, jnp.asarray(x))
    np.testing.assert_allclose(q, written_out(critic, x), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(moments[0].mean, x.mean(0), rtol=1e-5)
    np.testing.assert_allclose(moments[0].variance, x.var(0), rtol=1e-4)


def test_folded_critic_has_the_moments_in_its_layers() -> None:
    """With the batch's own moments an `mlp` gives the batch's values; one sample's no longer hang on the others."""
    critic, x = drawn(1)
    q, moments = crossq.in_training(critic, jnp.asarray(x))
    mlp = crossq.folded(critic, moments)
    np.testing.assert_allclose(networks.mlp(mlp, jnp.asarray(x))[:, 0], q, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(networks.mlp(mlp, jnp.asarray(x[:3]))[:, 0], q[:3], rtol=1e-4, atol=1e-4)


@pytest.mark.thorough
def test_update_by_hand(windows: Window) -> None:
    """The critics' step follows a loss whose targets are numbers, from the same pass over both batches."""
    state, key = AGENT.init(SPEC, jax.random.key(1)), jax.random.key(2)
    after, metrics = update(state, windows, key, jnp.int32(0))
    actor_next, later = AGENT._inputs(windows, windows.n_step)
    _, now = AGENT._inputs(windows, 0)
    action, log_prob = networks.sample(AGENT.policy(state.actor, actor_next), jax.random.split(key)[0])
    both = np.concatenate([np.concatenate([now, windows.action[:, 3]], -1), np.concatenate([later, action], -1)])
    following = np.stack([written_out(critic, both) for critic in state.critic])[:, 16:].min(0)
    y = np.zeros(16)
    for i, k in enumerate(np.asarray(windows.n_step)):
        y[i] = sum(0.99**j * float(windows.reward[i, 3 + j]) for j in range(k))
        going_on = not bool(windows.terminated[i, 3 + k - 1])
        y[i] += 0.99**k * going_on * (following[i] - float(jnp.exp(state.log_temperature)) * float(log_prob[i]))

    def loss(critics):
        q = jnp.stack([crossq.in_training(critic, jnp.asarray(both))[0][:16] for critic in critics])
        return ((q - y) ** 2).mean(-1).sum()

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
    moments = crossq.in_training(state.critic[1], jnp.asarray(both))[1]
    np.testing.assert_allclose(after.target[1][0].mean, 0.1 * moments[0].mean, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(after.target[1][2].variance, 0.9 + 0.1 * moments[2].variance, rtol=1e-4)


def test_actor_climbs_the_folded_critic(windows: Window) -> None:
    """Its step is SAC's on plain critics that have the running moments in their layers."""
    state = AGENT.init(SPEC, jax.random.key(1))
    after, _ = update(state, windows, jax.random.key(2), jnp.int32(0))
    critics = [crossq.folded(*pair) for pair in zip(after.critic, after.target, strict=True)]
    expected = state._replace(critic=critics)
    actor_input, critic_input = AGENT._inputs(windows, 0)
    for key in jax.random.split(jax.random.split(jax.random.key(2))[1], AGENT.actor_updates):
        policy_key, temperature_key = jax.random.split(key)
        expected = AGENT.improve_actor(expected, actor_input, critic_input, policy_key)
        expected = AGENT.adjust_temperature(expected, actor_input, -2.0, temperature_key)
    for ours, theirs in zip(jax.tree.leaves(after.actor), jax.tree.leaves(expected.actor), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def sac_of(registration: Registration, preset: str) -> SAC:
    """The SAC that an agent is, or has inside."""
    agent = registration.presets[preset].agent
    return agent if isinstance(agent, SAC) else agent.bpql


@pytest.mark.parametrize(
    ("name", "ours"), [("any-age", crossq.ANY_AGE), ("bpql", crossq.BPQL), ("sac", crossq.DELAY_FREE)]
)
@pytest.mark.parametrize("preset", ["small", "matched", "paper"])
def test_only_the_critics_differ(name: str, ours: Registration, preset: str) -> None:
    plain, agent = sac_of(AGENTS[name], preset), sac_of(ours, preset)
    differing = {field.name for field in fields(SAC) if getattr(plain, field.name) != getattr(agent, field.name)}
    assert isinstance(agent, crossq.CrossQ)
    assert agent.critic_norm == "none"
    assert differing - {"critic_norm"} == {"target_rate"}
    assert ours.presets[preset].schedule == AGENTS[name].presets[preset].schedule


@pytest.mark.thorough
def test_it_trains_by_its_name(tmp_path: Path) -> None:
    run = delayrl.train(
        "crossq:ANY_AGE", "Reacher-v5", 3, preset="small", hidden=[8, 8], batch_size=8, steps=120, random_steps=100,
        evaluate_every=120, evaluation_episodes=1, progress=False, out=tmp_path / "run",
    )  # fmt: skip
    assert np.isfinite(delayrl.evaluate(run, episodes=1)["mean_return"])
