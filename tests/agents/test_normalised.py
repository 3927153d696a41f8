"""Normalised observations: the same agent on other numbers, and the same numbers for those who deploy it."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import ACT, ENV, OBS, random_windows, same, seen, trained

import delayrl
from conftest import TINY, record
from delayrl.agents.base import Agent
from delayrl.agents.normalised import Moments, NormalisedObservations, merged
from delayrl.core.types import Spec
from delayrl.play.run import Run
from short_runs import assert_same_networks, killed_and_resumed, train

MOMENTS = Moments(jnp.float32(100), jnp.linspace(-3, 3, OBS), 100 * jnp.linspace(0.2, 4, OBS) ** 2)


def by_hand(obs) -> np.ndarray:
    return ((np.asarray(obs) - np.linspace(-3, 3, OBS)) / np.linspace(0.2, 4, OBS)).astype(np.float32)


def test_moments_are_those_of_all_batches(rng: np.random.Generator) -> None:
    moments = Moments(jnp.zeros(()), jnp.zeros(2), jnp.zeros(2))
    batches = [rng.normal([5, -100], [0.1, 30], (size, 2)).astype(np.float32) for size in (1, 16, 300)]
    for batch in batches:
        moments = merged(moments, jnp.asarray(batch))
    everything = np.concatenate(batches)
    assert moments.number == len(everything)
    np.testing.assert_allclose(moments.mean, everything.mean(0), rtol=1e-5)
    np.testing.assert_allclose(moments.squares / moments.number, everything.var(0), rtol=1e-4)


TWO_PHASES = replace(TINY["vdpo"], representation="mlp")


@pytest.mark.parametrize(
    "inner", [pytest.param(TINY["bpql"], marks=pytest.mark.thorough), TWO_PHASES], ids=["bpql", "vdpo"]
)
def test_an_update_is_the_inner_agents_on_normalised_windows(inner: Agent) -> None:
    """The first phase adds its sampled states to the moments before it uses them; rows that are not valid stay 0."""
    spec = Spec(OBS, ACT, 3)
    agent = NormalisedObservations(inner)
    windows = random_windows(spec)
    windows = replace(windows, obs=7 * windows.obs + 2, valid=windows.valid.at[:, 0].set(False))
    state, key, count = agent.init(spec, jax.random.key(0)), jax.random.key(1), jnp.int32(1)
    states = np.asarray(windows.obs[:, 3])
    normalised = (np.asarray(windows.obs) - states.mean(0)) / states.std(0)
    on_numbers = replace(windows, obs=jnp.asarray(np.where(np.asarray(windows.valid)[..., None], normalised, 0)))
    for phase, own in zip(inner.phases(), agent.phases(), strict=True):
        expected, metrics = jax.jit(phase.update)(state.agent, on_numbers, key, count)
        state, measured = jax.jit(own.update)(state, windows, key, count)
        assert metrics.keys() == measured.keys()
        for a, b in zip(jax.tree.leaves(state.agent), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)
        state = state._replace(agent=expected)
        assert state.moments.number == len(states)  # of the first phase alone


@pytest.mark.parametrize("inner", [TINY["bpql"], replace(TINY["vdpo"], behaviour="reference")], ids=["bpql", "vdpo"])
def test_acting_is_the_inner_agents_on_normalised_observations(inner: Agent, rng: np.random.Generator) -> None:
    """The truth too, which a privileged agent sees in training."""
    spec = Spec(OBS, ACT, 3)
    agent = NormalisedObservations(inner)
    state = agent.init(spec, jax.random.key(0))._replace(moments=MOMENTS)
    shown = seen(3, 2, rng, truth=True)
    scaled = shown._replace(obs=jnp.asarray(by_hand(shown.obs)), truth=jnp.asarray(by_hand(shown.truth)))
    for explore in (False, True):
        action = agent.act(state, shown, jax.random.key(1), explore=explore)
        np.testing.assert_allclose(
            action, inner.act(state.agent, scaled, jax.random.key(1), explore=explore), rtol=1e-5
        )
    if reference := agent.reference_policy(state):
        policy, weights = reference
        own, raw = inner.reference_policy(state.agent)
        action = policy.act(weights, shown, jax.random.key(1), explore=False)
        np.testing.assert_allclose(action, own.act(raw, scaled, jax.random.key(1), explore=False), rtol=1e-5)


def test_before_learning_observations_are_as_they_are(rng: np.random.Generator) -> None:
    agent, shown = NormalisedObservations(TINY["bpql"]), seen(3, 2, rng)
    state = agent.init(Spec(OBS, ACT, 3), jax.random.key(0))
    expected = agent.agent.act(state.agent, shown, jax.random.key(1), explore=False)
    assert same(agent.act(state, shown, jax.random.key(1), explore=False), expected)


def test_a_constant_entry_is_no_division_by_zero() -> None:
    data = [t._replace(obs=t.obs * np.arange(OBS), next_obs=t.next_obs * np.arange(OBS)) for t in record(ENV, 3, 60)[0]]
    learner, metrics, _ = trained(NormalisedObservations(TINY["bpql"]), 3, transitions=data)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((learner.agent, metrics)))


@pytest.fixture(scope="module")
def normed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train("bpql", tmp_path_factory.mktemp("normed") / "run", observation_norm="running")


@pytest.mark.thorough
def test_killed_and_resumed(normed: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cut = killed_and_resumed("bpql", tmp_path / "cut", monkeypatch, observation_norm="running")
    assert cut.rows() == normed.rows()
    assert_same_networks(cut, normed)
    assert train("bpql", tmp_path / "plain").rows() != normed.rows()


def test_a_loaded_policy_has_its_moments(normed: Run, tmp_path: Path) -> None:
    policy = delayrl.load(normed.path)
    assert isinstance(policy.agent, NormalisedObservations)
    assert policy.state.moments.number == 201 * 8  # updates of the run, windows of a batch
    with pytest.raises(delayrl.DelayRLError, match="observation_norm must be one of none, running; got 'batch'"):
        train("bpql", tmp_path / "bad", observation_norm="batch")


def test_a_frozen_expert_sees_what_it_learned_from(tmp_path: Path) -> None:
    """Its moments would go on with the student's data."""
    with pytest.raises(delayrl.DelayRLError, match="dida takes observation_norm none; got running"):
        train("dida", tmp_path / "run", observation_norm="running")
