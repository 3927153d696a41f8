"""Any agent on normalised observations: a running mean and deviation of the states that it has learned from.

`NormalisedObservations(agent)` is an agent too. It shows the inner one windows and observations of mean 0 and deviation
1, and keeps the moments in its own state, so that they are stored, resumed and batched over seeds like all else. They
come from the sampled states s_t, which have all arrived. The replay holds the task's own numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from delayrl.agents.base import Agent, Deterministic, Phase, reference_of
from delayrl.agents.base import State as AgentState
from delayrl.core.networks import Params
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window

LEAST_DEVIATION = 0.01  # so that an entry that hardly changes is not blown up


class Moments(NamedTuple):
    """How many states were seen, and for each entry their mean and their sum of squared differences from it."""

    number: Float[Array, ""]
    mean: Float[Array, " obs"]
    squares: Float[Array, " obs"]


class State(NamedTuple):
    """The inner agent's state, and the moments."""

    agent: AgentState
    moments: Moments


@dataclass(frozen=True)
class NormalisedObservations:
    """An agent that normalises what another sees."""

    agent: Agent

    @property
    def privileged(self) -> bool:
        """As the inner agent."""
        return self.agent.privileged

    @property
    def every_age(self) -> bool:
        """As the inner agent."""
        return getattr(self.agent, "every_age", False)

    def ahead(self, spec: Spec) -> int:
        """Return the inner agent's reach."""
        return self.agent.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return the inner agent's phases on normalised windows. The first one's batches are the moments' data."""
        return tuple(
            phase._replace(update=self._update(phase, gather=number == 0))
            for number, phase in enumerate(self.agent.phases())
        )

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise the inner agent, and moments of nothing."""
        size = (spec.obs_size,)
        return State(self.agent.init(spec, key), Moments(jnp.zeros(()), jnp.zeros(size), jnp.zeros(size)))

    def usual(self, state: State) -> tuple[Float[Array, " obs"], Float[Array, " obs"]]:
        """Return mean and deviation of the states that it has learned from."""
        return state.moments.mean, _deviation(state.moments)

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Let the inner agent act on the normalised observation (and truth)."""
        truth = None if seen.truth is None else normalise(state.moments, seen.truth)
        seen = seen._replace(obs=normalise(state.moments, seen.obs), truth=truth)
        return self.agent.act(state.agent, seen, key, explore=explore)

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """Return the inner agent's delay-free policy, if it has one, on normalised observations."""
        inner = reference_of(self.agent, state.agent)
        return inner and (NormalisedObservations(inner[0]), State(inner[1], state.moments))

    def deterministic(self, state: State) -> Deterministic:
        """Return the inner agent's networks with mean and deviation folded into their layers."""
        networks, moments = self.agent.deterministic(state.agent), state.moments
        current = None if networks.current is None else _folded(networks.current, moments)
        if networks.encoder is None:
            networks = networks._replace(head=_folded(networks.head, moments), current=current)
            if networks.forecast is None:
                return networks
            *layers, last = _folded(networks.forecast, moments)
            unscaled = {name: part * _deviation(moments) for name, part in last.items()}  # changes in the task's units
            return networks._replace(forecast=[*layers, unscaled])
        encoder = networks.encoder | {"obs": _folded([networks.encoder["obs"]], moments)[0]}
        return networks._replace(encoder=encoder, current=current)

    def _update(self, phase: Phase, gather: bool) -> Callable[..., tuple[State, Metrics]]:
        def update(state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
            moments = state.moments
            if gather:
                moments = merged(moments, windows.obs[:, windows.delay])
            obs = jnp.where(windows.valid[..., None], normalise(moments, windows.obs), 0)
            agent, metrics = phase.update(state.agent, replace(windows, obs=obs), key, count)
            return State(agent, moments), metrics

        return update


def merged(moments: Moments, states: Float[Array, "batch obs"]) -> Moments:
    """Return the moments with a batch added (Chan, Golub and LeVeque 1983)."""
    size, mean = len(states), states.mean(0)
    number, apart = moments.number + size, mean - moments.mean
    squares = ((states - mean) ** 2).sum(0) + apart**2 * moments.number * size / number
    return Moments(number, moments.mean + apart * size / number, moments.squares + squares)


def normalise(moments: Moments, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch obs"]:
    """Return observations in deviations from the mean; as they are where nothing has been learned from yet."""
    return (obs - moments.mean) / _deviation(moments)


def _deviation(moments: Moments) -> Float[Array, " obs"]:
    known = jnp.sqrt(moments.squares / jnp.maximum(moments.number, 1))
    return jnp.where(moments.number > 0, jnp.maximum(known, LEAST_DEVIATION), 1.0)


def _folded(layers: Params, moments: Moments) -> Params:
    """Return an `mlp` that takes observations as they are: the first rows of its first layer read them."""
    first, *rest = layers
    rows = first["w"][: len(moments.mean)] / _deviation(moments)[:, None]
    weights = jnp.concatenate([rows, first["w"][len(moments.mean) :]])
    return [first | {"w": weights, "b": first["b"] - moments.mean @ rows}, *rest]
