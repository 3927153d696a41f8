"""A bundle's policy in NumPy, arranged so that one decision costs little.

`fold` rewrites the encoder without changing what it computes; each step is an identity of linear algebra:

- The embeddings of observation and action, their join and the biases are three arrays: `obs`, `action`, `position`.
- There is one attention head, so q·k = (x W_q + b_q)·(x' W_k + b_k) is x M x' + c·x', up to terms that are the same for
  all keys and that the softmax does not see: M = W_q W_kᵀ/√width. In the same way value and output are one matrix.
- Scale and shift of the second layer norm of a block, and of the last one, go into the layer that follows.

Four square products for each token and block remain, of six. Only positions 0..age - 1 are computed, and in the last
block only the last of them, since it alone is read.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Act, Arrays, Network

Array = NDArray[Any]
"""Always of float32 here."""
Layer = tuple[Array, Array]


class Block(NamedTuple):
    """One block: x = norm(x); x += softmax(x M xᵀ) x V; x += gelu(normalised(x) W₁) W₂, each with its bias."""

    scale: Array
    shift: Array
    attend: Layer
    value: Layer
    first: Layer
    second: Layer


class Encoder(NamedTuple):
    """The folded transformer: tokens are obs W_o + action W_a + position."""

    obs: Array
    action: Array
    position: Array
    norm_in: Layer
    blocks: list[Block]


def numpy_policy(network: Network, arrays: Arrays) -> Act:
    """A function of (obs [S], actions [Δ, A], age), as `Bundle` has it."""
    low, high = np.asarray(network.low, np.float32), np.asarray(network.high, np.float32)
    gain, half = 2 / (high - low), (high - low) / 2
    current = layers(arrays, "current")
    encoder, head = fold(network, arrays) if network.input == "transformer" else (None, layers(arrays, "head"))

    def act(obs: Array, actions: Array, age: int) -> Array:
        if age == 0 and current:
            return low + (np.tanh(_mlp(current, obs)) + 1) * half
        x = obs
        if network.input != "observation":
            scaled = (actions[:age] - low) * gain - 1
            if encoder is not None:
                x = _encode(encoder, obs, scaled)
            else:
                x = np.zeros(len(obs) + actions.size + 1, np.float32)
                x[: len(obs)] = obs
                x[len(obs) : len(obs) + scaled.size] = scaled.ravel()
                x[-1] = age / network.max_age
        return low + (np.tanh(_mlp(head, x)) + 1) * half

    return act


def layers(arrays: Arrays, name: str) -> list[Layer]:
    """The (w, b) of an MLP; none where there is no such MLP."""
    count = sum(key.startswith(f"{name}.") for key in arrays) // 2
    return [(arrays[f"{name}.{i}.w"], arrays[f"{name}.{i}.b"]) for i in range(count)]


def fold(network: Network, arrays: Arrays) -> tuple[Encoder, list[Layer]]:
    """The encoder as it is computed, and the head behind it. Products are in double precision, rounded once."""
    wide = {name: array.astype(np.float64) for name, array in arrays.items()}
    width = network.width

    def layer(w: Any, b: Any) -> Layer:
        return np.ascontiguousarray(w, np.float32), np.ascontiguousarray(b, np.float32)

    def behind(norm: str, w: Any, b: Any) -> Layer:
        """A linear layer that follows a layer norm, with the norm's scale and shift in it."""
        return layer(wide[f"{norm}.scale"][:, None] * w, b + wide[f"{norm}.shift"] @ w)

    blocks = []
    for i in range(network.blocks):
        part = {name.removeprefix(f"encoder.blocks.{i}."): a for name, a in wide.items()}
        w_query, w_key, w_value = np.split(part["qkv.w"], 3, 1)
        b_query, _, b_value = np.split(part["qkv.b"], 3)
        blocks.append(
            Block(
                *layer(part["norm1.scale"], part["norm1.shift"]),
                layer(w_query @ w_key.T * width**-0.5, b_query @ w_key.T * width**-0.5),
                layer(w_value @ part["out.w"], b_value @ part["out.w"] + part["out.b"]),
                behind(f"encoder.blocks.{i}.norm2", part["mlp.0.w"], part["mlp.0.b"]),
                layer(part["mlp.1.w"], part["mlp.1.b"]),
            )
        )
    of_obs, of_action = np.split(wide["encoder.join.w"], 2)
    bias = wide["encoder.obs.b"] @ of_obs + wide["encoder.action.b"] @ of_action + wide["encoder.join.b"]
    obs, position = layer(wide["encoder.obs.w"] @ of_obs, wide["encoder.position"] + bias)
    action = np.ascontiguousarray(wide["encoder.action.w"] @ of_action, np.float32)
    norm_in = layer(wide["encoder.norm_in.scale"], wide["encoder.norm_in.shift"])
    head = [behind("encoder.norm_out", wide["head.0.w"], wide["head.0.b"]), *layers(arrays, "head")[1:]]
    return Encoder(obs, action, position, norm_in, blocks), head


def _mlp(layers: list[Layer], x: Array) -> Array:
    for w, b in layers[:-1]:
        x = np.maximum(x @ w + b, 0)
    w, b = layers[-1]
    return x @ w + b


def _encode(encoder: Encoder, obs: Array, actions: Array) -> Array:
    """The last token's output before scale and shift of the last norm, [width]."""
    age = len(actions)
    x = actions @ encoder.action
    x += encoder.position[:age]
    x += obs @ encoder.obs
    x = _normalised(x)
    x *= encoder.norm_in[0]
    x += encoder.norm_in[1]
    future = np.triu(np.full((age, age), -np.inf, np.float32), 1)
    last = len(encoder.blocks) - 1
    for i, block in enumerate(encoder.blocks):
        x = _normalised(x)
        x *= block.scale
        x += block.shift
        asking = x if i < last else x[-1:]
        scores = (asking @ block.attend[0] + block.attend[1]) @ x.T
        if i < last:
            scores += future
        scores -= scores.max(-1, keepdims=True)
        np.exp(scores, out=scores)
        scores /= scores.sum(-1, keepdims=True)
        x = asking + (scores @ x) @ block.value[0]
        x += block.value[1]
        hidden = _normalised(x) @ block.first[0]
        hidden += block.first[1]
        x += _gelu(hidden) @ block.second[0]
        x += block.second[1]
    return _normalised(x[-1])


def _normalised(x: Array) -> Array:
    """Mean 0 and variance 1 along the last axis; ε = 1e-5."""
    x = x - x.mean(-1, keepdims=True)
    variance = np.einsum("...i,...i->...", x, x)[..., None] / np.float32(x.shape[-1])
    x *= 1 / np.sqrt(variance + np.float32(1e-5))
    return x


def _gelu(x: Array) -> Array:
    """The GELU x Φ(x). The error function by Abramowitz & Stegun 7.1.26, within 1.5e-7: NumPy has none."""
    half = np.abs(x) * np.float32(0.5**0.5)
    t = 1 / (1 + np.float32(0.3275911) * half)
    tail = t * np.float32(1.061405429)
    for coefficient in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        tail += np.float32(coefficient)
        tail *= t
    half *= half
    tail *= np.exp(-half)
    tail *= np.abs(x)  # x Φ(x) = max(x, 0) - |x| erfc(|x|/√2) / 2
    tail *= np.float32(0.5)
    return np.maximum(x, 0) - tail
