"""How long a run will take, before it starts."""

import time
from typing import Any

import jax
import jax.numpy as jnp

from delayrl.agents.base import Agent, Phase, Schedule, template
from delayrl.core import replay as ring
from delayrl.core.types import Spec
from delayrl.training.learner import Learner, Program

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
    seeds = learner.replay.rows.shape[0]
    for phase in program.phases:
        cost = jax.jit(phase.update).lower(*update_shapes(phase, agent, spec)).cost_analysis()
        flops = float((cost or {}).get("flops", 0.0))
        rounds = (schedule.steps - max(step, schedule.random_steps)) / phase.every
        seconds += max(rounds, 0) * phase.updates * seeds * (flops / (UTILISATION * rate) + 3e-4)
    return seconds


def update_shapes(phase: Phase, agent: Agent, spec: Spec) -> tuple[Any, ...]:
    """Shapes and types of what a phase's update is given for one seed. No device is touched."""
    reach = (phase.batch, spec.delay, agent.ahead(spec))
    replay = jax.eval_shape(lambda: ring.init(spec, 2))
    key, number = jax.eval_shape(lambda: jax.random.key(0)), jax.ShapeDtypeStruct((), jnp.int32)
    windows = jax.eval_shape(lambda replay, key, hidden: ring.sample(replay, key, *reach, hidden), replay, key, number)
    return template(agent, spec), windows, key, number
