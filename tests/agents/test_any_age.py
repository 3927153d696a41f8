"""Any-age: other views of the same moment, the annealed pull, and BPQL or SAC where there is nothing to add."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import ACT, OBS, counted, random_windows, record, same, sampled, seen

from conftest import TINY
from delayrl.agents.any_age import AnyAge, SecondAge, belief_loss
from delayrl.agents.base import Agent, Schedule, State
from delayrl.agents.lifting import lifting_loss
from delayrl.core import networks
from delayrl.core.forecast import follow_changes, forecast_loss, forecasting, in_task_units
from delayrl.core.objectives import soft_value
from delayrl.core.sequence import sequence
from delayrl.core.types import Spec
from delayrl.core.views import network_input
from delayrl.errors import DelayRLError

PULLED = replace(TINY["any-age"], encoder="mlp", pull_weight=1.0)
"""A variant whose every part has a hand-computed loss; FORECASTING, below, has the default encoder."""


def assert_same_program(one: Agent, other: Agent, delay: int) -> None:
    """Two agents begin alike, and their updates are the same arithmetic."""
    (state, text), (expected, of_other) = program(one, delay), program(other, delay)
    assert same(state, expected)
    assert text == of_other


def program(agent: Agent, delay: int) -> tuple[State, str]:
    spec = Spec(OBS, ACT, delay)
    state, (phase,) = agent.init(spec, jax.random.key(0)), agent.phases()
    given = state, random_windows(spec), jax.random.key(1), jnp.int32(0)
    return state, str(jax.make_jaxpr(phase.update)(*given))


def test_without_a_second_age_it_is_bpql() -> None:
    """With BPQL's critics normed alike."""
    assert_same_program(replace(PULLED, second_age="none", pull_weight=0.0), PULLED.bpql, 3)
    assert program(PULLED, 3)[1] != program(PULLED.bpql, 3)[1]


def test_without_a_delay_it_is_sac() -> None:
    assert_same_program(PULLED, replace(PULLED.bpql, actor_sees="current"), 0)


@pytest.mark.parametrize(("law", "ages"), [(None, "random"), ("uniform:1:4", "random"), ("uniform:1:4", "any")])
def test_second_views(law: str | None, ages: SecondAge) -> None:
    """On the counter: (s_{t-j}, the j actions since, j / Δ), each j from 0 to the shown age equally often.

    Or each that the episode reaches.
    """
    agent = replace(PULLED, second_age=ages)
    transitions, windows = counted(4, 300, batch=4000, ahead=1, law=law)
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    x = np.asarray(agent.second_view(windows, jax.random.key(1)))
    fresh = np.asarray(replace(agent, second_age="zero").second_view(windows, jax.random.key(1)))
    windows = jax.device_get(windows)  # reading single entries is slow in JAX
    found: dict[int, list[int]] = {}
    for i, action in enumerate(np.asarray(windows.action[:, 4, 0]).tolist()):
        step = by_action[action]
        now, length = transitions[step].obs
        j = round(float(x[i, -1]) * 4)
        since = [transitions[step - j + k].action[0] if k < j else 0 for k in range(4)]
        np.testing.assert_allclose(x[i], [now - j, length, *since, j / 4], rtol=1e-6)
        np.testing.assert_allclose(fresh[i], [now, length, 0, 0, 0, 0, 0])
        found.setdefault(int(min(now, 4) if ages == "any" else windows.age[i, 4]), []).append(j)
    assert set(found) == {0, 1, 2, 3, 4}
    for age, drawn in found.items():
        counts = np.bincount(drawn, minlength=age + 1)
        assert len(counts) == age + 1  # none older
        expected = len(drawn) / (age + 1)
        assert ((counts - expected) ** 2 / expected).sum() < age + 6 * np.sqrt(2 * max(age, 1))


