"""What flows through the program, with the shapes in the annotations.

Axis names: `obs` (S) and `action` (A) are a task's sizes, `delay` is Δ, the longest age, `time` the length of a window
(Δ + 1 + ahead). Leading axes (seeds, a batch) are added by `jax.vmap`; the code is written for one.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Key = PRNGKeyArray
Metrics = dict[str, Float[Array, ""]]
Action = Float[Array, " action"]


@dataclass(frozen=True)
class Spec:
    """What an agent must know of its task: sizes, and the longest age Δ of an observation, in steps."""

    obs_size: int
    action_size: int
    delay: int


class Seen(NamedTuple):
    """What an actor sees: the augmented state x_t, and the true state where the agent is privileged.

    `actions` holds the actions taken since `obs` was made, oldest first, zeros after the first `age`; all actions are
    scaled to [-1, 1]. `truth` is None for whoever may not look: reading it is then an error, not a leak.
    """

    obs: Float[Array, " obs"]
    age: Int[Array, ""]
    actions: Float[Array, "delay action"]
    truth: Float[Array, " obs"] | None = None


class Transition(NamedTuple):
    """One true environment step, as it is stored: from `obs` by `action` to `next_obs`.

    `age` is the age of what the actor saw when it acted, `next_age` of what it saw next; `terminated` ends the
    episode's value, `done` (terminated or truncated) only the episode.
    """

    obs: Float[Array, " obs"]
    age: Int[Array, ""]
    action: Float[Array, " action"]
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    done: Bool[Array, ""]
    next_obs: Float[Array, " obs"]
    next_age: Int[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Window:
    """A stretch of one episode around the step t that is learned from; t stands at index Δ.

    Rows outside the episode, or not arrived yet, are zeros and not `valid`. `lead` counts the valid rows after t.
    `n_step` is the length k ≤ `lead` of this sample's k-step target, drawn from 1..ahead.
    """

    obs: Float[Array, "time obs"]
    age: Int[Array, " time"]
    action: Float[Array, "time action"]
    reward: Float[Array, " time"]
    terminated: Bool[Array, " time"]
    valid: Bool[Array, " time"]
    lead: Int[Array, ""]
    n_step: Int[Array, ""]
    delay: int = field(metadata={"static": True})
