"""SAC's twin critics: with target critics, or with batch norm and none (CrossQ: Bhatt et al., ICLR 2024).

Batch norm stands before every layer. Where critics learn, the moments of the batch normalise it; where only values are
wanted, running moments do, which follow those of batches.
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
EPSILON = 1e-3
"""What is added to a variance (CrossQ's)."""
MOMENTUM = 0.99
"""What running moments keep of themselves at each update (CrossQ's)."""


class Moments(NamedTuple):
    """Mean and variance of each unit over a batch."""

    mean: Float[Array, " width"]
    variance: Float[Array, " width"]


def critics_init(key: Key, sizes: tuple[int, ...], norm: CriticNorm) -> tuple[Params, Params]:
    """Initialise two critics, and their target critics as copies or, with batch norm, their running moments."""
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
    critic_now: Float[Array, "batch input"],
    critic_next: Float[Array, "batch input"],
    next_action: Float[Array, "batch action"],
    log_prob: Float[Array, " batch"],
    *,
    learning_rate: float,
    discount: float,
) -> tuple[State, Metrics]:
    """Update the critics of a SAC that have batch norm, then their running moments.

    One pass over (s_t, a_t) and (s_{t+k}, a') gives values and targets, both normalised by the moments of their
    mixture. So there are no target critics.
    """
    actions = jnp.concatenate([windows.action[:, windows.delay], next_action])
    pairs = jnp.concatenate([jnp.concatenate([critic_now, critic_next]), actions], -1)
    temperature = jnp.exp(state.log_temperature)

    def loss(critics: Params) -> tuple[Array, tuple[Array, Params]]:
        values, moments = zip(*(_pass(critic, pairs) for critic in critics), strict=True)
        q, next_q = jnp.split(jnp.stack(values), 2, -1)
        y = k_step_target(windows, discount, soft_value(next_q, log_prob, temperature))
        return squared_errors(q, y), (q.mean(), list(moments))

    adam = optax.adam(learning_rate)
    critic, opt_state, value, (q, moments) = descend(adam, loss, state.critic, state.critic_opt_state)
    running = optax.incremental_update(moments, state.target, 1 - MOMENTUM)
    return state._replace(critic=critic, critic_opt_state=opt_state, target=running), {"critic_loss": value, "q": q}


def q_values(
    critics: Params, running: Params, x: Float[Array, "*batch inputs"], action: Float[Array, "*batch action"]
) -> Float[Array, "2 *batch"]:
    """Return both critics' values. Only critics with batch norm read their running moments."""
    if not isinstance(critics[0], dict):
        return networks.twin(critics, x, action)
    pairs = jnp.concatenate([x, action], -1)
    return jnp.stack([_pass(critic, pairs, own)[0] for critic, own in zip(critics, running, strict=True)])


def _pass(
    critic: Params, x: Float[Array, "*batch inputs"], running: list[Moments] | None = None
) -> tuple[Float[Array, "*batch"], list[Moments]]:
    """Return a critic's values, normalised by running moments or else by the batch's own, and the moments."""
    used = []
    for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
        x = jax.nn.relu(x) if number else x
        moments = running[number] if running else Moments(x.mean(0), x.var(0))
        normal = (x - moments.mean) * jax.lax.rsqrt(moments.variance + EPSILON)
        x = networks.linear(layer, normal * norm["scale"] + norm["shift"])
        used.append(moments)
    return x[..., 0], used


def lower_q(
    critics: Params,
    running: Params,
    x: Float[Array, " input"],
    one: Float[Array, " action"],
    other: Float[Array, " action"],
) -> Float[Array, " action"]:
    """Return the action with the lower min_i Q_i: the behaviour in the released code of VDPO and AD-SAC."""
    q_one, q_other = (q_values(critics, running, x, action).min(0) for action in (one, other))
    return jnp.where(q_one < q_other, one, other)