def test_ages_in_turn_without_a_pull(rng: np.random.Generator) -> None:
    """One view of each sample, half of them at the second age; a pull compares both views of each."""
    own, second = jnp.asarray(rng.normal(size=(2, 6, 4)))
    mixed = replace(PULLED, pull_weight=0.0).views(own, second)
    np.testing.assert_array_equal(mixed[0, ::2], own[::2])
    np.testing.assert_array_equal(mixed[0, 1::2], second[1::2])
    assert len(mixed) == 1
    np.testing.assert_array_equal(PULLED.views(own, second), jnp.stack([own, second]))
    np.testing.assert_array_equal(PULLED.views(own, None), own[None])


@pytest.mark.parametrize("distance", ["moments", pytest.param("kl", marks=pytest.mark.thorough)])
def test_actor_gradient_by_hand(distance: str) -> None:
    """Half for each age, and the pull of the older policy towards the younger, which is held fixed."""
    agent = replace(PULLED, pull=distance)
    transitions, _ = record("Reacher-v5", 3, 80)
    windows = sampled(transitions, Spec(OBS, ACT, 3), 16, 1)
    state = PULLED.init(Spec(OBS, ACT, 3), jax.random.key(0))
    older, critic_input = PULLED.bpql._inputs(windows, 0)
    younger = PULLED.second_view(windows, jax.random.key(2))
    assert not np.allclose(older, younger)
    moved = agent.improve_actor(windows, younger, jnp.float32(3.0), state, older, critic_input, jax.random.key(5))
    frozen = PULLED.bpql.policy(state.actor, younger)

    def value(actor):
        policies = [PULLED.bpql.policy(actor, x) for x in (older, younger)]
        drawn = networks.sample(networks.Gaussian(*map(jnp.stack, zip(*policies, strict=True))), jax.random.key(5))
        total = 0.0
        for action, log_prob in zip(*drawn, strict=True):
            q = networks.twin(state.critic, critic_input, action)
            total += 0.5 * soft_value(q, log_prob, jnp.exp(state.log_temperature)).mean()
        return total

    def pull(actor):
        policy = PULLED.bpql.policy(actor, older)
        if distance == "moments":
            return lifting_loss(policy, frozen)
        scale = jnp.exp(policy.log_std - frozen.log_std)
        apart = (policy.mean - frozen.mean) / jnp.exp(frozen.log_std)
        return (-jnp.log(scale) + 0.5 * (scale**2 + apart**2 - 1)).sum(-1).mean()

    expected = jax.tree.map(lambda a, b: 3.0 * b - a, jax.grad(value)(state.actor), jax.grad(pull)(state.actor))
    gradient = jax.tree.map(lambda mean: mean / 0.1, moved.actor_opt_state[0].mu)  # Adam's, from zero
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_annealing_in_parts_of_the_run() -> None:
    agent = replace(PULLED, pull_weight=2.0, pull_hold=0.25, pull_end=0.75).for_run(Schedule(steps=1000))
    steps = [0, 250, 375, 500, 750, 1000]
    np.testing.assert_allclose([agent.weight(jnp.int32(n)) for n in steps], [2, 2, 1.5, 1, 0, 0], rtol=1e-6)
    sudden = replace(agent, pull_hold=0.5, pull_end=0.5)
    assert [float(sudden.weight(jnp.int32(n))) for n in (499, 500)] == [2.0, 0.0]
    with pytest.raises(DelayRLError, match=r"pull_hold must be no later than pull_end, 0\.2; got 0\.3"):
        AnyAge(pull_hold=0.3, pull_end=0.2).for_run(Schedule())
    with pytest.raises(DelayRLError, match="pull_weight needs a younger second_age"):
        AnyAge(pull_weight=1.0, second_age="none").for_run(Schedule())


def test_clock_is_the_environment_step() -> None:
    """`count` numbers updates: with two every four steps, updates 2i and 2i + 1 happen at step 4i."""
    bpql = replace(PULLED.bpql, update_every=4, updates=2)
    agent = replace(PULLED, bpql=bpql, pull_weight=2.0, pull_hold=0.25, pull_end=0.75).for_run(Schedule(steps=16))
    spec = Spec(OBS, ACT, 3)
    given = agent.init(spec, jax.random.key(0)), random_windows(spec), jax.random.key(1)
    weight_at = jax.jit(lambda count: agent.update(*given, count)[1]["pull_weight"])  # compiles nothing else
    for count, weight in ((2, 2.0), (3, 2.0), (4, 1.0), (5, 1.0), (6, 0.0)):
        np.testing.assert_allclose(weight_at(jnp.int32(count)), weight)


