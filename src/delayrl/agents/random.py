"""The random policy: uniform actions. The lower anchor of normalised returns (VDPO §5: Ret_rand)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from delayrl.agents.base import Agent, Deterministic, Phase
from delayrl.core.types import Action, Key, Seen, Spec
from delayrl.errors import DelayRLError


class State(NamedTuple):
    """Nothing but the size of an action."""

    action_size: Int[Array, " action"]


@dataclass(frozen=True)
class Random:
    """Learns nothing and has no hyperparameters."""

    privileged = False

    def ahead(self, spec: Spec) -> int:
        """It samples nothing."""
        return 1

    def phases(self) -> tuple[Phase, ...]:
        """None."""
        return ()

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """There is none inside."""
        return None

    def init(self, spec: Spec, key: Key) -> State:
        """Remember the action's size."""
        return State(jnp.zeros(spec.action_size, jnp.int32))

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Uniform in [-1, 1], in evaluation too."""
        return jax.random.uniform(key, state.action_size.shape, minval=-1, maxval=1)

    def deterministic(self, state: State) -> Deterministic:
        """There is nothing to export."""
        raise DelayRLError("random draws its actions: it has no deterministic policy to export")
