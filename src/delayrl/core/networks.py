"""Networks as pure functions on pytrees: `*_init(key, …)` returns the `params` that `network(params, x)` takes."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delayrl.core.precision import product
from delayrl.core.types import Key

Params = Any
"""A pytree (dicts and lists) of arrays."""
Network = Callable[[Params, Array], Array]
"""A function from parameters and inputs to outputs, as `mlp`."""
LogStdBounds = Literal["rescale", "clip"]
Norm = Literal["none", "layer"]


class Gaussian(NamedTuple):
    """A diagonal Gaussian over actions, before the tanh that squashes them to [-1, 1]."""

    mean: Float[Array, "*batch action"]
    log_std: Float[Array, "*batch action"]


def linear_init(key: Key, inputs: int, outputs: int, std: float | None = None) -> Params:
    """Initialise one layer as `mlp_init` does."""
    return mlp_init(key, (inputs, outputs), std)[0]


def linear(params: Params, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    """Return X W + b. All leading axes are flattened into one, which makes the gradient faster.

    Large batches are split into two products: XLA barely uses a second core for the weight gradient of a single one.
    """
    w, rows = params["w"], x.reshape(-1, x.shape[-1]) if x.ndim > 2 else x
    if x.ndim > 1 and len(rows) >= 4000 and len(rows) % 2 == 0:  # see docs/performance.md
        rows, w = rows.reshape(2, -1, rows.shape[1]), jnp.broadcast_to(w, (2, *w.shape))
    return product(rows, w).reshape(*x.shape[:-1], -1) + params["b"]


def layer_norm_init(width: int) -> Params:
    """Return a scale of 1 and a shift of 0."""
    return {"scale": jnp.ones(width), "shift": jnp.zeros(width)}


def layer_norm(params: Params, x: Float[Array, "*batch width"]) -> Float[Array, "*batch width"]:
    """Normalise the last axis (ε = 1e-5), then scale and shift it. Has no forward-mode derivative."""
    return _layer_norm(params["scale"], params["shift"], x)


def _layer_norm_forward(scale: Array, shift: Array, x: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    centred = x - _mean(x)
    rate = jax.lax.rsqrt(_mean(centred**2) + 1e-5)
    return centred * rate * scale + shift, (centred * rate, rate, scale)


def _layer_norm_slopes(kept: tuple[Array, Array, Array], slope: Array) -> tuple[Array, Array, Array]:
    normal, rate, scale = kept
    rows, inner = tuple(range(slope.ndim - 1)), slope * scale
    x_slope = rate * (inner - _mean(inner) - normal * _mean(inner * normal))
    return (slope * normal).sum(rows), slope.sum(rows), x_slope


_layer_norm = jax.custom_vjp(lambda scale, shift, x: _layer_norm_forward(scale, shift, x)[0])
_layer_norm.defvjp(_layer_norm_forward, _layer_norm_slopes)  # faster on CPUs than JAX's own gradient


def _mean(x: Float[Array, "*batch width"]) -> Float[Array, "*batch 1"]:
    """Return the mean of the last axis. XLA's CPU compiler sums rows one number at a time, but not in a product."""
    return jnp.matmul(x, jnp.full((x.shape[-1], 1), 1 / x.shape[-1]), precision="highest")


def mlp_init(key: Key, sizes: tuple[int, ...], std: float | None = None, norm: Norm = "none") -> Params:
    """Initialise linear layers from sizes[0] inputs to sizes[-1] outputs; with a norm after each but the last.

    Weights and biases are uniform within 1/√inputs (PyTorch's default); with `std`, weights are N(0, std²), biases 0.
    """
    shapes = list(itertools.pairwise(sizes))
    weights = cut(jax.random.normal if std else uniform, key, [*shapes, *[(o,) for _, o in shapes]])
    matrices, biases = weights[: len(shapes)], weights[len(shapes) :]
    if std:
        return [{"w": std * w, "b": jnp.zeros_like(b)} for w, b in zip(matrices, biases, strict=True)]
    layers = [{"w": w * len(w) ** -0.5, "b": b * len(w) ** -0.5} for w, b in zip(matrices, biases, strict=True)]
    if norm == "layer":
        layers[:-1] = [layer | {"norm": layer_norm_init(len(layer["b"]))} for layer in layers[:-1]]
    return layers


def cut(sampler: Callable[..., Array], key: Key, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Sample arrays of several shapes in one call, which compiles several times faster than a call for each."""
    sizes = [math.prod(shape) for shape in shapes]
    pieces = jnp.split(sampler(key, (sum(sizes),)), list(itertools.accumulate(sizes))[:-1])
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def uniform(key: Key, shape: tuple[int, ...]) -> Array:
    """Sample uniformly from [-1, 1]."""
    return jax.random.uniform(key, shape, minval=-1, maxval=1)


def mlp(params: Params, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    """Apply the layers in order, with a ReLU after each but the last, and before it the layer's norm, if it has one."""
    for layer in params[:-1]:
        x = linear(layer, x)
        x = jax.nn.relu(layer_norm(layer["norm"], x) if "norm" in layer else x)
    return linear(params[-1], x)


def gaussian(
    params: Params,
    x: Float[Array, "*batch inputs"],
    log_std_range: tuple[float, float],
    bounds: LogStdBounds = "rescale",
    network: Network = mlp,
) -> Gaussian:
    """Return the Gaussian that `network` outputs; a rescaled tanh or clipping bounds its log-std."""
    mean, log_std = jnp.split(network(params, x), 2, -1)
    low, high = log_std_range
    if bounds == "rescale":
        return Gaussian(mean, low + 0.5 * (high - low) * (jnp.tanh(log_std) + 1))
    return Gaussian(mean, jnp.clip(log_std, low, high))


def mode(policy: Gaussian) -> Float[Array, "*batch action"]:
    """Return the deterministic action, tanh(mean)."""
    return jnp.tanh(policy.mean)


def sample(policy: Gaussian, key: Key) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch"]]:
    """Sample an action in [-1, 1] and return it with its log-density (SAC, Haarnoja et al. 2018, appendix C)."""
    noise = jax.random.normal(key, policy.mean.shape)
    raw = policy.mean + jnp.exp(policy.log_std) * noise
    normal = -0.5 * noise**2 - policy.log_std - 0.5 * jnp.log(2 * jnp.pi)
    slope = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))  # log(1 - tanh²), without cancellation
    return jnp.tanh(raw), (normal - slope).sum(-1)


def twin_init(key: Key, sizes: tuple[int, ...], norm: Norm = "none") -> Params:
    """Initialise two independent critics."""
    return [mlp_init(k, sizes, norm=norm) for k in jax.random.split(key)]


def twin(
    params: Params, x: Float[Array, "*batch inputs"], action: Float[Array, "*batch action"]
) -> Float[Array, "2 *batch"]:
    """Return both critics' Q-values. Two small products are faster on a CPU than one batched product."""
    both = jnp.concatenate([x, action], -1)
    return jnp.stack([mlp(critic, both)[..., 0] for critic in params])
