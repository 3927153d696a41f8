"""Episodes under a delay, with travel times drawn from its laws: what a simulator's loop calls.

For each step: `act`, the simulator's own step with the action that applies, `arrive`; and `restart` where the episode
has ended. The functions serve one environment. `jax.vmap` adds the axis, with `delay.axes()` for the delay.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from delayrl.batched.delay import BatchedChannel, BatchedDelay
from delayrl.batched.laws import PerEpisode, draw
from delayrl.batched.transit import Shown, Transit, begin, issue, receive, renew, show


class LawStates(NamedTuple):
    """What each channel's law remembers from message to message."""

    observation: Int[Array, ""]
    action: Int[Array, ""]
    reward: Int[Array, ""]


class Episode(NamedTuple):
    """One environment's messages, the states of its laws, and the key of its next random numbers."""

    transit: Transit
    laws: LawStates
    key: PRNGKeyArray


def start(
    delay: BatchedDelay, key: PRNGKeyArray, obs: Float[Array, " obs"], idle: Float[Array, " action"]
) -> tuple[Episode, Shown]:
    """Start an episode.

    Args:
        delay: from `as_batched`; its numbers may be arguments of a compiled function.
        key: of the travel times of this and all later episodes.
        obs: the true s_0.
        idle: the action in force before the first one has arrived.

    Returns:
        The episode, and what the agent sees: s_0 at once.
    """
    key, now = jax.random.split(key)
    zero, channel = jnp.zeros((), jnp.int32), delay.action
    lag, state = jnp.array(channel.maximum, jnp.int32), zero
    if isinstance(channel.law, PerEpisode):  # one delay for the episode, which the age counts
        lag, state = _draw(channel, zero, now)
    transit = begin(delay, obs, idle, lag)
    no = jnp.zeros((), bool)
    return Episode(transit, LawStates(zero, state, zero), key), show(delay, transit, jnp.zeros(()), no, no)


def act(
    delay: BatchedDelay, episode: Episode, action: Float[Array, " action"]
) -> tuple[Episode, Float[Array, " action"]]:
    """Issue an action. Returns the one that acts now, which the simulator takes."""
    key, now = jax.random.split(episode.key)
    travel, state = _draw(delay.action, episode.laws.action, now)
    transit, acting = issue(delay, episode.transit, action, travel)
    return Episode(transit, episode.laws._replace(action=state), key), acting


def arrive(
    delay: BatchedDelay,
    episode: Episode,
    obs: Float[Array, " obs"],
    reward: Float[Array, ""],
    terminated: Bool[Array, ""],
    truncated: Bool[Array, ""],
) -> tuple[Episode, Shown]:
    """Take in the outcome of the simulator's step, and return what the agent sees.

    While a termination is on its way (`episode.transit.over`), only `truncated` counts. The simulator must not start
    its next episode before the agent is told, so an environment that resets itself takes no delay of the rewards.
    """
    key, first, second = jax.random.split(episode.key, 3)
    travel, of_observation = _draw(delay.observation, episode.laws.observation, first)
    reward_travel, of_reward = _draw(delay.reward, episode.laws.reward, second)
    laws = episode.laws._replace(observation=of_observation, reward=of_reward)
    transit, shown = receive(delay, episode.transit, obs, reward, terminated, truncated, travel, reward_travel)
    return Episode(transit, laws, key), shown


def restart(
    delay: BatchedDelay, episode: Episode, shown: Shown, done: Bool[Array, ""], obs: Float[Array, " obs"]
) -> tuple[Episode, Shown]:
    """Start the next episode where this one is done; elsewhere return both as they are.

    Args:
        delay: as for `start`.
        episode: from `arrive`.
        shown: from `arrive`. Its reward and its ends stay, as in Gymnasium's autoreset mode "same step".
        done: whether the agent has been told of the end.
        obs: s_0 of the next episode; not read elsewhere.
    """
    fresh, _ = start(delay, episode.key, obs, episode.transit.idle)
    transit = renew(episode.transit, fresh.transit, done)
    laws, key = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh[1:], episode[1:])
    return Episode(transit, laws, key), show(delay, transit, shown.reward, shown.terminated, shown.truncated)


def _draw(channel: BatchedChannel, state: Int[Array, ""], key: PRNGKeyArray) -> tuple[Int[Array, ""], Int[Array, ""]]:
    if channel.law is None:
        return jnp.array(channel.maximum, jnp.int32), state
    travel, state = draw(channel.law, state, key)
    # numbers that have changed since may be larger than the rings
    return jnp.clip(travel, 0, channel.maximum).astype(jnp.int32), state.astype(jnp.int32)
