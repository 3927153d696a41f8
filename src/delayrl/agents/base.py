"""The interface between agents and the training loop. Agents implement the protocol `Agent`; they inherit nothing."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import optax
from jaxtyping import Array, Int

from delayrl.core.networks import Params
from delayrl.core.precision import Precision
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import Sees

ObservationNorm = Literal["none", "running"]
State = Any
"""An agent's state: a pytree of arrays (networks, optimiser states, temperatures)."""


class Phase(NamedTuple):
    """A schedule of gradient updates: `updates` of them every `every` environment steps.

    Each `update(state, windows, key, count)` is pure and gets a fresh batch of `batch` windows. `count` numbers the
    updates as if they had begun at step 0, so that of the first one is not 0; `step_of` gives its environment step.
    """

    every: int
    updates: int
    batch: int
    update: Callable[[State, Window, Key, Int[Array, ""]], tuple[State, Metrics]]

    def step_of(self, count: Int[Array, ""]) -> Int[Array, ""]:
        """Return the environment step of the update with this count."""
        return count // self.updates * self.every


class Deterministic(NamedTuple):
    """An agent's deterministic policy as plain networks, for callers that run it without the agent.

    The action is tanh of the first A outputs of `head`, an `mlp`. Its input is the shown observation, or x_t as
    `network_input` returns it, or, with a `forecast`, the shown observation plus, if it is late, the output of that
    `mlp` on x_t, or, with an `encoder`, the output of that `transformer` on x_t at the shown age. At age 0 `current`,
    an `mlp` on the observation, acts instead if there is one.
    """

    sees: Sees
    head: Params
    encoder: Params | None = None
    current: Params | None = None
    forecast: Params | None = None


@runtime_checkable
class Agent(Protocol):
    """The interface of an agent: a frozen dataclass of hyperparameters with pure methods, written for one seed."""

    def __hash__(self) -> int:
        """Return a hash of the hyperparameters: equal agents share compiled functions."""

    @property
    def privileged(self) -> bool:
        """Whether the behaviour policy reads the true current state in training."""

    def ahead(self, spec: Spec, /) -> int:
        """Return how many steps after t the windows reach."""

    def phases(self) -> tuple[Phase, ...]:
        """Return the agent's updates, each with its schedule."""

    # Optional are `for_run(schedule)`, which returns the agent for a run of a schedule or raises DelayRLError,
    # `reference_policy(state)`, the delay-free agent that this one learns too, and its state, or None, and `every_age`,
    # whether it learns all ages up to the longest, and not only those that the delay shows.

    def init(self, spec: Spec, key: Key, /) -> State:
        """Return a fresh state. Raises DelayRLError if the agent does not support the task."""

    def act(self, state: State, seen: Seen, key: Key, /, *, explore: bool) -> Action:
        """Return an action in [-1, 1]: with `explore` for training, else for evaluation, where `seen.truth` is None."""

    def deterministic(self, state: State, /) -> Deterministic:
        """Return the deterministic policy as networks. Raises DelayRLError if there is none."""


@dataclass(frozen=True)
class Schedule:
    """The length of a run and the timing of what happens in it."""

    steps: Annotated[int, "environment steps to train"] = 1_000_000
    random_steps: Annotated[int, "initial steps with uniformly random actions"] = 5_000
    update_after: Annotated[int, "steps before the first update; 0 for random_steps", (0, math.inf)] = 0
    replay_capacity: Annotated[int, "rows of the replay: one per step, and one more per episode"] = 1_000_000
    evaluate_every: Annotated[int, "steps between evaluations (and checkpoints)"] = 10_000
    evaluation_episodes: Annotated[int, "episodes per evaluation"] = 10
    updates_per_call: Annotated[int, "environment steps between calls to learn, which run all updates due"] = 1
    precision: Annotated[Precision, "precision of matrix products, where the device offers a choice"] = "float32"
    observation_norm: Annotated[ObservationNorm, "running: networks see deviations from a running mean"] = "none"

    @property
    def first_update(self) -> int:
        """The step of the first update."""
        return self.update_after or self.random_steps


def template(agent: Agent, spec: Spec) -> State:
    """Return the shapes and types of the agent's state without computing it. Raises what `init` raises."""
    key = jax.eval_shape(lambda: jax.random.key(0))  # also only a shape: no device is touched
    return jax.eval_shape(functools.partial(agent.init, spec), key)


def reference_of(agent: Agent, state: State) -> tuple[Agent, State] | None:
    """Return the delay-free policy that an agent also learns, if any; it is evaluated without delay."""
    reference_policy = getattr(agent, "reference_policy", None)
    return reference_policy and reference_policy(state)


def descend(
    optimiser: optax.GradientTransformation,
    loss: Callable[..., Any],
    params: Params,
    opt_state: optax.OptState,
    *args: Any,
) -> tuple[Params, optax.OptState, Any, Any]:
    """Descend `loss(params, *args) -> (value, extra)` by one step; return parameters, `opt_state`, value and extra."""
    (value, extra), gradient = jax.value_and_grad(loss, has_aux=True)(params, *args)
    change, opt_state = optimiser.update(gradient, opt_state, params)
    return optax.apply_updates(params, change), opt_state, value, extra
