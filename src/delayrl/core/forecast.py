"""A policy network that reads a forecast of s_t: an MLP on x_t for the change since the observation, and one to act."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delayrl.core.networks import Params, mlp, mlp_init
from delayrl.core.types import Key, Spec
from delayrl.core.views import input_size

Error = Literal["squared", "distance"]
RATE = 0.01
"""Rate at which the deviations of the changes follow a batch's."""
LEAST_DEVIATION = 1e-2
"""So that an entry that hardly changes is not blown up."""
ROUNDING = 1e-2
"""Radius, in deviations, within which a distance is nearly a square, so that it has a gradient at 0."""


def forecast_init(key: Key, spec: Spec, hidden: tuple[int, ...], outputs: int) -> Params:
    """Initialise both MLPs with these hidden layers, and the deviations in which the changes are forecast."""
    forecast_key, policy_key = jax.random.split(key)
    size, inputs = spec.obs_size, input_size(spec, "augmented")
    return {
        "forecast": mlp_init(forecast_key, (inputs, *hidden, size), norm="layer"),
        "deviation": jnp.ones(size),
        "policy": mlp_init(policy_key, (size, *hidden, outputs)),
    }


def forecast(params: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch obs"]:
    """Return the forecast of s_t: the observation in x_t plus its forecast change, which is 0 at age 0."""
    change = jax.lax.stop_gradient(params["deviation"]) * mlp(params["forecast"], x)
    return x[..., : change.shape[-1]] + jnp.where(_late(x), change, 0)


def forecasting(params: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch outputs"]:
    """Apply the policy's MLP to the forecast of s_t."""
    return mlp(params["policy"], forecast(params, x))


def held(params: Params) -> Params:
    """Return the parameters with a forecast that no gradient moves."""
    return params | {"forecast": jax.lax.stop_gradient(params["forecast"])}


def forecast_loss(
    params: Params, x: Float[Array, "*batch input"], state: Float[Array, "*batch obs"], error: Error = "squared"
) -> Array:
    """Return the mean error of the change from the observation in x_t to s_t, in deviations.

    The error of a sample is the mean of its entries' squared errors, or the root of that, which is a distance.
    """
    change = _change(x, state) / jax.lax.stop_gradient(params["deviation"])
    squares = (jnp.where(_late(x), mlp(params["forecast"], x) - change, 0) ** 2).mean(-1)
    return (squares if error == "squared" else jnp.sqrt(squares + ROUNDING**2) - ROUNDING).mean()


def follow_changes(params: Params, x: Float[Array, "*batch input"], state: Float[Array, "*batch obs"]) -> Params:
    """Return the parameters with deviations that have moved towards the root mean square of a batch's changes.

    A sample of age 0 counts as one without change.
    """
    change = _change(x, state).reshape(-1, state.shape[-1])
    square = (1 - RATE) * params["deviation"] ** 2 + RATE * (change**2).mean(0)
    return params | {"deviation": jnp.maximum(jnp.sqrt(square), LEAST_DEVIATION)}


def _late(x: Array) -> Array:
    """Tell whether the age, which comes last in x_t, is above 0."""
    return x[..., -1:] > 0


def _change(x: Array, state: Array) -> Array:
    """Return s_t less the observation in x_t, which comes first in it."""
    return state - x[..., : state.shape[-1]]


def in_task_units(params: Params) -> Params:
    """Return the MLP of the change with its deviations in the last layer."""
    *layers, last = params["forecast"]
    return [*layers, {name: part * params["deviation"] for name, part in last.items()}]
