"""AD-SAC: what is seen, the target, the coin, the behaviour, and that it is A-SAC where the delays are equal."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import assert_near, same, sampled

from conftest import record
from delayrl.agents.adsac import ADSAC, State, augmented_learner, with_augmented
from delayrl.agents.sac import SAC
from delayrl.core import networks
from delayrl.core.types import Seen, Spec, Window
from delayrl.errors import DelayRLError

ENV, OBS, ACT, DELAY = "Reacher-v5", 10, 2, 3
SPEC = Spec(OBS, ACT, DELAY)
TINY = SAC(actor_sees="augmented", critic_sees="augmented", hidden=(16, 16), batch_size=16)


@functools.cache
def windows_of(env: str = ENV, spec: Spec = SPEC, batch: int = 16) -> Window:
    return sampled(record(env, spec.delay, 150)[0], spec, batch, 3)


@functools.cache
def started(auxiliary_delay: int = 0, **options) -> tuple[ADSAC, State]:
    agent = ADSAC(dataclasses.replace(TINY, **options), auxiliary_delay)
    state = agent.init(SPEC, jax.random.key(0))
    # temperatures that differ, so that taking one for the other shows
    auxiliary = state.auxiliary._replace(log_temperature=jnp.float32(np.log(0.5)))
    return agent, state._replace(auxiliary=auxiliary, log_temperature=jnp.float32(np.log(0.2)))


@pytest.mark.parametrize("auxiliary_delay", [0, 2, 4])
def test_inputs_are_aligned(auxiliary_delay: int) -> None:
    """On a counter: x_t of the delay 4, and x^τ_t of the shorter one, of the same true step."""
    transitions, _ = record("delayrl/Counter-v0", 4, 150)
    windows = windows_of("delayrl/Counter-v0", Spec(2, 1, 4), 300)
    agent = ADSAC(auxiliary_delay=auxiliary_delay)
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    taken = windows.action[:, 4, 0].tolist()
    for ahead in (0, windows.n_step):
        inputs = jax.device_get(agent.inputs(windows, ahead))  # reading single entries is slow in JAX
        for i in range(0, 300, 3):
            step = by_action[taken[i]]
            now, length = transitions[step].obs
            k = int(np.broadcast_to(ahead, 300)[i])
            for x, delay in ((inputs.auxiliary, auxiliary_delay), (inputs.augmented, 4)):
                age = min(int(now) + k, delay)
                since = [transitions[step + k - age + j].action[0] if j < age else 0 for j in range(delay)]
                tail = [*since, age / delay] if delay else []
                np.testing.assert_allclose(x[i], [now + k - age, length, *tail], rtol=1e-6)


def test_next_value_by_hand() -> None:
    """min(3 - 0.5 log π_τ, 5 - 0.2 log π): target critics that give 3 and 5 everywhere."""
    agent, state = started()
    constant = [jax.tree.map(jnp.zeros_like, critic) for critic in state.auxiliary.target]
    for critic, value in zip(constant, (3.0, 5.0), strict=True):
        critic[-1]["b"] += value
    state = state._replace(auxiliary=state.auxiliary._replace(target=constant))
    later = agent.inputs(windows_of(), windows_of().n_step)
    auxiliary_key, augmented_key = jax.random.split(jax.random.key(3))
    value, entropies = agent.next_value(state, later, auxiliary_key, augmented_key, 0.0)
    short = networks.sample(TINY.policy(state.auxiliary.actor, later.auxiliary), auxiliary_key)[1]
    long = networks.sample(TINY.policy(state.actor, later.augmented), augmented_key)[1]
    pair = np.stack([3 - 0.5 * np.asarray(short), 5 - 0.2 * np.asarray(long)])
    np.testing.assert_allclose(value, pair.min(0), rtol=1e-5)
    np.testing.assert_allclose(entropies["auxiliary_entropy"], -np.mean(short), rtol=1e-5)
    np.testing.assert_allclose(entropies["entropy"], -np.mean(long), rtol=1e-5)


def test_each_actor_has_its_target_critic() -> None:
    """Swapping the target critics changes the value; so does each actor's temperature where its term is lower."""
    agent, state = started()
    later = agent.inputs(windows_of(), windows_of().n_step)
    keys = jax.random.split(jax.random.key(3))
    value, _ = agent.next_value(state, later, *keys, 0.0)
    swapped = state.auxiliary._replace(target=state.auxiliary.target[::-1])
    assert not np.allclose(value, agent.next_value(state._replace(auxiliary=swapped), later, *keys, 0.0)[0])


