"""The random policy: uniform actions. Its return is the lower anchor of normalised returns (VDPO §4.2.2: Ret_rand)."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from delayrl.agents.base import Deterministic, Phase
from delayrl.core.types import Action, Key, Seen, Spec
from delayrl.errors import DelayRLError


class State(NamedTuple):
    """The state of an agent that learns nothing: only the action size."""

    action_size: Int[Array, " action"]


@dataclass(frozen=True)
class Random:
    """The random agent. It learns nothing and has no hyperparameters."""

    privileged = False

    def ahead(self, spec: Spec) -> int:
        """Return 1; no windows are sampled."""
        return 1

    def phases(self) -> tuple[Phase, ...]:
        """Return no phases: nothing is learned."""
        return ()

    def init(self, spec: Spec, key: Key) -> State:
        """Return a state with the action size."""
        return State(jnp.zeros(spec.action_size, jnp.int32))

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Sample uniformly from [-1, 1], in evaluation too."""
        return jax.random.uniform(key, state.action_size.shape, minval=-1, maxval=1)

    def deterministic(self, state: State) -> Deterministic:
        """Raise DelayRLError: there is no deterministic policy."""
        raise DelayRLError("random draws its actions: it has no deterministic policy to export")