SEQUENTIAL = replace(PULLED, encoder="transformer", encoder_width=8, belief_weight=0.5)


def test_a_sequence_is_read_at_its_age(rng: np.random.Generator) -> None:
    """Actions after the first `age` do not matter, all others do; at age 0 the observation alone is read."""
    state = SEQUENTIAL.init(Spec(OBS, ACT, 4), jax.random.key(0))
    for age in range(5):
        x = seen(4, age, rng)
        action = SEQUENTIAL.act(state, x, jax.random.key(0), explore=False)
        later = x._replace(actions=x.actions.at[age:].set(0.7))
        np.testing.assert_array_equal(action, SEQUENTIAL.act(state, later, jax.random.key(0), explore=False))
        for used in range(age):
            other = x._replace(actions=x.actions.at[used].add(0.3))
            assert not np.array_equal(action, SEQUENTIAL.act(state, other, jax.random.key(0), explore=False))
    fresh = seen(4, 0, rng)
    expected = networks.mlp(state.actor["current"], fresh.obs)
    np.testing.assert_array_equal(sequence(state.actor, network_input(fresh, "augmented")), expected)


def test_a_sequence_without_a_delay_is_sac() -> None:
    plain = replace(SEQUENTIAL, second_age="none", belief_weight=0.0)
    for agent in (SEQUENTIAL, plain, FORECASTING):
        assert_same_program(agent, replace(PULLED.bpql, actor_sees="current"), 0)


FORECASTING = replace(PULLED, encoder="forecast")
VALUED = replace(FORECASTING, forecast_learns_from="states+values")


def away_from_start(spec: Spec) -> networks.Params:
    """An actor with a forecast, whose biases and deviations are not their initial ones."""
    actor = FORECASTING.init(spec, jax.random.key(0)).actor
    leaves, form = jax.tree.flatten(actor)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    return jax.tree.unflatten(form, [x + jax.random.uniform(k, x.shape) for x, k in zip(leaves, keys, strict=True)])


def views_of(rng: np.random.Generator, shape: tuple[int, ...]) -> jax.Array:
    """Random x_t of a delay of 3, with age 0 and 3 in turn along the last axis."""
    x = rng.normal(size=(*shape, OBS + 3 * ACT + 1))
    x[..., -1] = np.arange(shape[-1]) % 2
    return jnp.asarray(x, jnp.float32)


def test_a_forecast_by_hand(rng: np.random.Generator) -> None:
    """The policy reads the observation plus its forecast change; at age 0, the observation itself."""
    actor = away_from_start(Spec(OBS, ACT, 3))
    x = views_of(rng, (6,))
    now = x[:, :OBS] + actor["deviation"] * networks.mlp(actor["forecast"], x)
    now = jnp.where(jnp.arange(6)[:, None] % 2 == 0, x[:, :OBS], now)
    np.testing.assert_allclose(forecasting(actor, x), networks.mlp(actor["policy"], now), rtol=1e-5, atol=1e-5)
    change = np.asarray(networks.mlp(in_task_units(actor), x))
    np.testing.assert_allclose(change[1::2], (now - x[:, :OBS])[1::2], rtol=1e-4, atol=1e-4)


