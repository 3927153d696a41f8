"""SAC on two views: SAC, memoryless SAC, A-SAC, BPQL."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from learners import ACT, ENV, OBS, assert_near, counted, random_windows, same, sampled, seen, trained

from conftest import TINY, TINY_SAC, record
from delayrl.agents.registry import AGENTS
from delayrl.agents.sac import SAC, State
from delayrl.agents.vdpo import VDPO
from delayrl.core import networks
from delayrl.core.types import Spec
from delayrl.errors import DelayRLError


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


def test_presets_have_their_views() -> None:
    """In every preset; the SACs inside other agents too."""
    views = {
        "sac": ("current", "current"),
        "sac-memoryless": ("delayed", "delayed"),
        "a-sac": ("augmented", "augmented"),
        "bpql": ("augmented", "current"),
        "ad-sac": ("augmented", "augmented"),
        "any-age": ("augmented", "current"),
        "lifting": ("augmented", "current"),
        "vdpo": ("current", "current"),
        "dida": ("current", "current"),
    }
    inner = {"ad-sac": "learner", "lifting": "bpql", "any-age": "bpql", "vdpo": "reference", "dida": "reference"}
    for name, pair in views.items():
        for preset in AGENTS[name].presets.values():
            agent = getattr(preset.agent, inner[name]) if name in inner else preset.agent
            assert (agent.actor_sees, agent.critic_sees) == pair


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
    pairs = [TINY["bpql"]._inputs(windows, ahead) for ahead in (0, windows.n_step)]
    windows, pairs = jax.device_get((windows, pairs))  # reading single entries is slow in JAX
    (actor, critic), (actor_next, critic_next) = pairs
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
        TINY_SAC.init(Spec(OBS, ACT, 1), jax.random.key(0))
    with pytest.raises(DelayRLError, match="at least 1 step"):
        VDPO().init(Spec(OBS, ACT, 0), jax.random.key(0))


def test_actor_and_temperature_move_every_second_time() -> None:
    """Twice on the odd counts, not at all on the even ones; critics and targets always."""
    transitions, _ = record(ENV, 0, 40)
    windows = sampled(transitions, Spec(OBS, ACT, 0), 16, 3)
    state, update = TINY_SAC.init(Spec(OBS, ACT, 0), jax.random.key(0)), jax.jit(TINY_SAC.update)
    even, _ = update(state, windows, jax.random.key(1), jnp.int32(4))
    odd, _ = update(state, windows, jax.random.key(1), jnp.int32(5))
    assert same(even.actor, state.actor)
    assert same(even.log_temperature, state.log_temperature)
    assert not same(even.critic, state.critic)
    assert same(even.critic, odd.critic)
    assert int(odd.actor_opt_state[0].count) == int(odd.temperature_opt_state[0].count) == 2
    expected = jax.tree.map(lambda t, c: 0.995 * t + 0.005 * c, state.target, even.critic)
    for a, b in zip(jax.tree.leaves(even.target), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)


SPEC = Spec(OBS, ACT, 0, log_scale=0.7)
RATES = {"actor_learning_rate": 1e-3, "critic_learning_rate": 2e-3, "temperature_learning_rate": 4e-3}


def started(**options) -> tuple[SAC, State]:
    """A SAC whose target critics are not its critics, and whose temperature is 0.5."""
    agent = dataclasses.replace(TINY_SAC, **RATES, **options)
    state = agent.init(SPEC, jax.random.key(0))
    other = agent.init(SPEC, jax.random.key(1)).critic
    return agent, state._replace(target=other, log_temperature=jnp.log(jnp.float32(0.5)))


def adams_first_step(old, gradient, rate: float):
    return jax.tree.map(lambda x, g: x - rate * g / (jnp.abs(g) + 1e-8), old, gradient)


@pytest.mark.parametrize("unit", ["task", "scaled"])
def test_critic_target_by_hand(unit: str) -> None:
    """Y = Σ_{j<k} γ^j r_{t+j} + γ^k (1 - terminated) (min Q̄(s_{t+k}, a) - α log π(a|s_{t+k})), with each sample's k."""
    agent, state = started(entropy_unit=unit)
    windows, key = random_windows(SPEC), jax.random.key(5)
    new, metrics = jax.jit(agent.update)(state, windows, key, jnp.int32(0))
    k = np.asarray(windows.n_step)
    later = windows.obs[np.arange(8), k]
    action, log_prob = networks.sample(agent.policy(state.actor, later), jax.random.split(key)[0])
    log_prob = np.asarray(log_prob) - (0.7 if unit == "task" else 0)
    value = np.asarray(networks.twin(state.target, later, action)).min(0) - 0.5 * log_prob
    rewards, ended = np.asarray(windows.reward), np.asarray(windows.terminated)[np.arange(8), k - 1]
    assert 0 < ended.sum() < 8
    y = [sum(0.99**j * rewards[i, j] for j in range(k[i])) + 0.99 ** k[i] * (1 - ended[i]) * value[i] for i in range(8)]

    def loss(critic) -> jax.Array:
        q = networks.twin(critic, windows.obs[:, 0], windows.action[:, 0])
        return ((q - jnp.asarray(y)) ** 2).mean(1).sum()

    error, gradient = jax.value_and_grad(loss)(state.critic)
    np.testing.assert_allclose(metrics["critic_loss"], error, rtol=1e-4)
    np.testing.assert_allclose(metrics["entropy"], -log_prob.mean(), rtol=1e-4)
    assert_near(new.critic, adams_first_step(state.critic, gradient, 2e-3))
    assert_near(new.target, optax.incremental_update(new.critic, state.target, 5e-3))


