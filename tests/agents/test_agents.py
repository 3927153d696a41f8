"""What holds for every agent, and the identities between them."""

import dataclasses
import functools
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import ACT, DELAYED, ENV, OBS, program_of, same, seen, trained

from conftest import TINY, learned, quick, record
from delayrl.agents.normalised import NormalisedObservations
from delayrl.agents.random import Random
from delayrl.agents.registry import AGENTS
from delayrl.core import views
from delayrl.core.types import Seen, Spec, Window
from delayrl.core.views import look, network_input
from delayrl.errors import DelayRLError
from delayrl.training.learner import AS_ONE, Learner, Stored
from random_states import random_state

PRIVILEGED = {name for name in DELAYED if TINY[name].privileged}
HONEST = {name: TINY[name] for name in DELAYED if name not in PRIVILEGED} | {
    "vdpo, behaviour delayed": dataclasses.replace(TINY["vdpo"], behaviour="delayed"),
    "ad-sac, behaviour augmented": dataclasses.replace(TINY["ad-sac"], behaviour="augmented"),
    "bpql, normalised observations": NormalisedObservations(TINY["bpql"]),
    "any-age, mlp": dataclasses.replace(TINY["any-age"], encoder="mlp"),
    "any-age, pulled": dataclasses.replace(TINY["any-age"], pull_weight=1.0),
    "any-age, transformer": dataclasses.replace(TINY["any-age"], encoder="transformer", belief_weight=1.0),
    "ad-sac, auxiliary delay 1": dataclasses.replace(TINY["ad-sac"], auxiliary_delay=1),
}


def test_registry_is_tested() -> None:
    assert set(DELAYED) | {"sac", "random"} == set(AGENTS)


@pytest.mark.parametrize("name", list(AGENTS))
@pytest.mark.parametrize("preset", ["paper", "matched", "small"])
def test_presets_are_whole(name: str, preset: str) -> None:
    """Every preset initialises for its task, and every hyperparameter says what it means."""
    agent, _ = AGENTS[name].presets[preset]
    delay = 0 if name == "sac" else 5
    state = jax.eval_shape(lambda key: agent.init(Spec(17, 6, delay), key), jax.random.key(0))
    assert jax.tree.leaves(state)
    assert hash(agent) == hash(dataclasses.replace(agent))


