"""Data types of training, with shapes in the annotations.

Axes: `obs` (S) and `action` (A) are the task's sizes, `delay` is Δ, the longest age, and `time` is the length of a
window (Δ + 1 + ahead). `jax.vmap` adds the leading axes (seeds, a batch); the code is written for one.
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
    """The task as an agent needs it: its sizes, the longest age Δ of an observation in steps, the actions' range."""

    obs_size: int
    action_size: int
    delay: int
    log_scale: float = 0.0  # Σ log of the half ranges of the task's actions: see `Window`


class Seen(NamedTuple):
    """The augmented state x_t that an actor sees, with the true state if the agent is privileged.

    `actions` holds the actions taken since `obs` was made, oldest first, and zeros after the first `age`. All actions
    are scaled to [-1, 1]. `truth` is None if the actor may not see it, so that reading it is an error and not a leak.
    """

    obs: Float[Array, " obs"]
    age: Int[Array, ""]
    actions: Float[Array, "delay action"]
    truth: Float[Array, " obs"] | None = None


class Transition(NamedTuple):
    """One undelayed environment step, as stored: `action` leads from `obs` to `next_obs`.

    `age` is the age of the observation on which the actor acted, `next_age` that of the next one it saw. `terminated`
    means that no value follows; `done` (terminated or truncated) means only that the episode ends.
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
    """A stretch of one episode around the sampled step t, which is at index Δ.

    Rows that lie outside the episode, or have not arrived yet, are zero and not `valid`. `lead` counts the valid rows
    after t. `n_step` is the length k of this sample's k-step target, drawn from 1..ahead and limited to `lead`.
    A log-density over the scaled actions, less `log_scale`, is one over actions in the task's units.
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
    log_scale: float = field(default=0.0, metadata={"static": True})
