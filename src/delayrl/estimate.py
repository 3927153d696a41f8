"""How long a run will take, before it starts."""

import time

import jax
import jax.numpy as jnp

from delayrl import replay as ring
from delayrl.agents.base import Agent, Schedule
from delayrl.learning import Learner, Program
from delayrl.types import Spec

UTILISATION = 0.25
"""Share of the matmul rate that an update reaches on a CPU, measured on presets `small` and `paper`."""


def estimate_seconds(
    program: Program, learner: Learner, agent: Agent, spec: Spec, schedule: Schedule, step: int
) -> float:
    """A rough guess of the time to train: the updates' arithmetic, at a fraction of this device's matmul rate."""
    square = jnp.ones((1024, 1024))
    multiply = jax.jit(lambda x: x @ x)
    multiply(square).block_until_ready()
    start = time.perf_counter()
    for _ in range(4):
        multiply(square).block_until_ready()
    rate = 4 * 2 * 1024**3 / (time.perf_counter() - start)
    seconds = (schedule.steps - step) * 2e-4
    replay, state = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), (learner.replay, learner.agent))
    seeds = learner.replay.rows.shape[0]
    key, number = jax.eval_shape(lambda: jax.random.key(0)), jax.ShapeDtypeStruct((), jnp.int32)
    for phase in program.phases:
        reach = (phase.batch, spec.delay, agent.ahead(spec))
        windows = jax.eval_shape(lambda r, k, h, n=reach: ring.sample(r, k, n[0], n[1], n[2], h), replay, key, number)
        cost = jax.jit(phase.update).lower(state, windows, key, number).cost_analysis()
        flops = float((cost or {}).get("flops", 0.0))
        rounds = (schedule.steps - max(step, schedule.random_steps)) / phase.every
        seconds += max(rounds, 0) * phase.updates * seeds * (flops / (UTILISATION * rate) + 3e-4)
    return seconds
