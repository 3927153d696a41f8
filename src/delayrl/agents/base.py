"""What an agent is, and what the loop must know of it. Documentation: there is no behaviour here to inherit."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import optax
from jaxtyping import Array, Int

from delayrl.core.networks import Params
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import Sees

Precision = Literal["float32", "tensorfloat32", "bfloat16"]
PRODUCTS: Mapping[Precision, str] = {
    "float32": "float32",
    "tensorfloat32": "tensorfloat32",
    "bfloat16": "BF16_BF16_F32",  # what JAX calls bfloat16 is that on a TPU, and tensorfloat32 on a GPU
}
"""JAX's words for a precision, for `jax.default_matmul_precision`."""
State = Any
"""An agent's state: a tree of arrays; networks, optimisers, temperatures."""


class Phase(NamedTuple):
    """`updates` gradient updates every `every` environment steps, each on a fresh batch of `batch` windows.

    `update(state, windows, key, count)` is pure; `count` numbers the phase's updates from 0 on.
    """

    every: int
    updates: int
    batch: int
    update: Callable[[State, Window, Key, Int[Array, ""]], tuple[State, Metrics]]


class Deterministic(NamedTuple):
    """What gives an agent's deterministic actions, as plain networks: for whoever runs them without the agent.

    The action is tanh of the first A outputs of `head`, an `mlp`. It reads the observation that is shown, or x_t as
    `network_input` makes it; or, with an `encoder`, what a `transformer` on x_t gives at the shown age. At age 0
    `current`, where there is one, acts instead: an `mlp` on the observation.
    """

    sees: Sees
    head: Params
    encoder: Params | None = None
    current: Params | None = None


@runtime_checkable
class Agent(Protocol):
    """A frozen dataclass of hyperparameters with pure methods, written for one seed."""

    def __hash__(self) -> int:
        """Equal hyperparameters share what is compiled."""

    @property
    def privileged(self) -> bool:
        """Whether its behaviour reads the true current state while it trains."""

    def ahead(self, spec: Spec) -> int:
        """How many steps after t its windows reach."""

    def phases(self) -> tuple[Phase, ...]:
        """What it learns, and when."""

    # An agent whose own schedule must fit the run's also has `check(schedule)`, which raises DelayRLError.

    def init(self, spec: Spec, key: Key) -> State:
        """A fresh state. Raises DelayRLError where the agent does not suit the task."""

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """An action in [-1, 1]; without `explore` deterministic, and `seen.truth` is None."""

    def reference_policy(self, state: State) -> "tuple[Agent, State] | None":
        """The delay-free policy inside it, where there is one: evaluated beside it, without delay."""

    def deterministic(self, state: State) -> Deterministic:
        """The networks that `act` without `explore` consists of. Raises DelayRLError where there are none."""


@dataclass(frozen=True)
class Schedule:
    """How long a run is, and what happens when."""

    steps: Annotated[int, "environment steps to train"] = 1_000_000
    random_steps: Annotated[int, "uniformly random actions, and no updates, for so many steps first"] = 5_000
    replay_capacity: Annotated[int, "rows of the replay: one a step, and one more an episode"] = 1_000_000
    evaluate_every: Annotated[int, "steps between two evaluations (and checkpoints)"] = 10_000
    evaluation_episodes: Annotated[int, "episodes of each evaluation"] = 10
    updates_per_call: Annotated[int, "environment steps between two calls to learn, each with all that is due"] = 1
    precision: Annotated[Precision, "of the products of matrices, where the device has a choice"] = "float32"


def template(agent: Agent, spec: Spec) -> State:
    """Shapes and types of the agent's state, without computing it. Raises what `init` raises."""
    key = jax.eval_shape(lambda: jax.random.key(0))  # a shape too: no device is touched
    return jax.eval_shape(functools.partial(agent.init, spec), key)


def descend(
    optimiser: optax.GradientTransformation,
    loss: Callable[..., Any],
    params: Params,
    opt_state: optax.OptState,
    *args: Any,
) -> tuple[Params, optax.OptState, Any, Any]:
    """One step of gradient descent on `loss(params, *args) -> (value, extra)`.

    Returns:
        The new parameters, the optimiser's new state, the loss and the extra.
    """
    (value, extra), gradient = jax.value_and_grad(loss, has_aux=True)(params, *args)
    change, opt_state = optimiser.update(gradient, opt_state, params)
    return optax.apply_updates(params, change), opt_state, value, extra
