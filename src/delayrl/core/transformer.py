"""VDPO's causal transformer, as pure functions on pytrees."""

import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from delayrl.core.networks import Params, cut, layer_norm, layer_norm_init, linear, uniform
from delayrl.core.types import Key


def dropout(kept: Bool[Array, "*shape"] | None, rate: float, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Zero the entries that are not kept and scale up the rest. Without a mask, return `x` unchanged."""
    return x if kept is None else jnp.where(kept, x * (1 / (1 - rate)), 0)


def threefry(key: Key, count: int) -> UInt32[Array, "2 count"]:
    """Return the random bits of `jax.random`: Threefry-2x32 with 20 rounds on the counters 0..2·count - 1.

    JAX's implementation runs on one core, as a loop over the rounds that writes all words to memory in each round.
    """
    first, second = jax.random.key_data(key)[:2]
    keys = (first, second, first ^ second ^ jnp.uint32(0x1BD11BDA))
    counter = jnp.arange(count, dtype=jnp.uint32)
    x, y = counter + first, counter + jnp.uint32(count) + second
    for i in range(5):
        for rotation in ((13, 15, 26, 6), (17, 29, 16, 24))[i % 2]:
            x = x + y
            y = x ^ (y << rotation | y >> (32 - rotation))
        x, y = x + keys[(i + 1) % 3], y + keys[(i + 2) % 3] + jnp.uint32(i + 1)
    return jax.lax.optimization_barrier(jnp.stack([x, y]))  # otherwise each layer computes its share twice


def dropout_masks(key: Key, rate: float, shapes: Sequence[tuple[int, ...]]) -> list[Bool[Array, "..."]]:
    """Sample the dropout masks of all layers at once, with 16 random bits per entry and the rate to within 2⁻¹⁷.

    This is four times cheaper than a `jax.random.bernoulli` per layer, which spends 64 bits of Threefry on each entry.
    """
    sizes = [math.prod(shape) for shape in shapes]
    bits = jax.lax.bitcast_convert_type(threefry(key, -(-sum(sizes) // 4)), jnp.uint16).reshape(-1)
    pieces = jnp.split((bits >= round(rate * 2**16))[: sum(sizes)], list(itertools.accumulate(sizes))[:-1])
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def transformer_init(key: Key, obs_size: int, action_size: int, length: int, width: int, layers: int) -> Params:
    """Initialise as in VDPO's code: weights N(0, 0.02²), biases 0, layer norms 1 and 0; q, k, v Xavier-uniform."""
    normal_key, uniform_key = jax.random.split(key)
    square = (width, width)
    shapes = [(obs_size, width), (action_size, width), (2 * width, width), (length, width), *[square] * (3 * layers)]
    of_obs, of_action, join, position, *rest = (0.02 * w for w in cut(jax.random.normal, normal_key, shapes))
    xavier = cut(uniform, uniform_key, [(width, 3 * width)] * layers)

    def biased(w: Array) -> Params:
        return {"w": w, "b": jnp.zeros(w.shape[1])}

    blocks = [
        {
            "norm1": layer_norm_init(width),
            "qkv": biased((6 / (4 * width)) ** 0.5 * qkv),
            "out": biased(out),
            "norm2": layer_norm_init(width),
            "mlp": [biased(first), biased(second)],
        }
        for qkv, out, first, second in zip(xavier, rest[::3], rest[1::3], rest[2::3], strict=True)
    ]
    return {
        "obs": biased(of_obs),
        "action": biased(of_action),
        "join": biased(join),
        "position": position,
        "norm_in": layer_norm_init(width),
        "blocks": blocks,
        "norm_out": layer_norm_init(width),
    }


def transformer(
    params: Params,
    obs: Float[Array, "*batch obs"],
    actions: Float[Array, "*batch length action"],
    rate: float = 0.0,
    key: Key | None = None,
) -> Float[Array, "*batch length width"]:
    """Apply VDPO's causal transformer (§3.3): token i joins the last observation with the i-th action since.

    Position i depends only on `obs` and actions 0..i. It serves the delay i + 1, and padding at the end does not affect
    it. One head; layer norm after the embedding; each block replaces its stream by its first layer norm.

    Args:
        params: from `transformer_init`.
        obs: the last observation that has arrived.
        actions: the actions taken since, oldest first.
        rate: dropout rate of embedding, attention and residuals.
        key: random key for dropout; None disables it.
    """
    length, width = params["position"].shape
    stream, square = (*obs.shape[:-1], length, width), (*obs.shape[:-1], length, length)
    shapes = [stream, *[square, stream, stream] * len(params["blocks"])]
    masks = iter(dropout_masks(key, rate, shapes) if key is not None and rate > 0 else [None] * len(shapes))
    # split join([e_obs, e_action]) into two products: the observation's half is the same for every token
    w_obs, w_action = jnp.split(params["join"]["w"], 2)
    from_obs = linear(params["obs"], obs) @ w_obs
    from_actions = linear({"w": w_action, "b": params["join"]["b"]}, linear(params["action"], actions))
    x = from_obs[..., None, :] + from_actions + params["position"]
    x = dropout(next(masks), rate, layer_norm(params["norm_in"], x))
    causal = jnp.tril(jnp.ones((length, length), bool))
    for block in params["blocks"]:
        x = layer_norm(block["norm1"], x)
        query, keyed, value = jnp.split(linear(block["qkv"], x), 3, -1)
        scores = jnp.einsum("...td,...sd->...ts", query, keyed) * width**-0.5
        attention = dropout(next(masks), rate, jax.nn.softmax(jnp.where(causal, scores, -jnp.inf)))
        x = x + dropout(next(masks), rate, linear(block["out"], jnp.einsum("...ts,...sd->...td", attention, value)))
        hidden = jax.nn.gelu(linear(block["mlp"][0], layer_norm(block["norm2"], x)), approximate=False)
        x = x + dropout(next(masks), rate, linear(block["mlp"][1], hidden))
    return layer_norm(params["norm_out"], x)