def test_critic_loss_by_hand() -> None:
    """Y = Σ γ^j r + γ^k (1 - terminated) V, and the critics, at (x^τ, a), are compared with it."""
    agent, state = started()
    windows = windows_of()
    key = jax.random.key(5)
    auxiliary_key, augmented_key, _ = jax.random.split(key, 3)
    value, _ = agent.next_value(state, agent.inputs(windows, windows.n_step), auxiliary_key, augmented_key, 0.0)
    y = []
    for i in range(16):
        k = int(windows.n_step[i])
        rewards = np.asarray(windows.reward[i, DELAY : DELAY + k], np.float64)
        ended = bool(windows.terminated[i, DELAY + k - 1])
        y.append(sum(0.99**j * r for j, r in enumerate(rewards)) + 0.99**k * (1 - ended) * float(value[i]))
    q = networks.twin(state.auxiliary.critic, windows.obs[:, DELAY], windows.action[:, DELAY])
    _, metrics = agent.update(state, windows, key, jnp.int32(0))
    np.testing.assert_allclose(metrics["critic_loss"], ((np.asarray(q) - y) ** 2).mean(1).sum(), rtol=1e-4)
    np.testing.assert_allclose(metrics["q"], q.mean(), rtol=1e-4)


def test_equal_delays_are_a_sac() -> None:
    """τ = Δ, one set of parameters, one noise: A-SAC. Target and critics bit for bit, either actor up to rounding."""
    agent, _ = started(DELAY, actor_updates=1)
    windows, key = windows_of(), jax.random.key(7)
    one = agent.learner.init(SPEC, jax.random.key(1))
    state = State(one, one.actor, one.log_temperature, one.actor_opt_state, one.temperature_opt_state)
    expected, metrics = agent.learner.update(one, windows, key, jnp.int32(1))

    target_key, actor_key = jax.random.split(key)
    policy_key, temperature_key = jax.random.split(jax.random.split(actor_key, 1)[0])
    now, later = agent.inputs(windows, 0), agent.inputs(windows, windows.n_step)
    value, entropies = agent.next_value(state, later, target_key, target_key, 0.0)
    auxiliary, of_critic = agent.learner.learn_critic(state.auxiliary, windows, now.auxiliary, value)
    state = state._replace(auxiliary=auxiliary)
    assert same((of_critic["critic_loss"], entropies["entropy"]), (metrics["critic_loss"], metrics["entropy"]))
    assert same((auxiliary.critic, auxiliary.target), (expected.critic, expected.target))

    short = agent.improve_auxiliary(state, now, policy_key)
    assert same(short._replace(auxiliary=auxiliary), state)
    assert_near(agent.learner.adjust_temperature(short.auxiliary, now.auxiliary, -2.0, temperature_key), expected)
    long = agent.improve_augmented(state, now, policy_key)
    assert same(long.auxiliary, auxiliary)
    assert_near((long.actor, long.actor_opt_state), (expected.actor, expected.actor_opt_state))
    assert same((long.actor, long.actor_opt_state), (short.auxiliary.actor, short.auxiliary.actor_opt_state))


def test_a_round_is_its_parts() -> None:
    """The actor and both temperatures have keys of their own; the temperatures follow their own actors."""
    agent, state = started(actor_updates=1)
    now = agent.inputs(windows_of(), 0)
    improve = [jax.jit(lambda s, k, f=f: f(s, now, k)) for f in (agent.improve_augmented, agent.improve_auxiliary)]
    adjust = jax.jit(lambda learner, x, key: agent.learner.adjust_temperature(learner, x, -1.5, key))
    whole = jax.jit(lambda key, count: agent._improve(state, now, -1.5, key, count))
    took = set()
    for count in range(1, 9, 2):
        keys = jax.random.split(jax.random.split(jax.random.key(count), 1)[0], 3)
        coin = int(jax.random.bernoulli(jax.random.fold_in(jax.random.key(0), count), shape=(1,))[0])
        expected = improve[coin](state, keys[0])
        short = adjust(expected.auxiliary, now.auxiliary, keys[1])
        own = adjust(augmented_learner(expected), now.augmented, keys[2])
        assert_near(
            whole(jax.random.key(count), jnp.int32(count)), with_augmented(expected._replace(auxiliary=short), own)
        )
        took.add(coin)
    assert took == {0, 1}


def test_a_coin_says_which_actor_learns() -> None:
    """On odd counts one actor for each round, either one about as often; both temperatures; on even counts neither.

    Seeds in lockstep share the coin, so that only the update of the actor that it names is computed.
    """
    agent, state = started(actor_updates=1)
    update = jax.jit(agent.update)
    windows = windows_of()
    took = []
    for count in range(1, 80, 2):
        new, _ = update(state, windows, jax.random.key(0), jnp.int32(count))
        auxiliary = not same(new.auxiliary.actor, state.auxiliary.actor)
        assert same(new.actor, state.actor) == auxiliary
        assert new.auxiliary.log_temperature != state.auxiliary.log_temperature
        assert new.log_temperature != state.log_temperature
        took.append(auxiliary)
    assert 10 <= sum(took) <= 30
    keys = jax.random.split(jax.random.key(0), 3)
    lockstep = jax.make_jaxpr(jax.vmap(agent.update, (None, None, 0, None)))(state, windows, keys, jnp.int32(1))
    assert str(lockstep).count("cond[") == 2
    even, _ = update(state, windows, jax.random.key(0), jnp.int32(2))
    assert same(even._replace(auxiliary=state.auxiliary), state)
    assert same(even.auxiliary.actor, state.auxiliary.actor)
    assert not same(even.auxiliary.critic, state.auxiliary.critic)


