"""One episode under a delay as pure functions on arrays: `wrappers/transit.py` for compiled simulators.

The functions serve one environment; `jax.vmap` adds the axis. They take travel times as arguments and draw nothing;
those of channels with the rule `wait` are not read.
All shapes follow from the longest delays. At step t the agent has issued u_0 .. u_{t-1}; s_0 counts as arrived at once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from delayrl.batched.delay import BatchedChannel, BatchedDelay


class Queue(NamedTuple):
    """Messages 0, 1, … on one channel."""

    due: Int[Array, " slots"]  # by time of arrival, modulo: the message
    newest: Int[Array, ""]  # the message that counts; -1 before any has arrived
    latest: Int[Array, ""]  # when the last message arrives


class Transit(NamedTuple):
    """The delayed side of one environment, with Δ = `delay.maximum`."""

    time: Int[Array, ""]  # steps since the start of the episode
    lag: Int[Array, ""]  # the longest delay of the actions in this episode
    over: Bool[Array, ""]  # whether the episode has ended, but the agent has not been told
    end: Int[Array, ""]  # when the agent will be told
    observation: Queue
    action: Queue
    observations: Float[Array, "slots obs"]  # the true ones, by step, modulo
    applied: Int[Array, " slots"]  # the age of the action that led to each
    idle: Float[Array, " action"]  # in force before the first action has arrived
    actions: Float[Array, "rows action"]  # as issued, by step, modulo
    action_age: Int[Array, ""]  # of the action that acts now
    rewards: Float[Array, " reward_slots"]  # by time of arrival, modulo: the sum
    latest_reward: Int[Array, ""]  # when the last one arrives


class Shown(NamedTuple):
    """What the agent gets: the fields of `Delayed`'s observation and `info`, under the same names."""

    obs: Float[Array, " obs"]
    age: Int[Array, ""]
    actions: Float[Array, "delta action"]
    mask: Bool[Array, " delta"]
    truth: Float[Array, " obs"]
    observation_age: Int[Array, ""]
    applied: Int[Array, ""]
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]


def begin(
    delay: BatchedDelay, obs: Float[Array, " obs"], idle: Float[Array, " action"], lag: Int[Array, ""]
) -> Transit:
    """Start an episode.

    Args:
        delay: which delay, of the shapes and rules.
        obs: s_0.
        idle: the action in force before the first one has arrived.
        lag: the delay of the actions in this episode if it stays the same, else the longest.
    """
    zero = jnp.zeros((), jnp.int32)
    slots = delay.observation.maximum + 1
    return Transit(
        time=zero,
        lag=jnp.asarray(lag, jnp.int32),
        over=jnp.zeros((), bool),
        end=zero,
        observation=_empty(delay.observation, 0),
        action=_empty(delay.action, -1),
        observations=jnp.zeros((slots, len(obs)), obs.dtype).at[0].set(obs),
        applied=jnp.zeros(slots, jnp.int32),
        idle=idle,
        actions=jnp.zeros((max(delay.maximum, 1), len(idle)), idle.dtype),
        action_age=zero,
        rewards=jnp.zeros(delay.reward.maximum + 1),
        latest_reward=zero,
    )


def renew(transit: Transit, fresh: Transit, done: Bool[Array, ""]) -> Transit:
    """Return `fresh`, whose episode has just begun, where this one is done; elsewhere `transit`.

    Of the large rings only the row of s_0 is written, because no row of an earlier episode is read.
    """
    chosen = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, transit)
    first = jnp.where(done, fresh.observations[0], transit.observations[0])
    return chosen._replace(observations=transit.observations.at[0].set(first), actions=transit.actions)


def issue(
    delay: BatchedDelay, transit: Transit, action: Float[Array, " action"], travel: Int[Array, ""]
) -> tuple[Transit, Float[Array, " action"]]:
    """Issue an action. Returns the one that acts now."""
    now, acting = transit.time, action
    if delay.action.maximum:
        queue = _send(delay.action, transit.action, now, travel)
        age = jnp.minimum(now - queue.newest, delay.action.maximum)
        acting = jnp.where(age > 0, _issued(transit, now - age), action)
        transit = transit._replace(action=queue, action_age=age)
    return transit._replace(actions=transit.actions.at[now % len(transit.actions)].set(action)), acting


def receive(
    delay: BatchedDelay,
    transit: Transit,
    obs: Float[Array, " obs"],
    reward: Float[Array, ""],
    terminated: Bool[Array, ""],
    truncated: Bool[Array, ""],
    travel: Int[Array, ""],
    reward_travel: Int[Array, ""],
) -> tuple[Transit, Shown]:
    """Take in the outcome of a step, and return what has arrived. Once the episode is over, only `truncated` counts."""
    slots = delay.observation.maximum + 1
    obs = jnp.where(transit.over, truth(transit), obs)
    time = transit.time + 1
    queue = _send(delay.observation, transit.observation, time, travel)
    transit = transit._replace(
        time=time,
        observation=queue._replace(newest=jnp.maximum(queue.newest, 0)),
        observations=transit.observations.at[time % slots].set(obs),
        applied=transit.applied.at[time % slots].set(transit.action_age),
    )
    if delay.reward.maximum:
        transit, reward, terminated = _late(delay.reward, transit, reward, terminated, truncated, reward_travel)
    return transit, show(delay, transit, reward, terminated, truncated)


