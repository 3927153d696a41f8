"""VDPO: what it clones from, its losses, its behaviour."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import ACT, ENV, OBS, counted, random_windows, same, sampled, seen

from conftest import TINY, TINY_SAC, quick, record
from delayrl.agents.registry import AGENTS
from delayrl.agents.vdpo import VDPO, unseen
from delayrl.core import networks
from delayrl.core.networks import Gaussian
from delayrl.core.types import Spec
from delayrl.core.views import network_input


def test_unseen_is_what_the_delay_hides() -> None:
    """x_{t+1}: the states after its observation, in order, up to s_{t+1}; fewer at the start of an episode."""
    transitions, windows = counted(4, 150, batch=400, ahead=3)
    x, windows = jax.device_get((unseen(windows), windows))  # reading single entries is slow in JAX
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    for i in range(400):
        step = by_action[float(windows.action[i, 4, 0])]
        now, length = transitions[step].obs
        count = min(int(now) + 1, 4)
        np.testing.assert_array_equal(x.mask[i], [True] * count + [False] * (4 - count))
        np.testing.assert_array_equal(x.obs[i], [now + 1 - count, length])
        for j in range(count):
            np.testing.assert_array_equal(x.states[i, j], [now + 2 - count + j, length])
            np.testing.assert_array_equal(x.actions[i, j], transitions[step + 1 - count + j].action)


def vdpo_parts(agent: VDPO, delay: int = 3):
    transitions, _ = record(ENV, delay, 60)
    spec = Spec(OBS, ACT, delay)
    return agent.init(spec, jax.random.key(0)), sampled(transitions, spec, 16, 3)


@pytest.mark.parametrize("representation", quick(["transformer", "transformer-no-belief", "mlp"], "transformer"))
def test_who_learns_what(representation: str) -> None:
    """Belief trains encoder and decoder; cloning the head alone, and the encoder too where nothing else does."""
    agent = dataclasses.replace(TINY["vdpo"], representation=representation)
    state, windows = vdpo_parts(agent)
    updated, metrics = jax.jit(agent.update)(state, windows, jax.random.key(1), jnp.int32(0))
    cloned, _ = jax.jit(agent.clone)(state, windows, jax.random.key(1), jnp.int32(0))
    believes = representation == "transformer"
    assert ("belief_loss" in metrics) == believes
    assert same(updated.encoder, state.encoder) != believes
    assert same(updated.head, state.head)
    assert not same(cloned.head, state.head)
    assert same(cloned.encoder, state.encoder) != (representation == "transformer-no-belief")
    assert same(cloned.reference, state.reference)
    assert same(cloned.decoder, state.decoder)


@pytest.mark.parametrize("representation", ["transformer", "mlp"])
def test_one_network_serves_every_age(representation: str, rng: np.random.Generator) -> None:
    """The action at age d is position d - 1's; padding has no influence; at age 0 the reference acts."""
    agent = dataclasses.replace(TINY["vdpo"], representation=representation)
    state, _ = vdpo_parts(agent, 4)
    for age in range(1, 5):
        what = seen(4, age, rng)
        action = agent.act(state, what, jax.random.key(0), explore=False)
        position = jnp.tanh(agent.policy(state, what.obs, what.actions).mean[age - 1])
        np.testing.assert_allclose(action, position, atol=1e-6)
        noisy = what._replace(actions=what.actions.at[age:].set(0.7))
        np.testing.assert_allclose(agent.act(state, noisy, jax.random.key(0), explore=False), action, atol=1e-6)
    what = seen(4, 0, rng)
    reference = agent.reference.act(state.reference, what._replace(truth=what.obs), jax.random.key(0), explore=False)
    np.testing.assert_array_equal(agent.act(state, what, jax.random.key(0), explore=False), reference)


def test_belief_loss_by_hand() -> None:
    """Masked mean over B × Δ of the mean squared error, padded zeros counted."""
    agent = dataclasses.replace(TINY["vdpo"], dropout=0.0)
    state, windows = vdpo_parts(agent)
    x = unseen(windows)
    loss, _ = agent.belief_loss((state.encoder, state.decoder), x, jax.random.key(0))
    states = agent.encode(state.encoder, x.obs, x.actions, None) @ state.decoder["w"] + state.decoder["b"]
    errors = np.square(np.asarray(states) - np.asarray(x.states)).mean(-1) * np.asarray(x.mask)
    np.testing.assert_allclose(loss, errors.sum() / x.mask.size, rtol=1e-5)


