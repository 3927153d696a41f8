"""Replay buffer: one ring of the undelayed trajectory on the device, for any delay.

A row holds an observation and the step taken from it; an episode of T steps takes T + 1 rows, the last for its final
observation. Each observation is stored once (Humanoid, a million rows: 1.6 GB). Augmented states, belief targets and
k-step returns are gathered by index when they are sampled. The functions handle one seed; `jax.vmap` adds the axis.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from delayrl.core.types import Key, Spec, Transition, Window


class Replay(NamedTuple):
    """The ring. Row r of the trajectory, counted from the start of the run, lies at index r mod capacity."""

    obs: Float[Array, "capacity obs"]
    action: Float[Array, "capacity action"]
    reward: Float[Array, " capacity"]
    age: Int[Array, " capacity"]
    terminated: Bool[Array, " capacity"]
    moment: Int[Array, " capacity"]  # steps since the start of the row's episode
    row_of: Int[Array, " capacity"]  # j-th step that can be sampled (mod capacity) -> its row
    rows: Int[Array, ""]  # rows completed so far, so the row of the current observation
    steps: Int[Array, ""]  # how many these are so far, overwritten ones included
    lost: Int[Array, ""]  # how many of them the ring has overwritten


def init(spec: Spec, capacity: int) -> Replay:
    """Return an empty ring of `capacity` rows of 4 (S + A) + 17 bytes each."""
    count = jnp.zeros((), jnp.int32)
    return Replay(
        obs=jnp.zeros((capacity, spec.obs_size)),
        action=jnp.zeros((capacity, spec.action_size)),
        reward=jnp.zeros(capacity),
        age=jnp.zeros(capacity, jnp.int32),
        terminated=jnp.zeros(capacity, jnp.bool_),
        moment=jnp.zeros(capacity, jnp.int32),
        row_of=jnp.zeros(capacity, jnp.int32),
        rows=count,
        steps=count,
        lost=count,
    )


class Learnable(NamedTuple):
    """Which steps of an episode can be sampled: all by default. All steps are stored."""

    first: int = 0  # those before this one cannot
    until_end: int = 1  # nor can those from which on the episode has fewer steps, which released code never stores
    time_limit: bool = True  # nor, if false, the step that a time limit ends


ALL = Learnable()


def current_moment(replay: Replay) -> Int[Array, ""]:
    """Return how many steps the current episode has."""
    return replay.moment[replay.rows % replay.moment.shape[0]]


def drawable(replay: Replay, hidden: Int[Array, ""] | int, learnable: Learnable = ALL) -> Int[Array, ""]:
    """Return the number of the first step that cannot be sampled yet, because it is among the `hidden` newest."""
    return replay.steps - jnp.clip(current_moment(replay) - learnable.first - learnable.until_end + 1, 0, hidden)


def append(
    replay: Replay, step: Transition, learnable: Learnable = ALL, moment: Int[Array, ""] | None = None
) -> Replay:
    """Store one step in its row, and the next observation in the next row, which the following step completes.

    `moment` is the `current_moment`, where a program of its own has read it.
    """
    capacity = replay.obs.shape[0]
    here, after = replay.rows % capacity, (replay.rows + 1) % capacity
    rows = replay.rows + 1 + step.done.astype(jnp.int32)  # a finished episode keeps the row of its last observation
    if moment is None:
        moment = jax.lax.optimization_barrier(current_moment(replay))  # read before the write, or XLA copies the array
    moment += 1
    row_of = replay.row_of.at[replay.steps % capacity].set(replay.rows - (learnable.until_end - 1))
    counts = moment >= learnable.first + learnable.until_end
    if not learnable.time_limit:
        counts &= step.terminated | ~step.done
    steps, lost = replay.steps + counts, replay.lost
    for _ in range(2):  # a step overwrites at most two rows
        lost += ((lost < steps) & (row_of[lost % capacity] <= rows - capacity)).astype(jnp.int32)
    return Replay(
        obs=replay.obs.at[here].set(step.obs).at[after].set(step.next_obs),
        action=replay.action.at[here].set(step.action),
        reward=replay.reward.at[here].set(step.reward),
        age=replay.age.at[here].set(step.age).at[after].set(step.next_age),
        terminated=replay.terminated.at[here].set(step.terminated),
        moment=replay.moment.at[after].set(moment).at[rows % capacity].set(jnp.where(step.done, 0, moment)),
        row_of=row_of,
        rows=rows,
        steps=steps,
        lost=lost,
    )


def sample(
    replay: Replay, key: Key, batch: int, delay: int, ahead: int, hidden: Int[Array, ""], learnable: Learnable = ALL
) -> Window:
    """Sample windows [batch] around uniformly drawn steps. No window crosses the boundary of an episode.

    Args:
        replay: a ring with at least one step whose outcome has arrived.
        key: random key.
        batch: number of windows.
        delay: Δ, the number of rows before the step.
        ahead: number of rows after the step, which is the longest k of a k-step target.
        hidden: number of newest observations that have not arrived yet: the learner's age, 0 if it may see them all.
        learnable: as for `append`.
    """
    capacity = replay.obs.shape[0]
    pick, length = jax.random.split(key)
    # the oldest steps of a full ring are not drawn: the Δ rows before them may be overwritten
    first = jnp.where(replay.rows >= capacity, replay.lost + delay, 0)
    last = drawable(replay, hidden, learnable)
    step = jax.random.randint(pick, (batch, 1), jnp.minimum(first, last - 1), last)
    row = replay.row_of[step % capacity]
    # between two episodes the current row is still empty
    newest = replay.rows - (replay.moment[replay.rows % capacity] == 0).astype(jnp.int32) - hidden

    offset = jnp.arange(-delay, ahead + 1)
    index = (row + offset) % capacity
    moment = replay.moment[row % capacity] + offset
    # rows of another episode do not continue the count of moments
    valid = (moment >= 0) & (replay.moment[index] == moment) & (row + offset <= newest)
    lead = (valid & (offset > 0)).sum(1)
    acted = valid & (offset < lead[:, None])  # the last row has no action, or not yet
    drawn = jax.random.randint(length, (batch,), 1, max(ahead, 1) + 1)
    return Window(
        obs=jnp.where(valid[..., None], replay.obs[index], 0),
        age=jnp.where(valid, replay.age[index], 0),
        action=jnp.where(acted[..., None], replay.action[index], 0),
        reward=jnp.where(acted, replay.reward[index], 0),
        terminated=acted & replay.terminated[index],
        valid=valid,
        lead=lead,
        n_step=jnp.minimum(drawn, lead),
        delay=delay,
    )
