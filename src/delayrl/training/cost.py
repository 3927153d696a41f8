"""What learning will cost, from the shapes of an agent's state and the traces of its updates."""

import math
import re
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from delayrl.agents.base import Agent, Phase, Schedule, template
from delayrl.core.types import Spec
from delayrl.run.arrays import named_leaves
from delayrl.run.cost import Cost
from delayrl.training.products import Value, follow, traced_updates

OPTIMISER = re.compile(r"(?:agent\.)?((?:\w+\.)*?)(?:(\w+)_)?opt_state\..*")
"""The names of the leaves of an optimiser's state, within an agent's."""
STRIDE = 101  # a prime, so that what happens at every second or fourth update is seen as often as it happens


def cost_of(agent: Agent, spec: Spec, schedule: Schedule) -> Cost:
    """Return what one seed's learning costs. Takes about a second for the largest agents, and touches no device.

    The steps of an optimiser are those that its state counts. One that counts none takes one at each update that
    changes its state.
    """
    leaves = list(named_leaves(template(agent, spec)).items())
    trained = [x for name, x in leaves if not (OPTIMISER.fullmatch(name) or {"target", "moments"} & {*name.split(".")})]
    parameters = sum(math.prod(x.shape) for x in trained if jnp.issubdtype(x.dtype, jnp.floating))
    counters = _counters(leaves)
    flops, steps = 0.0, dict.fromkeys(counters.values(), 0.0)
    for phase, traced in traced_updates(agent, spec):
        counts = update_counts(phase, schedule.first_update, schedule.steps)
        if not counts.size:
            continue  # the run ends before
        program, rate = traced.jaxpr.jaxpr, phase.updates / phase.every
        inputs: list[Value] = [None] * len(program.invars)
        for number in counters:
            inputs[number] = np.zeros(())
        inputs[-1] = counts
        products, outputs = follow(program, inputs)
        flops += rate * sum(product.flops for product in products)
        for number, name in counters.items():
            after = outputs[number]
            made = 1.0 if after is None else float(np.nan_to_num(after, nan=1.0).mean())
            steps[name] += rate * made
    batches = tuple(phase.batch for phase in agent.phases())
    return Cost(parameters, {name: round(number, 3) for name, number in steps.items()}, batches, flops)


def update_counts(phase: Phase, first: int, last: int) -> NDArray[np.int32]:
    """Return the numbers of a phase's updates from step `first` to step `last`, as the learner counts them.

    Of many only every STRIDE-th, or every STRIDE²-th and so on, [C].
    """
    begin, end = -(-first // phase.every) * phase.updates, (last // phase.every + 1) * phase.updates
    stride = 1
    while end - begin > 1000 * STRIDE * stride:
        stride *= STRIDE
    return np.arange(begin, end, stride).astype(np.int32)


def _counters(leaves: Sequence[tuple[str, Any]]) -> dict[int, str]:
    """Return the leaf that tells the steps of each optimiser, with the optimiser's name, such as "reference.actor"."""
    leaves_of: dict[str, list[int]] = defaultdict(list)
    for number, (name, _) in enumerate(leaves):
        if match := OPTIMISER.fullmatch(name):
            leaves_of[f"{match[1]}{match[2] or 'networks'}"].append(number)
    counts = {number for number, (name, _) in enumerate(leaves) if name.endswith(".count")}
    return {next((n for n in own if n in counts), own[0]): optimiser for optimiser, own in leaves_of.items()}