def test_a_forecast_learns_the_change_and_nothing_else(rng: np.random.Generator) -> None:
    """Its error is in deviations, which follow the changes; the values of actions move it only where asked to."""
    actor = away_from_start(Spec(OBS, ACT, 3))
    x = views_of(rng, (2, 6))
    state = jnp.asarray(rng.normal(size=(2, 6, OBS)), jnp.float32)
    change = np.asarray(state - x[..., :OBS])
    error = np.asarray(networks.mlp(actor["forecast"], x)) - change / np.asarray(actor["deviation"])
    error[:, ::2] = 0  # nothing is forecast at age 0
    np.testing.assert_allclose(forecast_loss(actor, x, state), (error**2).mean(), rtol=1e-5)
    learned = jax.grad(forecast_loss)(actor, x, state)
    valued, both = (
        jax.grad(lambda actor, network=network: (network(actor, x) ** 2).mean())(actor)
        for network in (FORECASTING.learner.actor_network, VALUED.learner.actor_network)
    )
    for gradient, moved in ((learned, {"forecast"}), (valued, {"policy"}), (both, {"policy", "forecast"})):
        parts = {name: jax.tree.leaves(part) for name, part in gradient.items()}
        assert {name for name, leaves in parts.items() if any(jnp.abs(leaf).max() > 0 for leaf in leaves)} == moved
    square = 0.99 * np.asarray(actor["deviation"]) ** 2 + 0.01 * (change**2).mean((0, 1))
    np.testing.assert_allclose(follow_changes(actor, x, state)["deviation"], np.sqrt(square), rtol=1e-4)


def test_in_distances_no_sample_outweighs_the_others(rng: np.random.Generator) -> None:
    """The error is the root of the squared one, from 0; its gradient at a forecast has nearly the same length."""
    actor = away_from_start(Spec(OBS, ACT, 3))
    x = views_of(rng, (6,))
    state = jnp.asarray(rng.normal(size=(6, OBS)) * 10.0 ** np.arange(6)[:, None], jnp.float32)
    each = [forecast_loss(actor, x[i], state[i]) for i in range(6)]
    expected = np.mean([np.sqrt(error + 1e-4) - 1e-2 for error in each])
    np.testing.assert_allclose(forecast_loss(actor, x, state, "distance"), expected, rtol=1e-5)
    assert each[0] == each[2] == 0 < each[1] < each[3] / 10 < each[5] / 100  # 0 at age 0

    def error(bias: jax.Array, i: int) -> jax.Array:
        *layers, last = actor["forecast"]
        return forecast_loss(actor | {"forecast": [*layers, last | {"b": bias}]}, x[i], state[i], "distance")

    slopes = [jax.grad(error)(actor["forecast"][-1]["b"], i) for i in range(6)]
    lengths = [float(jnp.linalg.norm(slope)) for slope in slopes]
    np.testing.assert_allclose(lengths, [0, OBS**-0.5] * 3, rtol=1e-3)
    agent, windows = replace(FORECASTING, forecast_error="distance"), random_windows(Spec(OBS, ACT, 3))
    start = FORECASTING.init(Spec(OBS, ACT, 3), jax.random.key(0))
    squared, distance = (a.update(start, windows, jax.random.key(1), jnp.int32(4))[0] for a in (FORECASTING, agent))
    assert not np.allclose(squared.actor["forecast"][0]["w"], distance.actor["forecast"][0]["w"], atol=1e-5)


