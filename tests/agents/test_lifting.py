"""Policy lifting: exact moments, the annealed weight, one temperature, and BPQL where the weight is 0."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import same, sampled
from scipy import integrate, stats

from conftest import record
from delayrl.agents import lifting
from delayrl.agents.base import Schedule
from delayrl.agents.lifting import Lifting, lifting_loss, moments
from delayrl.agents.sac import BPQL
from delayrl.core import networks
from delayrl.core.networks import Gaussian
from delayrl.core.precision import BFLOAT16
from delayrl.core.types import Seen, Spec, Window
from delayrl.core.views import look
from delayrl.errors import DelayRLError

ENV, OBS, ACT, DELAY = "Reacher-v5", 10, 2, 3
SPEC = Spec(OBS, ACT, DELAY)
TINY = Lifting(dataclasses.replace(BPQL, hidden=(16, 16), batch_size=16, update_every=4, updates=2))


@functools.cache
def windows() -> Window:
    return sampled(record(ENV, DELAY, 100)[0], SPEC, 16, 1)


def augmented(batch: Window):
    return jax.vmap(lambda window: look(window, "augmented"))(batch)


def exact(mean: float, std: float) -> tuple[float, float]:
    """By adaptive quadrature, told where tanh changes its sign."""
    if std < 1e-6:
        return float(np.tanh(mean)), std * (1 - np.tanh(mean) ** 2)
    points = np.clip([-mean / std - 1 / std, -mean / std, -mean / std + 1 / std], -8.9, 8.9)

    def expect(f):
        return integrate.quad(lambda z: f(np.tanh(mean + std * z)) * stats.norm.pdf(z), -9, 9, points=points)[0]

    first = expect(lambda a: a)
    return first, expect(lambda a: (a - first) ** 2) ** 0.5


GRID = [(m, s) for s in (-20.0, -5.0, -2.0, -1.0, 0.0, 1.0, 2.0) for m in (-4.0, -1.5, -0.3, 0.0, 0.1, 0.7, 2.2)]


@functools.cache
def truths() -> np.ndarray:
    return np.array([exact(m, np.exp(s)) for m, s in GRID])


def test_moments_are_exact() -> None:
    """Within 3e-4 for every log-std in [-20, 2]. Gauss-Hermite would miss by 1e-2 with as many nodes."""
    mean, std = moments(Gaussian(*jnp.asarray(GRID).T))
    np.testing.assert_allclose(mean, truths()[:, 0], atol=3e-4)
    np.testing.assert_allclose(std, truths()[:, 1], atol=3e-4)
    nodes, weights = np.polynomial.hermite_e.hermegauss(lifting.NODES)
    action = np.tanh([m + np.exp(s) * nodes for m, s in GRID])
    hermite = action @ weights / weights.sum()
    assert np.abs(hermite - truths()[:, 0]).max() > 1e-2


@pytest.mark.parametrize(("mean", "log_std"), [(7.5, 0.5), (20.5, 1.5), (34.0, 2.0), (-34.0, 2.0)])
def test_moments_of_nearly_saturated_actions(mean: float, log_std: float) -> None:
    """Where the nodes miss the tail beyond 0, the mean is as exact as elsewhere and the deviation within 2.1e-3."""
    of_mean, of_std = moments(Gaussian(jnp.asarray([mean]), jnp.asarray([log_std])))
    true_mean, true_std = exact(mean, np.exp(log_std))
    np.testing.assert_allclose(of_mean, [true_mean], atol=3e-4)
    np.testing.assert_allclose(of_std, [true_std], atol=2.1e-3)


def test_nodes_are_no_more_than_needed() -> None:
    """With half as many the widest Gaussians would be off by more than 3e-3."""
    noise = np.linspace(-lifting.SPAN, lifting.SPAN, lifting.NODES // 2)
    share = stats.norm.pdf(noise) / stats.norm.pdf(noise).sum()
    action = np.tanh([m + np.exp(s) * noise for m, s in GRID])
    assert np.abs(action @ share - truths()[:, 0]).max() > 3e-3


def test_moments_are_not_rounded() -> None:
    """A GPU would round their factors with `--precision bfloat16`."""
    policy = Gaussian(jnp.zeros((4, 2)), jnp.zeros((4, 2)))
    with jax.default_matmul_precision(BFLOAT16[0]):
        assert "dot_general" in (program := str(jax.make_jaxpr(moments)(policy)))
        assert "BF16" not in program


def test_moments_are_those_of_samples() -> None:
    policy = Gaussian(jnp.asarray([0.4, -1.0]), jnp.asarray([-0.7, 0.5]))
    keys = jax.random.split(jax.random.key(0), 200_000)
    actions = jax.vmap(lambda key: networks.sample(policy, key)[0])(keys)
    mean, std = moments(policy)
    np.testing.assert_allclose(mean, actions.mean(0), atol=6e-3)
    np.testing.assert_allclose(std, actions.std(0), atol=6e-3)


@pytest.mark.parametrize("log_std", [-20.0, -8.0, 0.0, 2.0])
@pytest.mark.parametrize("mean", [-30.0, 0.0, 0.5])
def test_gradients_are_finite(mean: float, log_std: float) -> None:
    """Where the policy is deterministic or saturated as well: there the root of the variance has no slope.

    Rounding leaves a variance above 0 at most means, hence so many.
    """
    policy = Gaussian(mean + jnp.linspace(-4, 4, 1001 * ACT).reshape(-1, ACT), jnp.full((1001, ACT), log_std))
    other = Gaussian(jnp.zeros((1001, ACT)), jnp.full((1001, ACT), -1.0))
    gradient = jax.grad(lifting_loss)(policy, other)
    assert all(np.isfinite(x).all() for x in gradient)


def test_loss_by_hand() -> None:
    """Squared distances of means and of standard deviations, each averaged over batch and dimensions, added."""
    p, q = Gaussian(*np.float32([[[0.3]], [[-1.0]]])), Gaussian(*np.float32([[[-0.8]], [[0.4]]]))
    (mean, std), (to_mean, to_std) = exact(0.3, np.exp(-1)), exact(-0.8, np.exp(0.4))
    expected = (mean - to_mean) ** 2 + (std - to_std) ** 2
    np.testing.assert_allclose(lifting_loss(p, q), expected, rtol=1e-3)
    twice = [Gaussian(*(jnp.tile(x, (5, 3)) for x in policy)) for policy in (p, q)]
    np.testing.assert_allclose(lifting_loss(*twice), expected, rtol=1e-3)


def test_no_pull_where_the_policies_agree() -> None:
    """The gradient is 0 there, and not elsewhere; the delay-free policy is never pulled."""
    rng = np.random.default_rng(0)
    policy = Gaussian(*(jnp.asarray(rng.normal(size=(8, ACT)), jnp.float32) for _ in range(2)))
    assert all(np.all(np.asarray(x) == 0) for x in jax.grad(lifting_loss)(policy, policy))
    other = Gaussian(policy.mean + 0.3, policy.log_std - 0.2)
    assert all(np.abs(x).max() > 1e-4 for x in jax.grad(lifting_loss)(policy, other))
    assert all(np.all(np.asarray(x) == 0) for x in jax.grad(lifting_loss, argnums=1)(policy, other))


def test_weight_is_annealed() -> None:
    """10 up to a quarter of the run, then linear to 0 at three quarters, then 0."""
    agent = Lifting()
    for step, weight in ((0, 10), (250_000, 10), (300_000, 9), (500_000, 5), (749_999, 2e-5), (750_000, 0), (10**6, 0)):
        np.testing.assert_allclose(agent.weight(jnp.int32(step)), weight, rtol=1e-3, atol=1e-7)


def test_clock_is_the_environment_step() -> None:
    """`count` numbers updates; two updates every four steps: update 2i and 2i + 1 happen at step 4i."""
    agent = dataclasses.replace(TINY, lifting_hold=4, lifting_end=12)
    given = agent.init(SPEC, jax.random.key(0)), windows(), jax.random.key(0)
    weight_at = jax.jit(lambda count: agent.update(*given, count)[1]["lifting_weight"])  # compiles nothing else
    for count, weight in ((0, 10), (2, 10), (3, 10), (4, 5), (5, 5), (6, 0), (7, 0)):
        np.testing.assert_allclose(weight_at(jnp.int32(count)), weight)


@pytest.mark.parametrize("weight", [0.0, 10.0])
def test_without_weight_it_is_bpql(weight: float) -> None:
    """The delayed half is BPQL's update, exactly where the weight is 0; with it the actor alone differs."""
    agent = dataclasses.replace(TINY, lifting_weight=weight)
    state = agent.init(SPEC, jax.random.key(0))
    key = jax.random.key(1)
    _, delayed_key = jax.random.split(key)
    new, metrics = agent.update(state, windows(), key, jnp.int32(0))
    expected, of_bpql = agent.bpql.update(state.delayed, windows(), delayed_key, jnp.int32(0))
    assert same(new.delayed.actor, expected.actor) == (weight == 0)
    assert same((new.delayed.critic, new.delayed.target), (expected.critic, expected.target))
    assert all(np.array_equal(metrics[name], of_bpql[name]) for name in of_bpql)


