"""DIDA: who acts when, who learns what, and what is imitated."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import same

from conftest import learned, record, replay_of, sample
from delayrl.agents.base import Schedule
from delayrl.agents.dida import DIDA
from delayrl.agents.sac import SAC
from delayrl.core.networks import mode
from delayrl.core.types import Seen, Spec, Window
from delayrl.core.views import network_input, view
from delayrl.errors import DelayRLError
from delayrl.run.condition import resolve
from delayrl.training.learner import Program

AGENT = DIDA(
    SAC(hidden=(16, 16), batch_size=16, actor_updates=1),
    expert_steps=20,
    round_steps=10,
    imitation_updates=3,
    student_hidden=(8, 8),
)
SPEC = Spec(10, 2, 3)


@functools.cache
def parts():
    transitions, _ = record("Reacher-v5", 3, 90)
    windows = sample(replay_of(transitions, SPEC, 200), jax.random.key(0), 32, 3, 3, 0)
    return AGENT.init(SPEC, jax.random.key(0)), windows


@functools.cache
def update():
    return jax.jit(AGENT.update)


@functools.cache
def imitate():
    return jax.jit(AGENT.imitate)


def test_the_expert_learns_as_sac_and_is_frozen_after_its_steps() -> None:
    state, windows = parts()
    at_its_end, metrics = update()(state, windows, jax.random.key(1), jnp.int32(20))
    sac, of_sac = jax.jit(AGENT.reference.update)(state.reference, windows, jax.random.key(1), jnp.int32(20))
    for a, b in zip(jax.tree.leaves((at_its_end.reference, metrics)), jax.tree.leaves((sac, of_sac)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
    assert metrics.keys() == of_sac.keys()
    assert same((at_its_end.student, at_its_end.opt_state), (state.student, state.opt_state))
    after, idle = update()(state, windows, jax.random.key(1), jnp.int32(21))
    assert same(after.reference, state.reference)
    assert same((after.student, after.opt_state), (state.student, state.opt_state))
    assert {float(x) for x in idle.values()} == {0.0}
    assert int(after.steps) == 21


def test_imitation_waits_for_the_expert() -> None:
    """Rounds end at the steps 10, 20, 30, …: the student learns from the round that ends at 20 on, alone."""
    state, windows = parts()
    for count in (3, 5):  # the updates of the round at step 10
        assert same(imitate()(state, windows, jax.random.key(1), jnp.int32(count))[0], state)
    for count in (6, 8, 9):  # of those at 20 and 30
        learned, metrics = imitate()(state, windows, jax.random.key(1), jnp.int32(count))
        assert not same(learned.student, state.student)
        assert same(learned.reference, state.reference)
        assert same(learned.steps, state.steps)
        assert metrics["imitation_loss"] > 0


def test_imitation_loss_by_hand() -> None:
    """Σ over batch and dimensions of |student(x_t) - expert(s_t)|; x_t as the actor saw it, starts included."""
    state, windows = parts()
    loss, _ = AGENT.imitation_loss(state.student, state.reference.actor, windows)
    total, ages = 0.0, set()
    for i in range(32):
        window: Window = jax.tree.map(lambda x, i=i: x[i], windows)
        x = np.asarray(network_input(view(window), "augmented"))
        for layer in state.student[:-1]:
            x = np.maximum(x @ np.asarray(layer["w"]) + np.asarray(layer["b"]), 0)
        student = np.tanh(x @ np.asarray(state.student[-1]["w"]) + np.asarray(state.student[-1]["b"]))
        expert = mode(AGENT.reference.policy(state.reference.actor, window.obs[3]))
        total += np.abs(student - np.asarray(expert)).sum()
        ages.add(int(window.age[3]))
    np.testing.assert_allclose(loss, total, rtol=1e-4)
    assert len(ages) > 1  # starts of episodes


def test_rmsprop_is_pytorchs() -> None:
    """w ← w - lr g / (√v + ε), v ← .9 v + .1 g²: the first step is lr / √.1 in every direction with a gradient."""
    optimiser = DIDA().optimiser
    gradient = jnp.array([2.0, -0.5, 0.0, 1e-6])  # for the last an ε inside the root would not be small
    change, memory = optimiser.update(gradient, optimiser.init(jnp.zeros(4)))
    np.testing.assert_allclose(change, np.array([-1e-3, 1e-3, 0, -1e-3]) / 0.1**0.5, rtol=1e-3)
    change, _ = optimiser.update(gradient, memory)
    np.testing.assert_allclose(change, np.array([-1e-3, 1e-3, 0, -1e-3]) / 0.19**0.5, rtol=1e-3)


def test_who_acts() -> None:
    """The expert, exploring on the true state, until `expert_steps` have been learned from; then the student alone."""
    state, _ = parts()
    draw = np.random.default_rng(0).normal(size=(2, 10)).astype(np.float32)
    seen = Seen(jnp.asarray(draw[0]), jnp.int32(2), jnp.zeros((3, 2)).at[:2].set(0.3), jnp.asarray(draw[1]))
    blind = seen._replace(truth=None)
    student = AGENT.act(state, blind, jax.random.key(0), explore=False)
    np.testing.assert_array_equal(student, AGENT.policy(state.student, network_input(seen, "augmented")))
    for steps in (0, 19):
        early = state._replace(steps=jnp.int32(steps))
        current = Seen(seen.truth, jnp.int32(0), jnp.zeros((0, 2)))
        expert = AGENT.reference.act(state.reference, current, jax.random.key(7), explore=True)
        np.testing.assert_allclose(AGENT.act(early, seen, jax.random.key(7), explore=True), expert, rtol=1e-6)
        np.testing.assert_array_equal(AGENT.act(early, blind, jax.random.key(7), explore=False), student)
    late = state._replace(steps=jnp.int32(20))
    np.testing.assert_array_equal(AGENT.act(late, seen, jax.random.key(7), explore=True), student)
    with pytest.raises(AssertionError, match="privileged"):
        AGENT.act(state, blind, jax.random.key(0), explore=True)
    assert AGENT.privileged
    agent, inner = AGENT.reference_policy(state)
    assert agent == AGENT.reference
    assert inner is state.reference


def test_it_asks_for_what_it_needs() -> None:
    with pytest.raises(DelayRLError, match="at least 1 step"):
        AGENT.init(Spec(10, 2, 0), jax.random.key(0))
    AGENT.for_run(Schedule(steps=21, random_steps=19))
    for schedule in (Schedule(steps=20, random_steps=5), Schedule(steps=40, random_steps=20)):
        with pytest.raises(DelayRLError, match="must lie between"):
            AGENT.for_run(schedule)
    with pytest.raises(DelayRLError, match="must lie between"):
        AGENT.for_run(Schedule(steps=40, random_steps=5, update_after=20))  # an expert that never learns
    uneven = dataclasses.replace(AGENT, expert_steps=12)
    with pytest.raises(DelayRLError, match=r"rounded up to whole rounds of 10, must lie between .* 5 and 20; got 12"):
        uneven.for_run(Schedule(steps=20, random_steps=5))


def test_the_expert_ends_with_a_round() -> None:
    """Otherwise the student would act before its first update. Every length of a run can be asked for."""
    assert [dataclasses.replace(AGENT, expert_steps=n).expert_end for n in (10, 11, 19, 20, 21)] == [10, 20, 20, 20, 30]
    state, seen = parts()[0], Seen(jnp.ones(10), jnp.int32(2), jnp.zeros((3, 2)), jnp.ones(10))
    uneven = dataclasses.replace(AGENT, expert_steps=12)
    for steps in (12, 19, 20):
        now = state._replace(steps=jnp.int32(steps))
        key = jax.random.key(7)
        np.testing.assert_array_equal(uneven.act(now, seen, key, explore=True), AGENT.act(now, seen, key, explore=True))
    for steps in (5_000, 20_000, 25_001):
        assert resolve("dida", "Reacher-v5", 3, "small", "corrected", {"steps": steps}).agent.expert_end % 250 == 0


@pytest.mark.thorough
def test_under_the_loop() -> None:
    """The phases in order; the first imitation comes before the student acts; the same twice; seeds side by side."""
    data = [record("Reacher-v5", 3, 31, seed)[0] for seed in range(2)]
    program = Program(AGENT, SPEC)

    def run() -> list:
        keys = jax.vmap(jax.random.key)(jnp.arange(2))
        states = []
        for learner, metrics in learned(program, keys, data, 9, capacity=100):
            assert all(np.isfinite(x).all() for x in metrics.values())
            states.append(jax.device_get(learner.agent))
        return states

    states = run()
    for step in range(1, 32):
        assert list(states[step - 1].steps) == [step if step > 8 else 0] * 2
    imitated = [step for step in range(2, 32) if not same(states[step - 1].student, states[step - 2].student)]
    assert imitated == [20, 30]
    improved = [step for step in range(2, 32) if not same(states[step - 1].reference, states[step - 2].reference)]
    assert improved == list(range(9, 21))
    assert same(states[-1], run()[-1])


def test_phases() -> None:
    assert DIDA().reference == SAC()
    assert DIDA().phases()[1][:3] == (1000, 1000, 32)
    assert AGENT.phases()[1][:2] == (10, 3)
