"""Networks as pure functions on plain trees of arrays: `*_init(key, …) -> params`, then `network(params, x)`."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delayrl.core.types import Key

Params = Any
"""A tree (dicts and lists) of arrays."""
LogStdBounds = Literal["rescale", "clip"]


class Gaussian(NamedTuple):
    """A diagonal Gaussian before the tanh that squashes it to actions in [-1, 1]."""

    mean: Float[Array, "*batch action"]
    log_std: Float[Array, "*batch action"]


def linear_init(key: Key, inputs: int, outputs: int, std: float | None = None) -> Params:
    """One layer of `mlp_init`."""
    return mlp_init(key, (inputs, outputs), std)[0]


def linear(params: Params, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    """X W + b. As one product of two matrices, whose gradient is faster than that of a product with more axes.

    Of many rows as two products of half of them: in one for the weights' gradient a second core helps XLA little.
    """
    w, rows = params["w"], x.reshape(-1, x.shape[-1]) if x.ndim > 2 else x
    if x.ndim > 1 and len(rows) >= 4000 and len(rows) % 2 == 0:  # docs/performance.md
        rows, w = rows.reshape(2, -1, rows.shape[1]), jnp.broadcast_to(w, (2, *w.shape))
    return (rows @ w).reshape(*x.shape[:-1], -1) + params["b"]


def mlp_init(key: Key, sizes: tuple[int, ...], std: float | None = None) -> Params:
    """Layers from sizes[0] inputs to sizes[-1] outputs.

    PyTorch's default, weights and biases uniform within 1/√inputs; or weights N(0, std²) and no bias.
    """
    shapes = list(itertools.pairwise(sizes))
    weights = cut(jax.random.normal if std else uniform, key, [*shapes, *[(o,) for _, o in shapes]])
    matrices, biases = weights[: len(shapes)], weights[len(shapes) :]
    if std:
        return [{"w": std * w, "b": jnp.zeros_like(b)} for w, b in zip(matrices, biases, strict=True)]
    return [{"w": w * len(w) ** -0.5, "b": b * len(w) ** -0.5} for w, b in zip(matrices, biases, strict=True)]


def cut(draw: Callable[..., Array], key: Key, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Random arrays of several shapes from one draw, which compiles several times faster than a draw for each."""
    sizes = [math.prod(shape) for shape in shapes]
    pieces = jnp.split(draw(key, (sum(sizes),)), list(itertools.accumulate(sizes))[:-1])
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def uniform(key: Key, shape: tuple[int, ...]) -> Array:
    """Uniform in [-1, 1]."""
    return jax.random.uniform(key, shape, minval=-1, maxval=1)


def mlp(params: Params, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    """ReLU between the layers, none after the last."""
    for layer in params[:-1]:
        x = jax.nn.relu(linear(layer, x))
    return linear(params[-1], x)


def gaussian(
    params: Params,
    x: Float[Array, "*batch inputs"],
    log_std_range: tuple[float, float],
    bounds: LogStdBounds = "rescale",
) -> Gaussian:
    """An `mlp` whose outputs are mean and log-std; the log-std is kept in its range by a rescaled tanh, or clipped."""
    mean, log_std = jnp.split(mlp(params, x), 2, -1)
    low, high = log_std_range
    if bounds == "rescale":
        return Gaussian(mean, low + 0.5 * (high - low) * (jnp.tanh(log_std) + 1))
    return Gaussian(mean, jnp.clip(log_std, low, high))


def mode(policy: Gaussian) -> Float[Array, "*batch action"]:
    """The deterministic action, tanh(mean)."""
    return jnp.tanh(policy.mean)


def sample(policy: Gaussian, key: Key) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch"]]:
    """An action in [-1, 1] and the log of its density there (SAC, Haarnoja et al. 2018, appendix C)."""
    noise = jax.random.normal(key, policy.mean.shape)
    raw = policy.mean + jnp.exp(policy.log_std) * noise
    normal = -0.5 * noise**2 - policy.log_std - 0.5 * jnp.log(2 * jnp.pi)
    slope = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))  # log(1 - tanh²), without its cancellation
    return jnp.tanh(raw), (normal - slope).sum(-1)


def twin_init(key: Key, sizes: tuple[int, ...]) -> Params:
    """Two independent critics."""
    return [mlp_init(k, sizes) for k in jax.random.split(key)]


def twin(
    params: Params, x: Float[Array, "*batch inputs"], action: Float[Array, "*batch action"]
) -> Float[Array, "2 *batch"]:
    """Both values of each (input, action). Two small products are faster on a CPU than one batched one."""
    both = jnp.concatenate([x, action], -1)
    return jnp.stack([mlp(critic, both)[..., 0] for critic in params])


def lower_q(
    critic: Params, x: Float[Array, " input"], one: Float[Array, " action"], other: Float[Array, " action"]
) -> Float[Array, " action"]:
    """Of two actions the one that the lower critic thinks less of: the released behaviour of VDPO and AD-SAC."""
    q_one, q_other = (twin(critic, x, action).min(0) for action in (one, other))
    return jnp.where(q_one < q_other, one, other)
