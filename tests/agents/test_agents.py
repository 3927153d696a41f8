"""What holds for every agent, and the identities between them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conftest import TINY, TINY_SAC, learned, record
from delayrl.agents.random import Random
from delayrl.agents.registry import AGENTS
from delayrl.agents.vdpo import VDPO, Unseen, unseen
from delayrl.core import networks
from delayrl.core import replay as ring
from delayrl.core.types import Seen, Spec
from delayrl.errors import DelayRLError
from delayrl.training.learner import Program, Stored

ENV, OBS, ACT = "Reacher-v5", 10, 2
DELAYED = ["sac-memoryless", "a-sac", "bpql", "lifting", "ad-sac", "dcac", "dida", "vdpo"]
PRIVILEGED = {name for name in DELAYED if TINY[name].privileged}


@functools.cache
def program_of(agent, delay: int) -> Program:
    """Compiled once for all tests."""
    return Program(agent, Spec(OBS, ACT, delay))


def trained(agent, delay: int, updates: int = 12, hidden: int = 0, transitions=None):
    """An agent's state after some environment steps with updates, as the loop makes them."""
    transitions = transitions or record(ENV, delay, 120)[0]
    program = program_of(agent, delay)
    keys = jax.vmap(jax.random.key)(jnp.arange(1))
    first_update = len(transitions) - updates + 1
    *_, (learner, metrics) = learned(program, keys, [transitions], first_update, hidden=lambda step: hidden)
    return learner, metrics, keys


def counted(delay: int, steps: int, batch: int, ahead: int):
    """Random play of the counter, and windows of it."""
    transitions, _ = record("delayrl/Counter-v0", delay, steps)
    replay = ring.init(Spec(2, 1, delay), 2 * steps)
    for transition in transitions:
        replay = jax.jit(ring.append)(replay, transition)
    sample = jax.jit(ring.sample, static_argnums=(2, 3, 4))
    return transitions, sample(replay, jax.random.key(0), batch, delay, ahead, jnp.int32(0))


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def seen(delay: int, age: int, rng: np.random.Generator, truth: bool = False) -> Seen:
    actions = np.zeros((delay, ACT), np.float32)
    actions[:age] = rng.uniform(-1, 1, (age, ACT))
    obs = rng.normal(size=(2, OBS)).astype(np.float32)
    return Seen(jnp.asarray(obs[0]), jnp.int32(age), jnp.asarray(actions), jnp.asarray(obs[1]) if truth else None)


def test_registry_is_tested() -> None:
    assert set(DELAYED) | {"sac", "random"} == set(AGENTS)


@pytest.mark.parametrize("name", list(AGENTS))
@pytest.mark.parametrize("preset", ["paper", "small"])
def test_presets_are_whole(name: str, preset: str) -> None:
    """Every preset initialises for its task, and every hyperparameter says what it means."""
    agent, _ = AGENTS[name].presets[preset]
    delay = 0 if name == "sac" else 5
    state = jax.eval_shape(lambda key: agent.init(Spec(17, 6, delay), key), jax.random.key(0))
    assert jax.tree.leaves(state)
    assert hash(agent) == hash(dataclasses.replace(agent))


def test_zero_delay_is_one_algorithm() -> None:
    """Without a delay SAC, A-SAC and BPQL end with bitwise equal parameters."""
    agents = [TINY_SAC, TINY["a-sac"], TINY["bpql"], TINY["sac-memoryless"]]
    states = [trained(agent, 0, 20)[0].agent for agent in agents]
    for state in states[1:]:
        assert same(states[0], state)


def test_views_are_what_the_table_says() -> None:
    """Actor and critic of each agent see s_t, s_{t-d} or x_t, and nothing else."""
    _, windows = counted(3, 60, batch=50, ahead=1)
    true, late = windows.obs[:, 3, 0], windows.obs[:, 3, 0] - windows.age[:, 3]
    for name, actor_time, critic_time, sizes in (
        ("sac-memoryless", late, late, (2, 2)),
        ("a-sac", late, late, (6, 6)),
        ("bpql", late, true, (6, 2)),
    ):
        actor, critic = TINY[name]._inputs(windows, 0)
        assert (actor.shape[1], critic.shape[1]) == sizes
        np.testing.assert_array_equal(actor[:, 0], actor_time)
        np.testing.assert_array_equal(critic[:, 0], critic_time)


@pytest.mark.parametrize("name", DELAYED)
def test_same_seed_twice(name: str) -> None:
    assert same(trained(TINY[name], 3)[0].agent, trained(TINY[name], 3)[0].agent)


