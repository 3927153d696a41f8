"""Compute a bundle's policy in NumPy, at a low cost per decision.

`fold` rewrites the encoder without changing what it computes. Each step is an identity of linear algebra:

- Three arrays, `obs`, `action` and `position`, replace the embeddings of observation and action, their join and the
  biases.
- There is one attention head, so q·k = (x W_q + b_q)·(x' W_k + b_k) is x M x' + c·x' with M = W_q W_kᵀ/√width, up to
  terms that are the same for all keys and cancel in the softmax. Value and output become one matrix in the same way.
- The layer that follows takes in the scale and shift of the second layer norm of a block, and of the last one.

Of six square products for each token and block, four remain. Only positions 0..age - 1 are computed, and in the last
block only the last of them, because no other is read.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Act, Arrays, Network

Array = NDArray[Any]
"""An array of float32, everywhere in this file but inside `fold`."""
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
    """Return the policy as a function."""
    low, high = np.asarray(network.low, np.float32), np.asarray(network.high, np.float32)
    gain, half = 2 / (high - low), (high - low) / 2
    encoder, head = fold(network, arrays) if network.input == "transformer" else (None, layers(arrays, "head"))
    forecast, norms = layers(arrays, "forecast"), layer_norms(arrays, "forecast")
    current = layers(arrays, "current") or (head if forecast else [])  # at age 0 the observation is the forecast

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
                if forecast:
                    x = obs + _mlp(forecast, x, norms)
        return low + (np.tanh(_mlp(head, x)) + 1) * half

    return act


def layers(arrays: Arrays, name: str) -> list[Layer]:
    """Return the (w, b) of each layer of an MLP; an empty list if there is no such MLP."""
    count = sum(key.startswith(f"{name}.") and key.endswith(".b") for key in arrays)
    return [(arrays[f"{name}.{i}.w"], arrays[f"{name}.{i}.b"]) for i in range(count)]


def layer_norms(arrays: Arrays, name: str) -> list[Layer]:
    """Return the scale and shift of the layer norm of each hidden layer of an MLP that has them."""
    count = sum(key.startswith(f"{name}.") and key.endswith(".norm.scale") for key in arrays)
    return [(arrays[f"{name}.{i}.norm.scale"], arrays[f"{name}.{i}.norm.shift"]) for i in range(count)]


def fold(network: Network, arrays: Arrays) -> tuple[Encoder, list[Layer]]:
    """Return the folded encoder, and the head that follows it. Products are in double precision, rounded once."""
    double = {name: array.astype(np.float64) for name, array in arrays.items()}
    width = network.width

    def layer(w: Any, b: Any) -> Layer:
        return np.ascontiguousarray(w, np.float32), np.ascontiguousarray(b, np.float32)

    def behind(norm: str, w: Any, b: Any) -> Layer:
        """Fold a layer norm's scale and shift into the linear layer that follows it."""
        return layer(double[f"{norm}.scale"][:, None] * w, b + double[f"{norm}.shift"] @ w)

    blocks = []
    for i in range(network.blocks):
        part = {name.removeprefix(f"encoder.blocks.{i}."): a for name, a in double.items()}
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
    of_obs, of_action = np.split(double["encoder.join.w"], 2)
    bias = double["encoder.obs.b"] @ of_obs + double["encoder.action.b"] @ of_action + double["encoder.join.b"]
    obs, position = layer(double["encoder.obs.w"] @ of_obs, double["encoder.position"] + bias)
    action = np.ascontiguousarray(double["encoder.action.w"] @ of_action, np.float32)
    norm_in = layer(double["encoder.norm_in.scale"], double["encoder.norm_in.shift"])
    head = [behind("encoder.norm_out", double["head.0.w"], double["head.0.b"]), *layers(arrays, "head")[1:]]
    return Encoder(obs, action, position, norm_in, blocks), head


def _mlp(layers: list[Layer], x: Array, norms: Sequence[Layer] = ()) -> Array:
    for i, (w, b) in enumerate(layers[:-1]):
        x = x @ w + b
        if norms:
            x = _normalised(x) * norms[i][0] + norms[i][1]
        x = np.maximum(x, 0)
    w, b = layers[-1]
    return x @ w + b


def _encode(encoder: Encoder, obs: Array, actions: Array) -> Array:
    """Return the last token's output, [width], before the scale and shift of the last norm."""
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
    """Normalise to mean 0 and variance 1 along the last axis; ε = 1e-5."""
    x = x - x.mean(-1, keepdims=True)
    variance = np.einsum("...i,...i->...", x, x)[..., None] / np.float32(x.shape[-1])
    x *= 1 / np.sqrt(variance + np.float32(1e-5))
    return x


def _gelu(x: Array) -> Array:
    """Compute the GELU x Φ(x). NumPy has no error function: Abramowitz & Stegun 7.1.26 is exact to 1.5e-7."""
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