def test_temperatures_are_updated_as_often_as_asked() -> None:
    """`matched` throws a coin for each of its two actors, and updates the temperatures once for both."""
    agent, state = started(actor_updates=2)
    windows = windows_of()
    for every in (1, 2):
        new, _ = dataclasses.replace(agent, temperature_every=every).update(
            state, windows, jax.random.key(0), jnp.int32(1)
        )
        counts = new.temperature_opt_state[0].count, new.auxiliary.temperature_opt_state[0].count
        assert [int(count) for count in counts] == [2 // every, 2 // every]
    with pytest.raises(DelayRLError, match="at most actor_updates, 2, or no temperature is ever updated; got 3"):
        dataclasses.replace(agent, temperature_every=3).init(Spec(10, 2, 3), jax.random.key(0))


def test_augmented_actor_follows_both_critics() -> None:
    """A change of the second critic alone changes its update: the released code takes the first for both."""
    agent, state = started()
    now = agent.inputs(windows_of(), 0)
    first, second = state.auxiliary.critic
    lower = [*second[:-1], {"w": 2 * second[-1]["w"], "b": second[-1]["b"] - 100}]
    other = state._replace(auxiliary=state.auxiliary._replace(critic=[first, lower]))
    actors = [agent.improve_augmented(s, now, jax.random.key(0)).actor for s in (state, other)]
    assert not same(*actors)


def seen(seed: int, truth: bool = True) -> Seen:
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(2, OBS)).astype(np.float32)
    actions = rng.uniform(-1, 1, (DELAY, ACT)).astype(np.float32)
    return Seen(jnp.asarray(obs[0]), jnp.int32(DELAY), jnp.asarray(actions), jnp.asarray(obs[1]) if truth else None)


def test_behaviour_has_the_lower_q() -> None:
    agent, state = started()
    assert agent.privileged
    act = jax.jit(functools.partial(agent.act, explore=True))
    took = []
    for seed in range(30):
        what, key = seen(seed), jax.random.key(seed)
        auxiliary_key, augmented_key = jax.random.split(key)
        x = jnp.concatenate([what.obs, what.actions.reshape(-1), jnp.ones(1)])
        pair = [
            networks.sample(TINY.policy(state.auxiliary.actor, what.truth), auxiliary_key)[0],
            networks.sample(TINY.policy(state.actor, x), augmented_key)[0],
        ]
        q = [float(networks.twin(state.auxiliary.critic, what.truth, action).min()) for action in pair]
        np.testing.assert_allclose(act(state, what, key), pair[int(np.argmin(q))], atol=1e-6)
        took.append(int(np.argmin(q)))
    assert 0 < sum(took) < 30


@pytest.mark.parametrize("auxiliary_delay", [0, 1, DELAY])
def test_who_may_look(auxiliary_delay: int) -> None:
    """Privileged with τ = 0 alone, unless told otherwise; never without `explore`."""
    agent, state = started(auxiliary_delay)
    assert agent.privileged == (auxiliary_delay == 0)
    told = dataclasses.replace(agent, behaviour="augmented")
    assert not told.privileged
    what, key = seen(0, truth=False), jax.random.key(0)
    action = told.act(state, what, key, explore=True)
    if agent.privileged:
        with pytest.raises(AssertionError, match="privileged"):
            agent.act(state, what, key, explore=True)
    else:
        np.testing.assert_array_equal(agent.act(state, what, key, explore=True), action)
    modes = [agent.act(state, what, jax.random.key(i), explore=False) for i in range(2)]
    np.testing.assert_array_equal(*modes)


def test_evaluated_action() -> None:
    """The mode; with `sample`, as the released code has it, a draw. Both are the augmented actor's."""
    agent, state = started()
    what, key = seen(0, truth=False), jax.random.key(7)
    x = jnp.concatenate([what.obs, what.actions.reshape(-1), jnp.ones(1)])
    policy = TINY.policy(state.actor, x)
    drawn, _ = networks.sample(policy, jax.random.split(key)[1])
    assert not np.allclose(drawn, networks.mode(policy), atol=1e-3)
    for evaluation, expected in (("mode", networks.mode(policy)), ("sample", drawn)):
        action = dataclasses.replace(agent, evaluation=evaluation).act(state, what, key, explore=False)
        np.testing.assert_allclose(action, expected, atol=1e-6)


def test_delay_free_policy_inside() -> None:
    agent, state = started()
    reference, inner = agent.reference_policy(state)
    what = Seen(jnp.ones(OBS), jnp.int32(0), jnp.zeros((0, ACT)))
    action = reference.act(inner, what, jax.random.key(0), explore=False)
    expected = networks.mode(TINY.policy(state.auxiliary.actor, jnp.ones(OBS)))
    np.testing.assert_array_equal(action, expected)
    agent, state = started(1)
    assert agent.reference_policy(state) is None


def test_auxiliary_delay_is_not_longer() -> None:
    ADSAC(TINY, DELAY).init(SPEC, jax.random.key(0))
    with pytest.raises(DelayRLError, match="no longer than the delay 3; got 4"):
        ADSAC(TINY, DELAY + 1).init(SPEC, jax.random.key(0))
