"""A policy network that reads x_t and a forecast of s_t: an MLP for the change since the observation, one to act."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delayrl.core.networks import Params, mlp, mlp_init
from delayrl.core.types import Key, Spec
from delayrl.core.views import input_size

RATE = 0.01
"""Rate at which the deviations of the changes follow a batch's."""


def forecast_init(key: Key, spec: Spec, hidden: tuple[int, ...], outputs: int) -> Params:
    """Initialise both MLPs with these hidden layers, and the deviations in which the changes are forecast."""
    forecast_key, policy_key = jax.random.split(key)
    size, inputs = spec.obs_size, input_size(spec, "augmented")
    return {
        "forecast": mlp_init(forecast_key, (inputs, *hidden, size)),
        "deviation": jnp.ones(size),
        "policy": mlp_init(policy_key, (size + inputs, *hidden, outputs)),
    }


def forecast(params: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch obs"]:
    """Return the forecast of s_t: the observation in x_t plus its forecast change."""
    change = params["deviation"] * mlp(params["forecast"], x)
    return x[..., : change.shape[-1]] + change


def forecasting(params: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch outputs"]:
    """Apply the policy's MLP to the forecast of s_t, which it cannot change, and x_t."""
    now = forecast(params, x)
    return mlp(params["policy"], jnp.concatenate([jax.lax.stop_gradient(now), x], -1))


def forecast_loss(params: Params, x: Float[Array, "*batch input"], state: Float[Array, "*batch obs"]) -> Array:
    """Return the mean squared error of the change from the observation in x_t to s_t, in deviations."""
    change = _change(x, state) / jax.lax.stop_gradient(params["deviation"])
    return ((mlp(params["forecast"], x) - change) ** 2).mean()


def follow_changes(params: Params, x: Float[Array, "*batch input"], state: Float[Array, "*batch obs"]) -> Params:
    """Return the parameters with deviations that have moved towards the root mean square of a batch's changes."""
    change = _change(x, state).reshape(-1, state.shape[-1])
    square = (1 - RATE) * params["deviation"] ** 2 + RATE * (change**2).mean(0)
    return params | {"deviation": jnp.sqrt(square + 1e-8)}


def _change(x: Array, state: Array) -> Array:
    """Return s_t less the observation in x_t, which comes first in it."""
    return state - x[..., : state.shape[-1]]


def as_mlp(params: Params) -> Params:
    """Return one MLP that is the same function: x passes the forecast's ReLUs as its positive and its negative part."""
    first, *middle, last = params["forecast"]
    entry, *rest = params["policy"]
    inputs, size = len(first["w"]), len(params["deviation"])
    same, nothing = jnp.eye(inputs), jnp.zeros(2 * inputs)
    layers = [{"w": jnp.concatenate([first["w"], same, -same], 1), "b": jnp.concatenate([first["b"], nothing])}]
    for layer in middle:
        w = jax.scipy.linalg.block_diag(layer["w"], jnp.eye(2 * inputs))
        layers.append({"w": w, "b": jnp.concatenate([layer["b"], nothing])})
    on_forecast, on_x = jnp.split(entry["w"], [size])
    on_x = on_x.at[:size].add(on_forecast)  # the forecast is the observation plus its change
    on_change = params["deviation"][:, None] * on_forecast
    w = jnp.concatenate([last["w"] @ on_change, on_x, -on_x])
    return [*layers, {"w": w, "b": last["b"] @ on_change + entry["b"]}, *rest]
