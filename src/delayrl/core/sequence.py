"""A policy network that reads x_t as a sequence: VDPO's transformer, a head on its output, and an MLP for age 0."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from delayrl.core.networks import Params, mlp, mlp_init
from delayrl.core.transformer import transformer, transformer_init
from delayrl.core.types import Key, Spec


def sequence_init(key: Key, spec: Spec, width: int, layers: int, hidden: tuple[int, ...], outputs: int) -> Params:
    """Initialise the encoder as VDPO's, the head on it and the MLP `current`, both with these hidden layers."""
    encoder_key, head_key, current_key = jax.random.split(key, 3)
    return {
        "encoder": transformer_init(encoder_key, spec.obs_size, spec.action_size, spec.delay, width, layers),
        "head": mlp_init(head_key, (width, *hidden, outputs)),
        "current": mlp_init(current_key, (spec.obs_size, *hidden, outputs)),
    }


def sequence(params: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch outputs"]:
    """Apply the head to what the encoder says at the age of x_t, or at age 0 `current` to the observation."""
    obs, _, age = _parts(params, x)
    row = jnp.maximum(age - 1, 0)[..., None, None]  # token i serves the age i + 1
    at_age = jnp.take_along_axis(tokens(params, x), row, -2)[..., 0, :]
    return jnp.where(age[..., None] > 0, mlp(params["head"], at_age), mlp(params["current"], obs))


def tokens(params: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch delay width"]:
    """Return the encoder's output at each age 1..Δ."""
    obs, actions, _ = _parts(params, x)
    return transformer(params["encoder"], obs, actions)


def _parts(
    params: Params, x: Float[Array, "*batch input"]
) -> tuple[Float[Array, "*batch obs"], Float[Array, "*batch delay action"], Int[Array, "*batch"]]:
    """Return observation, actions and age of x_t (`network_input`); the encoder's shapes tell their sizes."""
    delay, size = len(params["encoder"]["position"]), len(params["encoder"]["action"]["w"])
    obs, actions, age = jnp.split(x, [x.shape[-1] - delay * size - 1, x.shape[-1] - 1], -1)
    return obs, actions.reshape(*x.shape[:-1], delay, size), jnp.rint(age[..., 0] * delay).astype(jnp.int32)
