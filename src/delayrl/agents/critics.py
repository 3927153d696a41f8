"""Twin critics of SAC: with target critics, or with batch norm and none (CrossQ: Bhatt et al., ICLR 2024).

Batch norm stands before every layer. Where critics learn, they are normalised by the batch's own moments. Where only
values are wanted, it is by running moments: these are fixed, so a norm is a part of the layer after it.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from delayrl.agents.base import State, descend
from delayrl.core import networks
from delayrl.core.networks import Params
from delayrl.core.objectives import k_step_target, soft_value, squared_errors
from delayrl.core.types import Key, Metrics, Window

CriticNorm = Literal["none", "layer", "batch"]
EPSILON, MOMENTUM = 1e-3, 0.99
"""Added to the variance; rate at which running moments stay as they are. CrossQ's."""


class Moments(NamedTuple):
    """Mean and variance of each unit over a batch."""

    mean: Float[Array, " width"]
    variance: Float[Array, " width"]


def critics_init(key: Key, sizes: tuple[int, ...], norm: CriticNorm) -> tuple[Params, Params]:
    """Initialise two critics and their target critics, copies; or for batch norm their running moments."""
    if norm != "batch":
        critics = networks.twin_init(key, sizes, norm)
        return critics, jax.tree.map(jnp.copy, critics)
    critics = [
        {"layers": layers, "norms": [networks.layer_norm_init(size) for size in sizes[:-1]]}
        for layers in networks.twin_init(key, sizes)
    ]
    return critics, [[Moments(jnp.zeros(size), jnp.ones(size)) for size in sizes[:-1]] for _ in critics]


def learn_in_one_pass(
    state: State,
    windows: Window,
    critic_input: Float[Array, "batch input"],
    later: Float[Array, "batch inputs"],
    log_prob: Float[Array, " batch"],
    learning_rate: float,
    discount: float,
) -> tuple[State, Metrics]:
    """Update a SAC's critics that have batch norm, then their running moments.

    One pass over (s_t, a_t) and `later`, (s_{t+k}, a'), gives values and targets, both normalised by the moments of
    their mixture. So there are no target critics.
    """
    pairs = jnp.concatenate([jnp.concatenate([critic_input, windows.action[:, windows.delay]], -1), later])
    temperature = jnp.exp(state.log_temperature)

    def loss(critics: Params) -> tuple[Array, tuple[Array, Params]]:
        values, moments = in_training(critics, pairs)
        q, next_q = jnp.split(values, 2, -1)
        y = k_step_target(windows, discount, soft_value(next_q, log_prob, temperature))
        return squared_errors(q, y), (q.mean(), moments)

    critic, opt_state, value, (q, moments) = descend(
        optax.adam(learning_rate), loss, state.critic, state.critic_opt_state
    )
    running = optax.incremental_update(moments, state.target, 1 - MOMENTUM)
    return state._replace(critic=critic, critic_opt_state=opt_state, target=running), {"critic_loss": value, "q": q}


def in_training(critics: Params, x: Float[Array, "batch inputs"]) -> tuple[Float[Array, "2 batch"], Params]:
    """Return both critics' values of a batch that is normalised by its own moments, and these."""
    values, moments = zip(*(_in_training(critic, x) for critic in critics), strict=True)
    return jnp.stack(values), list(moments)


def _in_training(critic: Params, x: Float[Array, "batch inputs"]) -> tuple[Float[Array, " batch"], list[Moments]]:
    moments = []
    for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
        x = jax.nn.relu(x) if number else x
        moments.append(Moments(x.mean(0), x.var(0)))
        normal = (x - moments[-1].mean) * jax.lax.rsqrt(moments[-1].variance + EPSILON)
        x = networks.linear(layer, normal * norm["scale"] + norm["shift"])
    return x[:, 0], moments


def plain(critics: Params, target: Params) -> Params:
    """Return critics that `networks.twin` takes: those with batch norm have the running moments in their layers."""
    pairs = zip(critics, target, strict=True)
    return [_folded(*pair) if isinstance(pair[0], dict) else pair[0] for pair in pairs]


def _folded(critic: Params, running: list[Moments]) -> Params:
    layers = []
    for layer, norm, moments in zip(critic["layers"], critic["norms"], running, strict=True):
        scale = norm["scale"] * jax.lax.rsqrt(moments.variance + EPSILON)
        shift = norm["shift"] - moments.mean * scale
        layers.append({"w": scale[:, None] * layer["w"], "b": layer["b"] + shift @ layer["w"]})
    return layers


def lower_q(
    critics: Params, x: Float[Array, " input"], one: Float[Array, " action"], other: Float[Array, " action"]
) -> Float[Array, " action"]:
    """Return the action with the lower min_i Q_i: the behaviour in the released code of VDPO and AD-SAC."""
    q_one, q_other = (networks.twin(critics, x, action).min(0) for action in (one, other))
    return jnp.where(q_one < q_other, one, other)