@pytest.mark.parametrize("direction", ["reverse", "forward"])
def test_clone_loss_by_hand(direction: str) -> None:
    agent = dataclasses.replace(TINY["vdpo"], dropout=0.0, direction=direction)
    state, windows = vdpo_parts(agent)
    x = unseen(windows)
    loss, _ = agent.clone_loss({"head": state.head}, state, x, jax.random.key(0))
    delayed = agent.policy(state, x.obs, x.actions)
    reference = agent.reference.policy(state.reference.actor, x.states)
    p, q = (delayed, reference) if direction == "reverse" else (reference, delayed)
    m, s, n, u = (np.asarray(v, np.float64) for v in (p.mean, np.exp(p.log_std), q.mean, np.exp(q.log_std)))
    kl = (np.log(u / s) + (s**2 + (m - n) ** 2) / (2 * u**2) - 0.5).mean(-1) * np.asarray(x.mask)
    np.testing.assert_allclose(loss, kl.mean(), rtol=1e-4)


def test_behaviour() -> None:
    """Only `delayed` does without the true state; `lower-q` executes the sample that the critics think less of."""
    agents = {
        behaviour: dataclasses.replace(TINY["vdpo"], behaviour=behaviour, dropout=0.0)
        for behaviour in ("lower-q", "delayed", "reference", "mixture")
    }
    assert {behaviour for behaviour, agent in agents.items() if agent.privileged} == {"lower-q", "reference", "mixture"}
    state, _ = vdpo_parts(agents["lower-q"])
    other = agents["lower-q"].reference.init(Spec(OBS, ACT, 0), jax.random.key(9))
    state = state._replace(reference=state.reference._replace(target=other.target))  # which has no say

    @jax.jit
    def chosen(what, key):
        actions = {behaviour: agent.act(state, what, key, explore=True) for behaviour, agent in agents.items()}
        q = [
            networks.twin(state.reference.critic, what.truth, actions[name]).min() for name in ("reference", "delayed")
        ]
        return actions, q

    took_reference = []
    for seed in range(20):
        what = seen(3, 2, np.random.default_rng(seed), truth=True)
        actions, q = jax.device_get(chosen(what, jax.random.key(seed)))
        np.testing.assert_array_equal(actions["lower-q"], actions["reference" if q[0] < q[1] else "delayed"])
        took_reference.append(np.array_equal(actions["mixture"], actions["reference"]))
    assert 3 < sum(took_reference) < 17


SPEC = Spec(OBS, ACT, 3)
DROPPING = dataclasses.replace(TINY["vdpo"], dropout=0.5)


@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_belief_and_cloning_have_dropout(rate: float) -> None:
    """Their losses depend on the key, and without dropout they do not."""
    agent = dataclasses.replace(DROPPING, dropout=rate)
    state, x = agent.init(SPEC, jax.random.key(0)), unseen(random_windows(SPEC))
    belief = jax.jit(lambda key: agent.belief_loss((state.encoder, state.decoder), x, key)[0])
    cloning = jax.jit(lambda key: agent.clone_loss({"head": state.head}, state, x, key)[0])
    for loss in (belief, cloning):
        assert (loss(jax.random.key(1)) != loss(jax.random.key(2))) == (rate > 0)


def test_behaviour_has_dropout_and_evaluation_none(rng: np.random.Generator) -> None:
    """A sample of the policy at the shown age, with dropout and noise of their own keys; at age 0 of the reference."""
    agent = dataclasses.replace(DROPPING, behaviour="delayed")
    state, key = agent.init(SPEC, jax.random.key(0)), jax.random.key(7)
    dropout_key, delayed_key, *_ = jax.random.split(key, 4)
    for age in (0, 1, 3):
        what = seen(3, age, rng)
        policy, plain = (agent.policy(state, what.obs, what.actions, k) for k in (dropout_key, None))
        current = agent.reference.policy(state.reference.actor, what.obs)
        at_age, mode = (Gaussian(p.mean[age - 1], p.log_std[age - 1]) if age else current for p in (policy, plain))
        expected = networks.sample(at_age, delayed_key)[0]
        np.testing.assert_allclose(agent.act(state, what, key, explore=True), expected, atol=1e-6)
        np.testing.assert_allclose(agent.act(state, what, key, explore=False), networks.mode(mode), atol=1e-6)


def test_the_two_policies_have_noise_of_their_own(rng: np.random.Generator) -> None:
    state, what, key = DROPPING.init(SPEC, jax.random.key(0)), seen(3, 2, rng, truth=True), jax.random.key(7)
    agent = dataclasses.replace(DROPPING, behaviour="reference")
    reference_key = jax.random.split(key, 4)[2]
    expected = networks.sample(agent.reference.policy(state.reference.actor, what.truth), reference_key)[0]
    np.testing.assert_allclose(agent.act(state, what, key, explore=True), expected, atol=1e-6)


