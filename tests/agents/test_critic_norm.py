"""SAC, and agents built on it, whose critics have batch norm and no target critics (`critic_norm=batch`)."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from learners import seen
from test_critics import written_out

import delayrl
from conftest import TINY, learned, quick, record, replay_of, sample
from delayrl.agents.sac import SAC, State
from delayrl.agents.vdpo import VDPO
from delayrl.core import networks
from delayrl.core.types import Spec, Window
from delayrl.errors import DelayRLError
from delayrl.training.learner import Program

SPEC = Spec(10, 2, 3)
AGENT = SAC("augmented", hidden=(8, 8), batch_size=16, actor_every=1, entropy_unit="scaled", critic_norm="batch")
KEY = jax.random.key(2)


@pytest.fixture(scope="module")
def windows() -> Window:
    """A batch, in a part of which the last step of the target terminates."""
    transitions, _ = record("Reacher-v5", 3, 120)
    windows = sample(replay_of(transitions, SPEC, 200), jax.random.key(0), 16, 3, 3, jnp.int32(0))
    ends = windows.terminated.at[jnp.arange(4), 3 + windows.n_step[:4] - 1].set(True)
    return replace(windows, terminated=ends)


@pytest.fixture(scope="module")
def steps(windows: Window) -> tuple[State, State, dict]:
    """The state before an update, that after it, and the update's metrics."""
    before = AGENT.init(SPEC, jax.random.key(1))
    return before, *jax.jit(AGENT.update)(before, windows, KEY, jnp.int32(0))


def test_update_by_hand(windows: Window, steps: tuple[State, State, dict]) -> None:
    """The critics' step follows a loss whose targets are numbers, from the same pass over both batches."""
    state, after, metrics = steps
    actor_later, critic_later = AGENT._inputs(windows, windows.n_step)
    _, critic_now = AGENT._inputs(windows, 0)
    action, log_prob = networks.sample(AGENT.policy(state.actor, actor_later), jax.random.split(KEY)[0])
    now = np.concatenate([critic_now, windows.action[:, 3]], -1)
    both = np.concatenate([now, np.concatenate([critic_later, action], -1)])
    values = np.stack([written_out(critic, both) for critic in state.critic])
    y = np.zeros(16)
    for i, k in enumerate(np.asarray(windows.n_step)):
        y[i] = sum(0.99**j * float(windows.reward[i, 3 + j]) for j in range(k))
        value = values[:, 16 + i].min() - float(jnp.exp(state.log_temperature)) * float(log_prob[i])
        y[i] += 0.99**k * (i >= 4) * value
    np.testing.assert_allclose(metrics["critic_loss"], ((values[:, :16] - y) ** 2).mean(-1).sum(), rtol=1e-4)
    np.testing.assert_allclose(metrics["q"], values[:, :16].mean(), rtol=1e-3, atol=1e-5)

    def loss(critics: list) -> jax.Array:
        """Batch norm by JAX's own functions."""
        total = 0.0
        for critic in critics:
            x = jnp.asarray(both)
            for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
                x = jax.nn.relu(x) if number else x
                x = jax.nn.standardize(x, axis=0, epsilon=1e-3) * norm["scale"] + norm["shift"]
                x = x @ layer["w"] + layer["b"]
            total += ((x[:16, 0] - y) ** 2).mean()
        return total

    gradient = jax.jit(jax.grad(loss))(state.critic)
    change, _ = optax.adam(1e-3).update(gradient, state.critic_opt_state)
    expected = optax.apply_updates(state.critic, change)
    for ours, theirs in zip(jax.tree.leaves(after.critic), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)
    for ours, theirs in zip(
        jax.tree.leaves(after.critic_opt_state[0].mu), jax.tree.leaves(gradient), strict=True
    ):  # a step of Adam alone would show signs
        np.testing.assert_allclose(ours, 0.1 * theirs, rtol=2e-3, atol=1e-5)
    for critic, running in zip(state.critic, after.target, strict=True):
        hidden = both
        for layer, norm, moments in zip(critic["layers"], critic["norms"], running, strict=True):
            np.testing.assert_allclose(moments.mean, 0.01 * hidden.mean(0), rtol=1e-3, atol=1e-6)
            np.testing.assert_allclose(moments.variance, 0.99 + 0.01 * hidden.var(0), rtol=1e-4)
            normal = (hidden - hidden.mean(0)) / np.sqrt(hidden.var(0) + 1e-3)
            hidden = np.maximum((normal * norm["scale"] + norm["shift"]) @ layer["w"] + layer["b"], 0)