def test_reference_is_sac_with_the_delayed_temperature() -> None:
    """It learns as delay-free SAC does at that temperature; the delayed policy's entropy alone moves the latter."""
    state = TINY.init(SPEC, jax.random.key(0))
    warm = state._replace(delayed=state.delayed._replace(log_temperature=jnp.float32(0.3)))
    reference_key, _ = jax.random.split(jax.random.key(1))
    for start in (state, warm):
        shared = start.reference._replace(log_temperature=start.delayed.log_temperature)
        expected, _ = TINY.reference.update(shared, windows(), reference_key, jnp.int32(0))
        new, _ = TINY.update(start, windows(), jax.random.key(1), jnp.int32(0))
        assert same(
            (new.reference.actor, new.reference.critic, new.reference.target),
            (expected.actor, expected.critic, expected.target),
        )
        assert new.reference.log_temperature == new.delayed.log_temperature != start.delayed.log_temperature
    assert TINY.reference_policy(state) == (TINY.reference, state.reference)
    assert TINY.reference.init(Spec(OBS, ACT, 0), jax.random.key(0)).actor[0]["w"].shape[0] == OBS


def test_it_pulls_towards_the_reference() -> None:
    """With a heavy weight, towards a reference that stands still, the lifting loss falls by an order of magnitude."""
    bpql = dataclasses.replace(TINY.bpql, actor_learning_rate=3e-3)
    agent = dataclasses.replace(TINY, bpql=bpql, lifting_weight=1000.0)
    state = agent.init(SPEC, jax.random.key(0))
    still = state.reference.actor
    still = [*still[:-1], {"w": still[-1]["w"], "b": still[-1]["b"] + 0.5}]
    update = jax.jit(agent.update)
    losses = []
    for i in range(150):
        state = state._replace(reference=state.reference._replace(actor=still))
        state, metrics = update(state, windows(), jax.random.key(i), jnp.int32(0))
        losses.append(float(metrics["lifting_loss"]))
    assert losses[-1] < 0.1 * losses[0]