def test_the_reference_is_sac() -> None:
    """It learns as SAC does, from the same batch, by a key and a count of its own."""
    agent = dataclasses.replace(TINY["vdpo"], representation="mlp")
    state, windows, key = agent.init(SPEC, jax.random.key(0)), random_windows(SPEC), jax.random.key(1)
    new, metrics = jax.jit(agent.update)(state, windows, key, jnp.int32(1))
    update = jax.jit(agent.reference.update)
    expected, of_sac = update(state.reference, windows, jax.random.split(key)[0], jnp.int32(1))
    assert not same(expected.actor, state.reference.actor)
    for a, b in zip(jax.tree.leaves((new.reference, metrics)), jax.tree.leaves((expected, of_sac)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def bounded(tokens: int, number: int):
    """An agent without a bound, the same with one, a batch, and as many of its windows as the bound leaves."""
    agent, windows = dataclasses.replace(TINY["vdpo"], dropout=0.0), random_windows(SPEC)
    return agent, dataclasses.replace(agent, tokens=tokens), windows, jax.tree.map(lambda x: x[:number], windows)


@pytest.mark.parametrize(("tokens", "number"), [(4, 2), pytest.param(640, 16, marks=pytest.mark.thorough)])
def test_tokens_bound_the_windows_of_cloning(tokens: int, number: int) -> None:
    """A window has three."""
    agent, few, windows, first = bounded(tokens, number)
    state, key, count = agent.init(SPEC, jax.random.key(0)), jax.random.key(1), jnp.int32(1)
    assert same(few.clone(state, windows, key, count)[0].head, agent.clone(state, first, key, count)[0].head)


@pytest.mark.thorough
@pytest.mark.parametrize(("tokens", "number"), [(4, 2), (640, 16)])
def test_tokens_bound_the_windows_of_belief(tokens: int, number: int) -> None:
    """The reference learns from the whole batch all the same."""
    agent, few, windows, first = bounded(tokens, number)
    state, key, count = agent.init(SPEC, jax.random.key(0)), jax.random.key(1), jnp.int32(1)
    new, metrics = few.update(state, windows, key, count)
    expected, whole = agent.update(state, windows, key, count)[0], agent.update(state, first, key, count)[0]
    assert same(new.reference, expected.reference)
    assert same(new.encoder, whole.encoder)
    assert same(new.encoder, expected.encoder) == (number == 16)
    loss, _ = agent.belief_loss((state.encoder, state.decoder), unseen(first), key)
    np.testing.assert_allclose(metrics["belief_loss"], loss, rtol=1e-6)


def test_phases() -> None:
    learn, clone = TINY["vdpo"].phases()
    assert learn[:3] == (1, 1, 16)
    assert clone[:3] == (10, 3, 16)


def test_the_mlp_sees_the_augmented_state_of_each_age(rng: np.random.Generator) -> None:
    agent = dataclasses.replace(TINY["vdpo"], representation="mlp")
    for age in (1, 2, 3):
        what = seen(3, age, rng)
        rows = agent.encode({}, what.obs, what.actions, None)
        np.testing.assert_allclose(rows[age - 1], network_input(what, "augmented"))


def test_heads_start_small() -> None:
    """Weights N(0, 0.02²) as in the released code, where PyTorch's layers would be uniform within 1 / √inputs."""
    state = VDPO(TINY_SAC, width=64, layers=1).init(SPEC, jax.random.key(0))
    for layer in (state.decoder, *state.head[:2]):
        np.testing.assert_allclose(layer["w"].std(), 0.02, rtol=0.1)


def test_paper_preset() -> None:
    """Every row of the paper's table of hyperparameters (appendix)."""
    agent, schedule = AGENTS["vdpo"].presets["paper"]
    reference = agent.reference
    assert schedule.replay_capacity == 1_000_000
    assert reference.batch_size == 256
    assert schedule.steps == 1_000_000
    assert reference.discount == 0.99
    assert reference.actor_learning_rate == 3e-4
    assert reference.critic_learning_rate == 1e-3
    assert len(reference.hidden) + 1 == 3
    assert reference.hidden == (256, 256)
    assert reference.entropy_per_action == -1
    assert reference.temperature_learning_rate == 1e-3
    assert reference.actor_every == 2
    assert (reference.update_every, reference.updates) == (1, 1)
    assert reference.target_rate == 5e-3
    assert agent.width == 256
    assert agent.layers == 3
    assert agent.dropout == 0.1
    assert agent.learning_rate == 3e-4
    assert agent.phases()[0][:2] == (1, 1)
    assert (agent.clone_every, agent.clone_updates) == (1000, 1000)
    state = jax.eval_shape(lambda key: agent.init(Spec(17, 6, 25), key), jax.random.key(0))
    assert state.encoder["position"].shape == (25, 256)  # sequence length Δ
    assert state.encoder["blocks"][0]["qkv"]["w"].shape == (256, 3 * 256)  # one head
    assert (agent.behaviour, agent.direction, agent.representation) == ("lower-q", "reverse", "transformer")
