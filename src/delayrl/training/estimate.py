"""How long a run will take, before it starts."""

import math
import time

import jax
import jax.numpy as jnp

from delayrl.core.precision import product
from delayrl.training.cost import cost_of
from delayrl.training.state import Group, TrainState

UTILISATION = 0.25
"""Share of the matmul rate that updates reach on a CPU, between presets `small` and `paper` (docs/performance.md)."""


def estimate(group: Group, state: TrainState) -> str:
    """Return in words how long the rest of a run will take on this device."""
    hours, steps = _seconds(group, state) / 3600, group.setup.schedule.steps - state.step
    if math.isnan(hours):
        return f"none for {steps:,} steps, because how often a loop of the updates runs depends on data"
    if hours < 1 / 120:
        return f"less than a minute for {steps:,} steps on this device"
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
    updates = sum(phase.updates / phase.every for phase in group.program.phases)
    flops = cost_of(group.setup.agent, group.spec, schedule).flops
    learning = max(schedule.steps - max(state.step, schedule.first_update), 0)
    return seconds + learning * len(group.seeds) * (flops / (UTILISATION * rate) + updates * 3e-4)