def folded(critic: dict, running: list) -> list:
    """The `mlp` that a critic is with fixed moments."""
    layers = []
    for layer, norm, moments in zip(critic["layers"], critic["norms"], running, strict=True):
        scale = norm["scale"] / jnp.sqrt(moments.variance + 1e-3)
        shift = norm["shift"] - moments.mean * scale
        layers.append({"w": scale[:, None] * layer["w"], "b": layer["b"] + shift @ layer["w"]})
    return layers


def test_actor_climbs_the_critics_by_running_moments(windows: Window, steps: tuple[State, State, dict]) -> None:
    """Its steps are plain SAC's on critics that have the new running moments in their layers."""
    state, after, _ = steps
    plain = replace(AGENT, critic_norm="none")
    expected = state._replace(critic=[folded(*pair) for pair in zip(after.critic, after.target, strict=True)])
    actor_input, critic_input = AGENT._inputs(windows, 0)
    for key in jax.random.split(jax.random.split(KEY)[1], AGENT.actor_updates):
        policy_key, temperature_key = jax.random.split(key)
        expected = plain.improve_actor(expected, actor_input, critic_input, policy_key)
        expected = plain.adjust_temperature(expected, actor_input, -2.0, temperature_key)
    for ours, theirs in zip(jax.tree.leaves(after.actor), jax.tree.leaves(expected.actor), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_vdpo_acts_by_running_moments() -> None:
    """Its behaviour takes the action that is lower by batch norm written out; by the first moments it is another."""
    agent = VDPO(replace(AGENT, actor_sees="current"), behaviour="lower-q", width=8, layers=1)
    state, rng = agent.init(SPEC, jax.random.key(0)), np.random.default_rng(0)
    running = jax.tree.map(lambda x: x + rng.uniform(0, 2, x.shape).astype(np.float32), state.reference.target)
    state = state._replace(reference=state.reference._replace(target=running))
    shown = jax.tree.map(lambda *x: jnp.stack(x), *(seen(3, 3, rng, truth=True) for _ in range(64)))

    def acts(behaviour: str) -> np.ndarray:
        act = jax.vmap(lambda shown: replace(agent, behaviour=behaviour).act(state, shown, KEY, explore=True))
        return np.asarray(act(shown))

    def lower(moments: list) -> np.ndarray:
        q = []
        for action in (reference, delayed):
            pairs = np.concatenate([shown.truth, action], -1)
            q.append(np.min([written_out(one, pairs, own) for one, own in zip(critic, moments, strict=True)], 0))
        return np.where((q[0] < q[1])[:, None], reference, delayed)

    critic, reference, delayed = state.reference.critic, acts("reference"), acts("delayed")
    np.testing.assert_allclose(acts("lower-q"), lower(running), rtol=1e-5)
    assert (acts("lower-q") != lower(agent.init(SPEC, jax.random.key(0)).reference.target)).any()


@pytest.mark.thorough
def test_seeds_in_lockstep_have_their_own_moments() -> None:
    """Two seeds beside each other learn what each learns alone."""
    data, program = [record("Reacher-v5", 3, 60, seed)[0] for seed in range(2)], Program(AGENT, SPEC)

    def run(seeds: list[int]) -> State:
        keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
        *_, (learner, _) = learned(program, keys, [data[seed] for seed in seeds], 50)
        return learner.agent

    together = run([0, 1])
    for seed in range(2):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(run([seed])), strict=True):
            np.testing.assert_allclose(a[seed], b[0], rtol=1e-3, atol=1e-4)


def test_ad_sac_needs_target_critics() -> None:
    agent = replace(TINY["ad-sac"], learner=replace(TINY["ad-sac"].learner, critic_norm="batch"))
    with pytest.raises(DelayRLError, match="critic_norm=batch"):
        agent.init(SPEC, jax.random.key(0))


OPTIONS = {
    "vdpo": {"clone_every": 10, "clone_updates": 1, "width": 8, "layers": 1},
    "dida": {"expert_steps": 110, "round_steps": 10, "imitation_updates": 1},
}
ALIKE = ["sac", "lifting", "a-sac", "sac-memoryless"]


@pytest.mark.parametrize("name", quick(["bpql", "any-age", *OPTIONS, *ALIKE], "bpql", slow=ALIKE))
def test_it_trains(name: str, tmp_path: Path) -> None:
    run = delayrl.train(
        name, "Reacher-v5", 0 if name == "sac" else 3, preset="small", critic_norm="batch", hidden=[8, 8], batch_size=8,
        steps=130, random_steps=100, evaluate_every=130, evaluation_episodes=1, progress=False, out=tmp_path / "run",
        **OPTIONS.get(name, {}),
    )  # fmt: skip
    assert np.isfinite(delayrl.evaluate(run, episodes=1)["mean_return"])