def test_values_may_move_the_forecast() -> None:
    """The first update then moves the policy as before, for it read the same forecast, but the forecast elsewhere."""
    state = FORECASTING.init(Spec(OBS, ACT, 3), jax.random.key(0))
    windows = random_windows(Spec(OBS, ACT, 3))
    alone, both = (a.update(state, windows, jax.random.key(1), jnp.int32(4))[0] for a in (FORECASTING, VALUED))
    for a, b in zip(jax.tree.leaves(alone.actor["policy"]), jax.tree.leaves(both.actor["policy"]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    assert not np.allclose(alone.actor["forecast"][0]["w"], both.actor["forecast"][0]["w"], atol=1e-5)
    for agent in (VALUED, replace(FORECASTING, forecast_error="distance")):
        with pytest.raises(DelayRLError, match=r"forecast_error=distance need encoder=forecast; got mlp"):
            replace(agent, encoder="mlp").for_run(Schedule())


@pytest.mark.parametrize("pulled", [pytest.param(True, marks=pytest.mark.thorough), False])
def test_a_forecast_is_learned_in_an_update(pulled: bool) -> None:
    """At both ages, at both in turn, or at its own alone, towards the true state."""
    agent = replace(FORECASTING, pull_weight=float(pulled))
    state = FORECASTING.init(Spec(OBS, ACT, 3), jax.random.key(0))
    windows = random_windows(Spec(OBS, ACT, 3))
    older, now = FORECASTING.bpql._inputs(windows, 0)
    second = FORECASTING.second_view(windows, jax.random.key(2))
    in_turn = jnp.where(jnp.arange(len(older))[:, None] % 2 == 0, older, second)
    for other, views in ((second, [older, second] if pulled else [in_turn]), (None, [older])):
        moved = agent.improve_actor(windows, other, jnp.float32(0.0), state, older, now, jax.random.key(5))
        gradients = [jax.grad(forecast_loss)(state.actor, x, now)["forecast"] for x in views]
        mean = moved.actor_opt_state[0].mu["forecast"]
        expected = jax.tree.map(lambda *g: sum(g) / len(g), *gradients)
        for a, b in zip(jax.tree.leaves(mean), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a / 0.1, b, rtol=1e-3, atol=1e-6)
        assert not np.allclose(moved.actor["deviation"], state.actor["deviation"])


def test_belief_by_hand() -> None:
    """On the counter, whose state rises by 1: the token of i actions is to say i / deviation. Nothing else learns."""
    _, windows = counted(4, 300, batch=500, ahead=1)
    spec = Spec(2, 1, 4)
    state = SEQUENTIAL.init(spec, jax.random.key(0))
    x = SEQUENTIAL.second_view(windows, jax.random.key(0))  # any inputs of the right shape
    silent = state.actor | {"belief": jax.tree.map(jnp.zeros_like, state.actor["belief"])}
    ages = np.asarray(windows.age[:, 4])
    changes = np.array([i for age in ages for i in range(1, age + 1)])
    deviation = np.sqrt((changes**2).mean())
    silence = ((changes / deviation) ** 2).sum() / 2 / (500 * 4)  # 2 entries, of which the length never changes
    np.testing.assert_allclose(belief_loss(silent, x, windows), silence, rtol=1e-4)
    told = silent["belief"] | {"b": jnp.array([2.0, 0.0])}
    constant = ((changes / deviation - 2) ** 2).sum() / 2 / (500 * 4)
    np.testing.assert_allclose(belief_loss(silent | {"belief": told}, x, windows), constant, rtol=1e-4)
    gradient = jax.grad(belief_loss)(state.actor, x, windows)
    moved = {name for name, part in gradient.items() if any(jnp.abs(leaf).max() > 0 for leaf in jax.tree.leaves(part))}
    assert moved == {"encoder", "belief"}


@pytest.mark.parametrize("wrong", [{"encoder": "mlp"}, {"second_age": "none", "pull_weight": 0.0}])
def test_a_belief_needs_a_sequence_and_a_second_age(wrong: dict) -> None:
    with pytest.raises(DelayRLError, match="belief_weight needs encoder=transformer and a second_age"):
        replace(SEQUENTIAL, **wrong).for_run(Schedule())


def test_normed_critics() -> None:
    """The norm is before each hidden ReLU; the critic's answer does not change with the scale of that layer's input."""
    critic = networks.twin_init(jax.random.key(0), (3, 8, 8, 1), "layer")
    assert ["norm" in layer for layer in critic[0]] == [True, True, False]
    x, action = jnp.array([[0.3, -1.0]]), jnp.array([[0.5]])
    hidden = jnp.concatenate([x, action], -1)
    for layer in critic[0][:-1]:
        hidden = hidden @ layer["w"] + layer["b"]
        hidden = (hidden - hidden.mean()) / jnp.sqrt(hidden.var() + 1e-5)
        hidden = jnp.maximum(hidden, 0)
    expected = (hidden @ critic[0][-1]["w"] + critic[0][-1]["b"])[0, 0]
    np.testing.assert_allclose(networks.twin(critic, x, action)[0, 0], expected, rtol=1e-5)