def test_actor_by_hand() -> None:
    """One step of Adam down α log π(a|s) - min Q(s, a), with the critics and not their targets, and the penalty."""
    agent, state = started()
    x, key = random_windows(SPEC).obs[:, 0], jax.random.key(2)

    def loss(actor) -> jax.Array:
        policy = agent.policy(actor, x)
        action, log_prob = networks.sample(policy, key)
        value = networks.twin(state.critic, x, action).min(0) - 0.5 * log_prob
        return (3 * policy.mean**2).mean() - value.mean()

    new = agent.improve_actor(state, x, x, key, lambda actor, policy: (3 * policy.mean**2).mean())
    assert_near(new.actor, adams_first_step(state.actor, jax.grad(loss)(state.actor), 1e-3))


@pytest.mark.parametrize("excess", [0.01, -0.01])
def test_temperature_by_hand(excess: float) -> None:
    """It rises where the batch's entropy is below the target, by however little, and falls where it is above."""
    agent, state = started()
    x, key = random_windows(SPEC).obs[:, 0], jax.random.key(4)
    _, log_prob = networks.sample(agent.policy(state.actor, x), key)
    new = agent.adjust_temperature(state, x, float(-log_prob.mean()) + excess, key)
    change = new.log_temperature - state.log_temperature
    np.testing.assert_allclose(change, 4e-3 * np.sign(excess), rtol=1e-3)


def test_target_entropy_by_hand() -> None:
    """-A for actions in [-1, 1]; in the task's units the half ranges, here with Σ log = 0.7, are added."""
    windows = random_windows(SPEC)
    assert dataclasses.replace(TINY_SAC, entropy_unit="scaled").target_entropy(windows) == -ACT
    assert dataclasses.replace(TINY_SAC, entropy_unit="task").target_entropy(windows) == pytest.approx(-ACT - 0.7)


def test_start() -> None:
    """The target critics start as copies of two different critics, the temperature at its initial value."""
    state = dataclasses.replace(TINY_SAC, initial_temperature=0.2).init(SPEC, jax.random.key(0))
    assert same(state.target, state.critic)
    assert not same(*state.critic)
    np.testing.assert_allclose(jnp.exp(state.log_temperature), 0.2, rtol=1e-6)


def test_it_explores_in_training_alone(rng: np.random.Generator) -> None:
    agent, state = started()
    what = seen(0, 0, rng)
    policy = agent.policy(state.actor, what.obs)
    key = jax.random.key(3)
    np.testing.assert_array_equal(agent.act(state, what, key, explore=True), networks.sample(policy, key)[0])
    np.testing.assert_array_equal(agent.act(state, what, key, explore=False), networks.mode(policy))