def test_lifting_loss_is_of_one_step() -> None:
    """The delayed policy at x_t with the delay-free one at s_t, t the true step."""
    state = TINY.init(SPEC, jax.random.key(0))
    # a reference that does not move, so that what it was compared with is known
    agent = dataclasses.replace(TINY, bpql=dataclasses.replace(TINY.bpql, actor_learning_rate=1e-12))
    _, metrics = jax.jit(agent.update)(state, windows(), jax.random.key(1), jnp.int32(0))
    x, s = augmented(windows()), windows().obs[:, DELAY]
    delayed, reference = agent.bpql.policy(state.delayed.actor, x), agent.bpql.policy(state.reference.actor, s)
    np.testing.assert_allclose(metrics["lifting_loss"], lifting_loss(delayed, reference), rtol=1e-4)


def test_it_pulls_towards_the_updated_reference() -> None:
    """The reference learns first; the delayed policy is compared with what it has learned."""
    bpql = dataclasses.replace(TINY.bpql, actor_learning_rate=0.1)
    agent = dataclasses.replace(TINY, bpql=bpql)
    state = agent.init(SPEC, jax.random.key(0))
    new, metrics = jax.jit(agent.update)(state, windows(), jax.random.key(1), jnp.int32(0))
    x, s = augmented(windows()), windows().obs[:, DELAY]
    delayed = bpql.policy(state.delayed.actor, x)
    before, after = (lifting_loss(delayed, bpql.policy(r.actor, s)) for r in (state.reference, new.reference))
    assert abs(before - after) > 0.01
    np.testing.assert_allclose(metrics["lifting_loss"], after, rtol=1e-4)


def test_it_acts_by_the_delayed_policy() -> None:
    """Unprivileged: in training as well it needs no true state."""
    state = TINY.init(SPEC, jax.random.key(0))
    assert not TINY.privileged
    what = Seen(jnp.ones(OBS), jnp.int32(2), jnp.zeros((DELAY, ACT)).at[:2].set(0.3))
    for explore in (False, True):
        action = TINY.act(state, what, jax.random.key(0), explore=explore)
        expected = TINY.bpql.act(state.delayed, what, jax.random.key(0), explore=explore)
        np.testing.assert_array_equal(action, expected)


def test_hold_is_before_end() -> None:
    Lifting(lifting_end=800_000).for_run(Schedule(steps=800_000))
    with pytest.raises(DelayRLError, match="no later than steps, 800000; got 800001"):
        Lifting(lifting_end=800_001).for_run(Schedule(steps=800_000))
    with pytest.raises(DelayRLError, match="no later than lifting_end = 750000; got 800000"):
        Lifting(lifting_hold=800_000).init(SPEC, jax.random.key(0))
