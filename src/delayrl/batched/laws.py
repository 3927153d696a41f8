"""Laws of travel times as small trees of arrays, and one pure function that draws from them.

The numbers of a law are arrays, so they may change between two calls of a compiled program, and under `jax.vmap` each
environment may have its own. As in `delayrl.delays`, a law's state is one integer, 0 at the start of an episode.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from delayrl import delays
from delayrl.errors import DelayRLError


class Range(NamedTuple):
    """All whole numbers from `low` to `high` are equally likely."""

    low: Int[Array, "*environments"]
    high: Int[Array, "*environments"]


class Chain(NamedTuple):
    """A Markov chain of delays. Independent draws are a chain whose one row serves every state."""

    steps: Int[Array, "*environments states"]
    cumulative: Float[Array, "*environments rows states"]  # row 0 starts an episode, row 1 + i follows state i


class Recording(NamedTuple):
    """Measured delays in order, from a random one on; after the last comes the first."""

    steps: Int[Array, "*environments times"]


class PerEpisode(NamedTuple):
    """Draw once in an episode, and keep it until the end."""

    law: "Range | Chain | Recording | PerEpisode"


Law = Range | Chain | Recording | PerEpisode


def draw(law: Law, state: Int[Array, ""], key: PRNGKeyArray) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Draw the travel time of the next message of one environment, and the state for the one after it."""
    match law:
        case PerEpisode(inner):
            travel = jnp.where(state > 0, state - 1, draw(inner, jnp.zeros_like(state), key)[0])
            return travel, travel + 1
        case Range(low, high):
            return jax.random.randint(key, (), low, high + 1), state
        case Recording(steps):
            index = jnp.where(state > 0, state % len(steps), jax.random.randint(key, (), 0, len(steps)))
            return steps[index], index + 1
        case Chain(steps, cumulative):
            row = cumulative[jnp.minimum(state, len(cumulative) - 1)]
            index = (row <= jax.random.uniform(key)).sum()  # the last entry is 1, above every random number
            return steps[index], index + 1


def batched_law(law: delays.DelayLaw) -> Law:
    """Convert a law of `delayrl.delays`. Raises DelayRLError for a law of one's own, which is Python code."""
    match law:
        case delays.Constant(steps):
            return _chain((steps,), [(1.0,)])
        case delays.Choice(steps, probabilities):
            return _chain(steps, [probabilities])
        case delays.Markov(steps, transitions):
            return _chain(steps, [law.stationary, *transitions])
        case delays.Recorded(steps):
            return Recording(jnp.array(steps, jnp.int32))
        case delays.PerEpisode(inner):
            return PerEpisode(batched_law(inner))
    hint = "draw travel times from it and give delayrl.delays.Recorded(times)"
    raise DelayRLError(f"the law {law} runs in Python, not in a compiled simulator: {hint}")


def _chain(steps: Sequence[int], rows: Sequence[Sequence[float]]) -> Chain:
    cumulative = np.cumsum(rows, axis=1)
    cumulative[:, -1] = 1.0
    return Chain(jnp.array(steps, jnp.int32), jnp.array(cumulative, jnp.float32))


def axes(law: Law | None) -> Any:
    """Return `in_axes` of `jax.vmap` for a law: 0 for arrays with a leading axis for environments, None for others."""
    match law:
        case PerEpisode(inner):
            return PerEpisode(axes(inner))
        case Range(low, high):
            return Range(_axis(low, 0), _axis(high, 0))
        case Recording(steps):
            return Recording(_axis(steps, 1))
        case Chain(steps, cumulative):
            return Chain(_axis(steps, 1), _axis(cumulative, 2))
    return None


def _axis(array: Array, rank: int) -> Any:
    return 0 if jnp.ndim(array) > rank else None