@pytest.mark.parametrize("name", DELAYED)
def test_lockstep_seeds_are_seeds_alone(name: str) -> None:
    """Three seeds beside each other learn what each learns alone, up to the rounding of batched products."""
    agent = TINY[name]
    data = [record(ENV, 3, 60, seed)[0] for seed in range(3)]

    def run(seeds: list[int]):
        keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
        *_, (learner, _) = learned(program_of(agent, 3), keys, [data[seed] for seed in seeds], 46, capacity=100)
        return learner.agent

    together = run([0, 1, 2])
    for seed in range(3):
        alone = run([seed])
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[seed], b[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["bpql", "vdpo"])
def test_a_block_of_steps_is_its_steps(name: str) -> None:
    """Five steps learned from in one call, and one by one; the rarer phase is due at the block's end."""
    agent, data = TINY[name], record(ENV, 3, 90)[0]
    program = program_of(agent, 3)
    keys = jax.vmap(jax.random.key)(jnp.arange(1))
    ends = []
    for block in (1, 5):
        metrics = {}
        options = {"hidden": lambda step: step % 3, "capacity": 100, "block": block}
        for learner, new in learned(program, keys, [data], 61, **options):
            metrics |= new
            last = learner
        ends.append((last, metrics))
    assert set(ends[0][1]) == set(ends[1][1])
    for a, b in zip(jax.tree.leaves(ends[0][0]), jax.tree.leaves(ends[1][0]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(jax.__version_info__ < (0, 12), reason="JAX 0.10, the newest for Python 3.11, copies the replay")
@pytest.mark.parametrize("seeds", [1, 2])
@pytest.mark.parametrize("block", [1, 4])
def test_learning_copies_no_replay(seeds: int, block: int) -> None:
    """What the compiled step needs beside its arguments does not grow with the replay, which is updated in place."""
    program = program_of(TINY["bpql"], 3)
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    step = jax.tree.map(lambda x: np.stack([[x] * seeds] * block), record(ENV, 3, 1)[0][0])
    stored, steps = Stored(step, np.zeros((block, seeds), np.int32)), np.full(block, 100)
    needed = []
    for capacity in (200, 100_000):
        learner = jax.eval_shape(lambda capacity=capacity: program.init(keys, capacity))
        lowered = program._jitted_learn.lower(learner, stored, keys, steps, first_phase=True)
        compiled = lowered.compile({"xla_backend_optimization_level": 3})
        needed.append(compiled.memory_analysis().temp_size_in_bytes)
    assert needed[0] == needed[1]


def test_bfloat16_products_are_close(monkeypatch) -> None:
    """`precision = bfloat16` rounds the inputs of products: what it does to a belief loss and its gradient."""
    agent = VDPO(TINY_SAC, width=64, layers=3, dropout=0.0)
    state = agent.init(Spec(OBS, ACT, 5), jax.random.key(0))
    draw = jax.random.normal(jax.random.key(1), (64, OBS + 5 * ACT + 5 * OBS))
    obs, actions, states = jnp.split(draw, [OBS, OBS + 5 * ACT], 1)
    x = Unseen(obs, actions.reshape(64, 5, ACT), states.reshape(64, 5, OBS), jnp.ones((64, 5), bool))

    def evaluated():
        loss = jax.value_and_grad(agent.belief_loss, has_aux=True)
        (value, _), gradient = loss((state.encoder, state.decoder), x, jax.random.key(0))
        return float(value), np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradient)])

    value, gradient = evaluated()
    exact = networks.linear
    rounded = lambda x: x.astype(jnp.bfloat16).astype(jnp.float32)  # noqa: E731
    for module in ("networks", "transformer"):
        monkeypatch.setattr(
            f"delayrl.core.{module}.linear",
            lambda params, x: exact({"w": rounded(params["w"]), "b": params["b"]}, rounded(x)),
        )
    coarse_value, coarse = evaluated()
    error = np.linalg.norm(coarse - gradient) / np.linalg.norm(gradient)
    assert 0 < error < 0.02
    assert abs(coarse_value / value - 1) < 1e-3


