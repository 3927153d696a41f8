"""Networks as pure functions on plain trees of arrays: `*_init(key, …) -> params`, then `network(params, x)`."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delayrl.types import Key

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
    """X W + b."""
    return x @ params["w"] + params["b"]


def mlp_init(key: Key, sizes: tuple[int, ...], std: float | None = None) -> Params:
    """Layers from sizes[0] inputs to sizes[-1] outputs.

    PyTorch's default, weights and biases uniform within 1/√inputs; or weights N(0, std²) and no bias.
    """
    shapes = list(itertools.pairwise(sizes))
    weights = cut(jax.random.normal if std else _uniform, key, [*shapes, *[(o,) for _, o in shapes]])
    matrices, biases = weights[: len(shapes)], weights[len(shapes) :]
    if std:
        return [{"w": std * w, "b": jnp.zeros_like(b)} for w, b in zip(matrices, biases, strict=True)]
    return [{"w": w * len(w) ** -0.5, "b": b * len(w) ** -0.5} for w, b in zip(matrices, biases, strict=True)]


def cut(draw: Callable[..., Array], key: Key, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Random arrays of several shapes from one draw, which compiles several times faster than a draw for each."""
    sizes = [math.prod(shape) for shape in shapes]
    pieces = jnp.split(draw(key, (sum(sizes),)), list(itertools.accumulate(sizes))[:-1])
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def _uniform(key: Key, shape: tuple[int, ...]) -> Array:
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


def layer_norm(params: Params, x: Float[Array, "*batch width"]) -> Float[Array, "*batch width"]:
    """Normalise the last axis; ε = 1e-5."""
    centred = x - x.mean(-1, keepdims=True)
    return centred * jax.lax.rsqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * params["scale"] + params["shift"]


def dropout(key: Key | None, rate: float, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Zero a share `rate` of the entries and scale up the rest; without a key, nothing."""
    if key is None or rate == 0:
        return x
    return jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0)


def transformer_init(key: Key, obs_size: int, action_size: int, length: int, width: int, layers: int) -> Params:
    """Weights N(0, 0.02²), biases 0, layer norms 1 and 0; q, k, v Xavier-uniform: as the released code of VDPO."""
    normal_key, uniform_key = jax.random.split(key)
    square = (width, width)
    shapes = [(obs_size, width), (action_size, width), (2 * width, width), (length, width), *[square] * (3 * layers)]
    of_obs, of_action, join, position, *rest = (0.02 * w for w in cut(jax.random.normal, normal_key, shapes))
    xavier = cut(_uniform, uniform_key, [(width, 3 * width)] * layers)

    def biased(w: Array) -> Params:
        return {"w": w, "b": jnp.zeros(w.shape[1])}

    def normed() -> Params:
        return {"scale": jnp.ones(width), "shift": jnp.zeros(width)}

    blocks = [
        {
            "norm1": normed(),
            "qkv": biased((6 / (4 * width)) ** 0.5 * qkv),
            "out": biased(out),
            "norm2": normed(),
            "mlp": [biased(first), biased(second)],
        }
        for qkv, out, first, second in zip(xavier, rest[::3], rest[1::3], rest[2::3], strict=True)
    ]
    return {
        "obs": biased(of_obs),
        "action": biased(of_action),
        "join": biased(join),
        "position": position,
        "norm_in": normed(),
        "blocks": blocks,
        "norm_out": normed(),
    }


def transformer(
    params: Params,
    obs: Float[Array, "*batch obs"],
    actions: Float[Array, "*batch length action"],
    rate: float = 0.0,
    key: Key | None = None,
) -> Float[Array, "*batch length width"]:
    """Causal transformer of VDPO (§3.3): token i joins the last observation with the i-th action since.

    Position i depends on `obs` and actions 0..i only: it serves the delay i + 1, and padding at the end has no
    influence before it. One head; post-embedding layer norm; each block overwrites its stream by its first layer norm.

    Args:
        params: of `transformer_init`.
        obs: the last observation that has arrived.
        actions: the actions taken since, oldest first.
        rate: dropout rate, in embedding, attention and residuals alike.
        key: for dropout; None switches it off.
    """
    length, width = params["position"].shape
    keys = iter(
        [None] * (1 + 3 * len(params["blocks"]))
        if key is None
        else jax.random.split(key, 1 + 3 * len(params["blocks"]))
    )
    # join([e_obs, e_action]) as two products: the observation's half is the same for every token
    w_obs, w_action = jnp.split(params["join"]["w"], 2)
    from_obs = linear(params["obs"], obs) @ w_obs + params["join"]["b"]
    x = from_obs[..., None, :] + linear(params["action"], actions) @ w_action + params["position"]
    x = dropout(next(keys), rate, layer_norm(params["norm_in"], x))
    causal = jnp.tril(jnp.ones((length, length), bool))
    for block in params["blocks"]:
        x = layer_norm(block["norm1"], x)
        query, keyed, value = jnp.split(linear(block["qkv"], x), 3, -1)
        scores = jnp.einsum("...td,...sd->...ts", query, keyed) * width**-0.5
        attention = dropout(next(keys), rate, jax.nn.softmax(jnp.where(causal, scores, -jnp.inf)))
        x = x + dropout(next(keys), rate, linear(block["out"], jnp.einsum("...ts,...sd->...td", attention, value)))
        hidden = jax.nn.gelu(linear(block["mlp"][0], layer_norm(block["norm2"], x)), approximate=False)
        x = x + dropout(next(keys), rate, linear(block["mlp"][1], hidden))
    return layer_norm(params["norm_out"], x)
