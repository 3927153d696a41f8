"""Agents trained for some steps, and windows to look at."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from conftest import learned, record, replay_of, sample
from delayrl.core.types import Seen, Spec, Window
from delayrl.training.learner import Program

ENV, OBS, ACT = "Reacher-v5", 10, 2
DELAYED = ["sac-memoryless", "a-sac", "bpql", "any-age", "lifting", "ad-sac", "dcac", "dida", "vdpo"]


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


def sampled(transitions, spec: Spec, batch: int, ahead: int) -> Window:
    """Windows of a replay that holds transitions."""
    replay = replay_of(transitions, spec, 300)
    return sample(replay, jax.random.key(0), batch, spec.delay, ahead, jnp.int32(0))


def counted(delay: int, steps: int, batch: int, ahead: int, law: str | None = None):
    """Random play of the counter, under a random delay if there is a law, and windows of it."""
    transitions, _ = record("delayrl/Counter-v0", law or delay, steps)
    replay = replay_of(transitions, Spec(2, 1, delay), 2 * steps)
    return transitions, sample(replay, jax.random.key(0), batch, delay, ahead, jnp.int32(0))


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def assert_near(a, b) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6)


def seen(delay: int, age: int, rng: np.random.Generator, truth: bool = False) -> Seen:
    actions = np.zeros((delay, ACT), np.float32)
    actions[:age] = rng.uniform(-1, 1, (age, ACT))
    obs = rng.normal(size=(2, OBS)).astype(np.float32)
    return Seen(jnp.asarray(obs[0]), jnp.int32(age), jnp.asarray(actions), jnp.asarray(obs[1]) if truth else None)


def random_windows(spec: Spec, batch: int = 8, ahead: int = 3) -> Window:
    """Windows full of random numbers, with every k and some terminations."""
    rng, time = np.random.default_rng(0), spec.delay + 1 + ahead

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(batch, time, *shape)), jnp.float32)

    return Window(
        obs=normal(spec.obs_size),
        age=jnp.full((batch, time), spec.delay, jnp.int32),
        action=jnp.tanh(normal(spec.action_size)),
        reward=normal(),
        terminated=jnp.asarray(rng.random((batch, time)) < 0.3),
        valid=jnp.ones((batch, time), bool),
        lead=jnp.full(batch, ahead, jnp.int32),
        n_step=jnp.arange(batch, dtype=jnp.int32) % ahead + 1,
        delay=spec.delay,
        log_scale=spec.log_scale,
    )
