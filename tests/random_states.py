"""States of agents with random weights, made without training."""

from typing import Any

import jax
import numpy as np

from delayrl.agents.base import Agent, template
from delayrl.agents.normalised import Moments, NormalisedObservations
from delayrl.core.types import Spec


def random_state(agent: Agent, spec: Spec, seed: int = 0) -> Any:
    """A state of the agent's form, with weights so large that actions fill their range."""
    random = np.random.default_rng(seed)

    def fill(leaf: Any) -> Any:
        if not np.issubdtype(leaf.dtype, np.floating):
            return np.zeros(leaf.shape, leaf.dtype)
        inputs = leaf.shape[0] if len(leaf.shape) > 1 else 16
        return (1.5 * random.normal(size=leaf.shape) * inputs**-0.5).astype(leaf.dtype)

    state = jax.tree.map(fill, template(agent, spec))
    if isinstance(agent, NormalisedObservations):
        mean, squares = random.normal(size=(2, spec.obs_size)).astype(np.float32)
        state = state._replace(moments=Moments(np.float32(50), mean, 50 * np.abs(squares)))
    return state