@pytest.mark.parametrize("name", DELAYED)
def test_acting_never_peeks(name: str, rng: np.random.Generator) -> None:
    """A deterministic action depends on nothing but (observation, age, actions since), whatever the truth is."""
    learner, _, _ = trained(TINY[name], 3)
    state = jax.tree.map(lambda x: x[0], learner.agent)
    for age in range(4):
        what = seen(3, age, rng)
        action = TINY[name].act(state, what, jax.random.key(0), explore=False)
        for truth in (-1e3, 1e3):  # whatever is handed to it
            told = what._replace(truth=jnp.full(OBS, truth))
            np.testing.assert_array_equal(action, TINY[name].act(state, told, jax.random.key(1), explore=False))
        assert np.abs(np.asarray(action)).max() <= 1


HONEST = {name: TINY[name] for name in DELAYED if name not in PRIVILEGED} | {
    "vdpo, behaviour delayed": dataclasses.replace(TINY["vdpo"], behaviour="delayed"),
    "ad-sac, behaviour augmented": dataclasses.replace(TINY["ad-sac"], behaviour="augmented"),
    "ad-sac, auxiliary delay 1": dataclasses.replace(TINY["ad-sac"], auxiliary_delay=1),
}


@pytest.mark.parametrize("name", list(HONEST))
def test_unprivileged_behaviour_needs_no_truth(name: str, rng: np.random.Generator) -> None:
    agent = HONEST[name]
    state = agent.init(Spec(OBS, ACT, 3), jax.random.key(0))
    assert not agent.privileged
    agent.act(state, seen(3, 2, rng), jax.random.key(0), explore=True)


@pytest.mark.parametrize("name", list(HONEST))
def test_learning_never_peeks(name: str) -> None:
    """What has not arrived may be anything: an unprivileged learner ends with the same parameters."""
    transitions, _ = record(ENV, 3, 40)
    poisoned = [*transitions]
    for i, step in enumerate(transitions[-3:], len(transitions) - 3):  # s_{t-2}, s_{t-1}, s_t have not arrived
        poisoned[i] = step._replace(next_obs=np.full_like(step.next_obs, 1e6), reward=np.float32(-1e6))
        if i + 1 < len(transitions):
            poisoned[i + 1] = transitions[i + 1]._replace(obs=np.full_like(step.next_obs, 1e6))
    for i in range(len(transitions) - 2, len(transitions)):
        poisoned[i] = poisoned[i]._replace(obs=np.full_like(transitions[0].obs, 1e6))
    clean = trained(HONEST[name], 3, 1, hidden=3, transitions=transitions)[0].agent
    assert same(clean, trained(HONEST[name], 3, 1, hidden=3, transitions=poisoned)[0].agent)
    assert not same(clean, trained(HONEST[name], 3, 1, hidden=0, transitions=poisoned)[0].agent)


def test_memoryless_sees_no_actions(rng: np.random.Generator) -> None:
    learner, _, _ = trained(TINY["sac-memoryless"], 3)
    state = jax.tree.map(lambda x: x[0], learner.agent)
    one = seen(3, 3, rng)
    two = one._replace(actions=-one.actions)
    act = TINY["sac-memoryless"].act
    np.testing.assert_array_equal(
        act(state, one, jax.random.key(0), explore=False), act(state, two, jax.random.key(0), explore=False)
    )


def test_bpql_is_aligned() -> None:
    """On a counter: critics at (s_t, a_t) with t the true step, the actor at s_{t-d} with the actions since."""
    transitions, windows = counted(2, 80, batch=500, ahead=1)
    actor, critic = TINY["bpql"]._inputs(windows, 0)
    actor_next, critic_next = TINY["bpql"]._inputs(windows, windows.n_step)
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    for i in range(500):
        step = by_action[float(windows.action[i, 2, 0])]
        now, length = transitions[step].obs
        age = min(int(now), 2)
        np.testing.assert_array_equal(critic[i], [now, length])
        np.testing.assert_array_equal(critic_next[i], [now + 1, length])
        since = [transitions[step - age + j].action[0] if j < age else 0 for j in range(2)]
        np.testing.assert_allclose(actor[i], [now - age, length, *since, age / 2])
        age = min(int(now) + 1, 2)
        since = [transitions[step + 1 - age + j].action[0] if j < age else 0 for j in range(2)]
        np.testing.assert_allclose(actor_next[i], [now + 1 - age, length, *since, age / 2])


def test_sac_needs_the_current_state() -> None:
    with pytest.raises(DelayRLError, match="delay-free reference"):
        TINY_SAC.init(Spec(OBS, ACT, 5), jax.random.key(0))
    with pytest.raises(DelayRLError, match="at least 1 step"):
        VDPO().init(Spec(OBS, ACT, 0), jax.random.key(0))


