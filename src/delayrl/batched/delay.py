"""The delay of batched environments: what is fixed when a program is compiled, and the numbers that may change."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from delayrl.batched.laws import Law, PerEpisode, Range, axes, batched_law
from delayrl.delays import Channel, DelayLike, Rule, as_delay
from delayrl.delays.laws import whole_steps
from delayrl.delays.text import StepSeconds
from delayrl.errors import DelayRLError

STATIC = {"static": True}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BatchedChannel:
    """A law, and the rule that says which message counts. Only the numbers of the law may change between calls.

    `as_batched` and `per_episode` make it.

    Attributes:
        law: draws travel times; None if every message counts equally late.
        rule: as in `delayrl.delays`; `wait` if every message counts equally late.
        maximum: the longest delay, the size of the rings. Longer travel times are cut to it.
    """

    law: Law | None = None
    rule: Rule = field(default="wait", metadata=STATIC)
    maximum: int = field(default=0, metadata=STATIC)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BatchedDelay:
    """The delays of observations, of actions, and of rewards together with terminations."""

    observation: BatchedChannel = BatchedChannel()
    action: BatchedChannel = BatchedChannel()
    reward: BatchedChannel = BatchedChannel()

    @property
    def maximum(self) -> int:
        """Δ, the longest age: the longest observation delay and the longest action delay."""
        return self.observation.maximum + self.action.maximum

    def axes(self) -> "BatchedDelay":
        """Return `in_axes` of `jax.vmap`: laws whose arrays have a leading axis have one entry per environment."""
        channels = (self.observation, self.action, self.reward)
        return BatchedDelay(*(BatchedChannel(axes(c.law), c.rule, c.maximum) for c in channels))


BatchedLike = DelayLike | BatchedChannel | BatchedDelay
"""What can stand for a delay of batched environments."""


def as_batched(delay: BatchedLike, step_seconds: StepSeconds = None) -> BatchedDelay:
    """Convert what can stand for a delay to a `BatchedDelay`.

    Args:
        delay: steps, a text ("uniform:1:3+action=2"), a law, or a `Delay`; a `BatchedDelay` is returned as it is, and a
            channel, as `per_episode` makes it, is that of the observations.
        step_seconds: the length of an environment step, for texts with times.

    Raises:
        DelayRLError: as `as_delay`; a law of one's own, which only Python can run.
    """
    if isinstance(delay, BatchedDelay):
        return delay
    if isinstance(delay, BatchedChannel):
        return BatchedDelay(delay)
    delay = as_delay(delay, step_seconds)
    return BatchedDelay(_channel(delay.observation), _channel(delay.action), _channel(delay.reward))


def _channel(channel: Channel) -> BatchedChannel:
    if channel.constant:
        return BatchedChannel(maximum=channel.maximum)
    return BatchedChannel(batched_law(channel.law), channel.rule, channel.maximum)


def per_episode(
    low: Int[Array, "*environments"] | Any, high: Int[Array, "*environments"] | Any, maximum: int | None = None
) -> BatchedChannel:
    """Make a channel whose delay is drawn once in each episode, with a range that may differ per environment.

    `episode:LOW:HIGH` is its text where all environments have the same range.

    Args:
        low: the shortest delay of each environment, in steps, [N] or one number.
        high: the longest.
        maximum: the longest delay that any range will have, if ranges change later; None for the largest of `high`.

    Raises:
        DelayRLError: ranges that are no whole steps, the wrong way round or above the maximum; or no maximum although
            the ranges are computed inside a compiled function, where no array can have their size.
    """
    if isinstance(low, jax.core.Tracer) or isinstance(high, jax.core.Tracer):
        if maximum is None:
            raise DelayRLError("a delay whose range is computed in a compiled function has no bound: give maximum=")
        return _ranges(jnp.asarray(low), jnp.asarray(high), whole_steps(maximum))
    try:
        shortest, longest = np.asarray(low), np.asarray(high)
        shape = np.broadcast_shapes(shortest.shape, longest.shape)
    except ValueError:
        shape = (0,)
    if 0 in shape or len(shape) > 1:
        raise DelayRLError(f"low and high are numbers, or lists of one for each environment; got {low} and {high}")
    for steps in {*shortest.ravel().tolist(), *longest.ravel().tolist()}:
        whole_steps(steps)
    if not (shortest <= longest).all():
        raise DelayRLError(f"a range of delays needs low ≤ high; got {shortest.tolist()} and {longest.tolist()}")
    bound = int(longest.max()) if maximum is None else whole_steps(maximum)
    if longest.max() > bound:
        raise DelayRLError(f"a range up to {longest.max()} steps is above its maximum of {bound}")
    return _ranges(jnp.asarray(shortest, jnp.int32), jnp.asarray(longest, jnp.int32), bound)


def _ranges(low: Array, high: Array, maximum: int) -> BatchedChannel:
    return BatchedChannel(PerEpisode(Range(low, high)), "newest", maximum) if maximum else BatchedChannel()