@pytest.mark.parametrize("name", quick(DELAYED, "bpql", "vdpo", slow=DELAYED))
def test_lockstep_seeds_are_seeds_alone(name: str) -> None:
    """Three seeds beside each other learn what each learns alone, up to the rounding of batched products.

    Agents know nothing of seeds, so that one with a phase and one with two are enough for CI.
    """
    agent = TINY[name]
    data = [record(ENV, 3, 60, seed)[0] for seed in range(3)]

    def run(seeds: list[int]):
        keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
        *_, (learner, _) = learned(program_of(agent, 3), keys, [data[seed] for seed in seeds], 46)
        return learner.agent

    together = run([0, 1, 2])
    for seed in range(3):
        alone = run([seed])
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[seed], b[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", quick(["bpql", "vdpo"], "bpql"))
def test_a_block_of_steps_is_its_steps(name: str) -> None:
    """Five steps learned from in one call, and one by one; the rarer phase is due at the block's end."""
    agent, data = TINY[name], record(ENV, 3, 90)[0]
    program = program_of(agent, 3)
    keys = jax.vmap(jax.random.key)(jnp.arange(1))
    ends = []
    for block in (1, 5):
        metrics = {}
        options = {"hidden": lambda step: step % 3, "block": block}
        for learner, new in learned(program, keys, [data], 61, **options):
            metrics |= new
            last = learner
        ends.append((last, metrics))
    assert set(ends[0][1]) == set(ends[1][1])
    for a, b in zip(jax.tree.leaves(ends[0][0]), jax.tree.leaves(ends[1][0]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("seeds", "block"), [(1, 1), pytest.param(2, 4, marks=pytest.mark.thorough)])
def test_learning_copies_no_replay(seeds: int, block: int) -> None:
    """What the compiled programs need beside their arguments is less than the smallest column of the replay."""
    program, capacity = program_of(TINY["bpql"], 3), 10**6
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    step = jax.tree.map(lambda x: np.stack([[x] * seeds] * block), record(ENV, 3, 1)[0][0])
    stored, steps = Stored(step, np.zeros((block, seeds), np.int32)), np.full(block, 100)
    first = jax.tree.map(lambda x: x[0], stored)

    def programs(learner: Learner) -> list:
        if AS_ONE:
            return [program._jitted_learn.lower(learner, stored, keys, steps, first_phase=True)]
        update = program._jitted_update.lower(learner, first.hidden, keys, np.int32(100), index=0)
        moment = np.zeros(seeds, np.int32)
        return [program._jitted_append.lower(learner.replay, first.transition, moment), update]

    learner = jax.eval_shape(lambda: program.init(keys, capacity))
    for lowered in programs(learner):
        compiled = lowered.compile({"xla_backend_optimization_level": 3})
        assert compiled.memory_analysis().temp_size_in_bytes < capacity  # a column has a byte a row, or more


@pytest.mark.parametrize("block", [pytest.param(1, marks=pytest.mark.thorough), 3])
def test_learning_in_calls_apart_is_learning_as_one(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """On old JAX writing and reading the replay are calls of their own: the same learner, up to rounding."""
    keys, data, ends = jax.vmap(jax.random.key)(jnp.arange(1)), record(ENV, 3, 60)[0], []
    for as_one in (True, False):
        monkeypatch.setattr("delayrl.training.learner.AS_ONE", as_one)
        options = {"hidden": lambda step: step % 3, "block": block}
        *_, end = learned(program_of(TINY["bpql"], 3), keys, [data], 46, **options)
        ends.append(end)
    for a, b in zip(*(jax.tree.leaves(end) for end in ends), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", DELAYED)
def test_acting_never_peeks(name: str, rng: np.random.Generator) -> None:
    """A deterministic action depends on nothing but (observation, age, actions since), whatever the truth is."""
    state = random_state(TINY[name], Spec(OBS, ACT, 3))
    act = jax.jit(functools.partial(TINY[name].act, explore=False))
    looked = [seen(3, age, rng) for age in (0, 3)]
    assert not any(
        same(act(state, x, jax.random.key(0)), act(state, x._replace(obs=x.obs - 1), jax.random.key(0))) for x in looked
    )
    for age in range(4):
        what = seen(3, age, rng)
        action = act(state, what, jax.random.key(0))
        for truth in (-1e3, 1e3):  # whatever is handed to it
            told = what._replace(truth=jnp.full(OBS, truth))
            np.testing.assert_array_equal(action, act(state, told, jax.random.key(1)))
        assert np.abs(np.asarray(action)).max() <= 1


@pytest.mark.parametrize("name", list(HONEST))
def test_unprivileged_behaviour_needs_no_truth(name: str, rng: np.random.Generator) -> None:
    agent = HONEST[name]
    state = jax.eval_shape(functools.partial(agent.init, Spec(OBS, ACT, 3)), jax.random.key(0))
    assert not agent.privileged
    jax.eval_shape(functools.partial(agent.act, explore=True), state, seen(3, 2, rng), jax.random.key(0))


@pytest.mark.parametrize("name", quick(["bpql", "any-age", "bpql, normalised observations"], "bpql"))
def test_learning_never_peeks(name: str) -> None:
    """What has not arrived may be anything: an unprivileged learner ends with the same parameters.

    An update knows windows alone, and `Program` tells their sampling what is hidden, whatever the agent.
    """
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


def test_a_view_that_is_none_and_one_beyond_the_window() -> None:
    """Both would train an agent that sees something else than its author thinks."""
    unchecked = runpy.run_path(views.__file__)  # without the checks of types, which are the tests' own
    with pytest.raises(DelayRLError, match="a network sees current, delayed, augmented; got 'augmentd'"):
        unchecked["network_input"](Seen(jnp.ones(2), jnp.int32(1), jnp.ones((3, 1))), "augmentd")
    rows, count = jnp.zeros(3 + 1 + 2), jnp.int32(0)
    flags, ages = rows > 0, rows.astype(int)
    window = Window(rows[:, None], ages, rows[:, None], rows, flags, flags, count, count, delay=3)
    assert look(window, "current", 2).shape == (1,)
    with pytest.raises(DelayRLError, match=r"0 to 2 steps after t \(the agent's `ahead`\); got ahead=3"):
        look(window, "augmented", 3)
    with pytest.raises(DelayRLError, match="got ahead=-1"):
        look(window, "augmented", -1)


def test_the_current_state_is_the_truth_or_unknown() -> None:
    """Under a delay, what an actor is shown is not what a network that sees `current` learns from."""
    shown = Seen(jnp.ones(2), jnp.int32(2), jnp.ones((3, 1)))
    np.testing.assert_array_equal(network_input(shown._replace(truth=jnp.full(2, 9.0)), "current"), [9, 9])
    with pytest.raises(DelayRLError, match="the current state is not known under a delay"):
        network_input(shown, "current")
    no_delay = Seen(jnp.ones(2), jnp.int32(0), jnp.ones((0, 1)))
    np.testing.assert_array_equal(network_input(no_delay, "current"), [1, 1])


def test_random_is_uniform() -> None:
    state = Random().init(Spec(1, 3, 0), jax.random.key(0))
    what = Seen(jnp.zeros(1), jnp.int32(0), jnp.zeros((0, 3)))
    draws = np.stack([Random().act(state, what, jax.random.key(i), explore=False) for i in range(500)])
    assert draws.shape == (500, 3)
    assert abs(draws.mean()) < 0.05
    assert abs(draws.std() - 3**-0.5) < 0.03