def test_actor_and_temperature_move_every_second_time() -> None:
    """Twice on the odd counts, not at all on the even ones; critics and targets always."""
    transitions, _ = record(ENV, 0, 40)
    replay = ring.init(Spec(OBS, ACT, 0), 100)
    for transition in transitions:
        replay = jax.jit(ring.append)(replay, transition)
    windows = ring.sample(replay, jax.random.key(0), 16, 0, 3, jnp.int32(0))
    state = TINY_SAC.init(Spec(OBS, ACT, 0), jax.random.key(0))
    even, _ = TINY_SAC.update(state, windows, jax.random.key(1), jnp.int32(4))
    odd, _ = TINY_SAC.update(state, windows, jax.random.key(1), jnp.int32(5))
    assert same(even.actor, state.actor)
    assert same(even.log_temperature, state.log_temperature)
    assert not same(even.critic, state.critic)
    assert same(even.critic, odd.critic)
    assert int(odd.actor_opt_state[0].count) == int(odd.temperature_opt_state[0].count) == 2
    expected = jax.tree.map(lambda t, c: 0.995 * t + 0.005 * c, state.target, even.critic)
    for a, b in zip(jax.tree.leaves(even.target), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)


# -- VDPO -----------------------------------------------------------------------------------------------------------


def test_unseen_is_what_the_delay_hides() -> None:
    """x_{t+1}: the states after its observation, in order, up to s_{t+1}; fewer at the start of an episode."""
    transitions, windows = counted(4, 150, batch=400, ahead=3)
    x = unseen(windows)
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
    replay = ring.init(spec, 100)
    for transition in transitions:
        replay = jax.jit(ring.append)(replay, transition)
    windows = ring.sample(replay, jax.random.key(0), 16, delay, 3, jnp.int32(0))
    return agent.init(spec, jax.random.key(0)), windows


@pytest.mark.parametrize("representation", ["transformer", "transformer-no-belief", "mlp"])
def test_who_learns_what(representation: str) -> None:
    """Belief trains encoder and decoder; cloning the head alone, and the encoder too where nothing else does."""
    agent = dataclasses.replace(TINY["vdpo"], representation=representation)
    state, windows = vdpo_parts(agent)
    updated, metrics = agent.update(state, windows, jax.random.key(1), jnp.int32(0))
    cloned, _ = agent.clone(state, windows, jax.random.key(1), jnp.int32(0))
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
    reference = agent.reference.act(state.reference, what, jax.random.key(0), explore=False)
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


@pytest.mark.parametrize("behaviour", ["lower-q", "delayed", "reference", "mixture"])
def test_behaviour(behaviour: str, rng: np.random.Generator) -> None:
    """Only `delayed` does without the true state; `lower-q` executes the sample that the critics think less of."""
    agent = dataclasses.replace(TINY["vdpo"], behaviour=behaviour, dropout=0.0)
    state, _ = vdpo_parts(agent)
    assert agent.privileged == (behaviour != "delayed")
    chosen = {b: [] for b in ("lower-q", "delayed", "reference", "mixture")}
    for seed in range(20):
        what = seen(3, 2, np.random.default_rng(seed), truth=True)
        for b, actions in chosen.items():
            other = dataclasses.replace(agent, behaviour=b)
            actions.append(np.asarray(other.act(state, what, jax.random.key(seed), explore=True)))
        q = [
            float(agent_q.min())
            for agent_q in (
                networks_twin(state, what.truth, chosen["reference"][-1]),
                networks_twin(state, what.truth, chosen["delayed"][-1]),
            )
        ]
        lower = chosen["reference"][-1] if q[0] < q[1] else chosen["delayed"][-1]
        np.testing.assert_array_equal(chosen["lower-q"][-1], lower)
    took_reference = [np.array_equal(m, r) for m, r in zip(chosen["mixture"], chosen["reference"], strict=True)]
    assert 3 < sum(took_reference) < 17


def networks_twin(state, truth, action):
    from delayrl.core.networks import twin

    return twin(state.reference.critic, truth, jnp.asarray(action))


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


def test_random_is_uniform() -> None:
    state = Random().init(Spec(1, 3, 0), jax.random.key(0))
    what = Seen(jnp.zeros(1), jnp.int32(0), jnp.zeros((0, 3)))
    draws = np.stack([Random().act(state, what, jax.random.key(i), explore=False) for i in range(500)])
    assert draws.shape == (500, 3)
    assert abs(draws.mean()) < 0.05
    assert abs(draws.std() - 3**-0.5) < 0.03