def truth(transit: Transit) -> Float[Array, " obs"]:
    """Return the true current observation."""
    return transit.observations[transit.time % len(transit.observations)]


def show(
    delay: BatchedDelay,
    transit: Transit,
    reward: Float[Array, ""],
    terminated: Bool[Array, ""],
    truncated: Bool[Array, ""],
) -> Shown:
    """Return what the agent sees now."""
    made, slots = transit.observation.newest, jnp.arange(delay.maximum)
    age = transit.time - made + transit.lag
    mask = slots < age
    actions = _issued(transit, transit.time - age + slots)
    place = made % len(transit.observations)
    return Shown(
        obs=transit.observations[place],
        age=age,
        actions=jnp.where(mask[:, None], actions, 0.0),
        mask=mask,
        truth=truth(transit),
        observation_age=transit.time - made,
        applied=transit.applied[place],
        reward=reward,
        terminated=terminated,
        truncated=truncated,
    )


def augmented(delay: BatchedDelay, shown: Shown) -> Float[Array, " input"]:
    """Return observation, actions and age / Δ as one vector, number for number that of `AugmentedObservation`.

    A random delay of the actions adds the age of the action that led to the observation, divided by the longest delay.
    """
    if not delay.maximum:
        return shown.obs
    parts = [shown.obs, shown.actions.reshape(-1), _share(shown.age, delay.maximum)]
    if delay.action.rule != "wait":
        parts.append(_share(shown.applied, delay.action.maximum))
    return jnp.concatenate(parts)


def _share(age: Int[Array, ""], longest: int) -> Float[Array, "1"]:
    """Return an age divided by the longest, from a table: a compiled division differs from NumPy's in the last bit."""
    return jnp.asarray(np.arange(longest + 1) / longest, jnp.float32)[age][None]


def _issued(transit: Transit, step: Int[Array, "*steps"]) -> Float[Array, "*steps action"]:
    """Return the actions of these steps; the idle one of steps before the start."""
    return jnp.where((step < 0)[..., None], transit.idle, transit.actions[step % len(transit.actions)])


def _empty(channel: BatchedChannel, newest: int) -> Queue:
    slots = channel.maximum + 1 if channel.rule in ("newest", "fifo") else 0
    number = jnp.array(newest, jnp.int32)
    return Queue(jnp.full(slots, -1, jnp.int32), number, jnp.zeros((), jnp.int32))


def _send(channel: BatchedChannel, queue: Queue, number: Int[Array, ""], travel: Int[Array, ""]) -> Queue:
    """Send message `number` at time `number`, and look what has arrived by then."""
    if channel.rule == "wait":
        return queue._replace(newest=jnp.maximum(number - channel.maximum, queue.newest))
    if channel.rule == "raw":
        return queue._replace(newest=jnp.maximum(number - travel, -1))
    arrival, slots = number + travel, len(queue.due)
    if channel.rule == "fifo":
        arrival = jnp.maximum(arrival, queue.latest)
    due = queue.due.at[arrival % slots].set(number)
    return Queue(due, jnp.maximum(queue.newest, due[number % slots]), arrival)


def _late(
    channel: BatchedChannel,
    transit: Transit,
    reward: Float[Array, ""],
    terminated: Bool[Array, ""],
    truncated: Bool[Array, ""],
    travel: Int[Array, ""],
) -> tuple[Transit, Float[Array, ""], Bool[Array, ""]]:
    """Send a reward, unless the episode is over. Returns the reward and the termination that arrive now."""
    now, slots, sent = transit.time, channel.maximum + 1, ~transit.over
    arrival = now + (channel.maximum if channel.rule == "wait" else travel)
    if channel.rule == "fifo":
        arrival = jnp.maximum(arrival, transit.latest_reward)
    rewards = transit.rewards.at[arrival % slots].add(jnp.where(sent, reward, 0.0))
    end = jnp.where(sent & terminated, arrival, transit.end)
    over = transit.over | terminated
    # the learner knows of a time limit at once, so it ends the waiting
    terminated = over & (truncated | (end == now))
    done = terminated | truncated
    reward = jnp.where(done, rewards.sum(), rewards[now % slots])
    rewards = jnp.where(done, 0.0, rewards.at[now % slots].set(0.0))
    latest = jnp.where(sent, arrival, transit.latest_reward)
    return transit._replace(over=over, end=end, rewards=rewards, latest_reward=latest), reward, terminated
