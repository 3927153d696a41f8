"""How long a run will take, before it starts."""

import time
from typing import Any

import jax
import jax.numpy as jnp

from delayrl.agents.base import Agent, Phase, template
from delayrl.core import replay as ring
from delayrl.core.precision import product
from delayrl.core.types import Spec
from delayrl.training.state import Group, TrainState

UTILISATION = 0.25
"""Share of the matmul rate that an update reaches on a CPU, measured on presets `small` and `paper`."""


def estimate(group: Group, state: TrainState) -> str:
    """Return in words how long the rest of a run will take on this device."""
    hours, steps = _seconds(group, state) / 3600, group.setup.schedule.steps - state.step
    if hours < 0.5:
        return f"about {max(1, round(hours * 60))} min for {steps:,} steps on this device"
    advice = "; --preset small takes minutes" if group.setup.condition.preset == "paper" else ""
    return f"about {hours:.1f} h for {steps:,} steps on this device{advice}"


def _seconds(group: Group, state: TrainState) -> float:
    """Guess from the updates' arithmetic, at a fraction of this device's matmul rate."""
    square = jnp.ones((1024, 1024))
    multiply = jax.jit(lambda x: product(x, x))
    multiply(square).block_until_ready()
    start = time.perf_counter()
    for _ in range(4):
        multiply(square).block_until_ready()
    rate = 4 * 2 * 1024**3 / (time.perf_counter() - start)
    schedule = group.setup.schedule
    seconds = (schedule.steps - state.step) * 2e-4
    for phase in group.program.phases:
        cost = jax.jit(phase.update).lower(*update_shapes(phase, group.setup.agent, group.spec)).cost_analysis()
        flops = float((cost or {}).get("flops", 0.0))
        rounds = (schedule.steps - max(state.step, schedule.first_update)) / phase.every
        seconds += max(rounds, 0) * phase.updates * len(group.seeds) * (flops / (UTILISATION * rate) + 3e-4)
    return seconds


def update_shapes(phase: Phase, agent: Agent, spec: Spec) -> tuple[Any, ...]:
    """Return the shapes and types of the arguments of a phase's update for one seed. Touches no device."""
    reach = (phase.batch, spec.delay, agent.ahead(spec))
    replay = jax.eval_shape(lambda: ring.init(spec, 2))
    key, number = jax.eval_shape(lambda: jax.random.key(0)), jax.ShapeDtypeStruct((), jnp.int32)
    windows = jax.eval_shape(lambda replay, key, hidden: ring.sample(replay, key, *reach, hidden), replay, key, number)
    return template(agent, spec), windows, key, number
