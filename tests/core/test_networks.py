"""The transformer against an independent NumPy implementation, its causality, and densities against SciPy."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32
from scipy import stats
from scipy.special import erf

from delayrl.core import networks
from delayrl.core.networks import linear
from delayrl.core.transformer import dropout, dropout_masks, threefry, transformer, transformer_init

SIZES = {"obs_size": 5, "action_size": 3, "length": 6, "width": 16, "layers": 3}


plain_transformer = jax.jit(transformer, static_argnums=3)


@functools.cache
def random_params(seed: int = 0) -> networks.Params:
    """All parameters away from their initial values, so that no term hides."""
    params = transformer_init(jax.random.key(seed), **SIZES)
    leaves, form = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(seed + 1), len(leaves))
    return jax.tree.unflatten(
        form, [leaf + 0.3 * jax.random.normal(k, leaf.shape) for leaf, k in zip(leaves, keys, strict=True)]
    )


def numpy_transformer(params: networks.Params, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Token by token, in the words of the released code."""
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params)

    def affine(layer: dict, x: np.ndarray) -> np.ndarray:
        return x @ layer["w"] + layer["b"]

    def normal(layer: dict, x: np.ndarray) -> np.ndarray:
        return (x - x.mean()) / np.sqrt(x.var() + 1e-5) * layer["scale"] + layer["shift"]

    width = SIZES["width"]
    stream = []
    for i, action in enumerate(actions):
        joined = np.concatenate([affine(p["obs"], obs), affine(p["action"], action)])
        stream.append(normal(p["norm_in"], affine(p["join"], joined) + p["position"][i]))
    for block in p["blocks"]:
        stream = [normal(block["norm1"], x) for x in stream]
        q, k, v = ([(affine(block["qkv"], x))[j * width : (j + 1) * width] for x in stream] for j in range(3))
        attended = []
        for i in range(len(stream)):
            scores = np.array([q[i] @ k[j] / np.sqrt(width) for j in range(i + 1)])
            weights = np.exp(scores - scores.max())
            attended.append(sum(w * v[j] for j, w in enumerate(weights / weights.sum())))
        stream = [x + affine(block["out"], a) for x, a in zip(stream, attended, strict=True)]
        hidden = [affine(block["mlp"][0], normal(block["norm2"], x)) for x in stream]
        stream = [
            x + affine(block["mlp"][1], h * 0.5 * (1 + erf(h / np.sqrt(2))))
            for x, h in zip(stream, hidden, strict=True)
        ]
    return np.stack([normal(p["norm_out"], x) for x in stream])


def test_transformer_equals_numpy(rng: np.random.Generator) -> None:
    params = random_params()
    obs, actions = rng.normal(size=(4, 5)), rng.normal(size=(4, 6, 3))
    ours = plain_transformer(params, jnp.asarray(obs), jnp.asarray(actions))
    for i in range(4):
        np.testing.assert_allclose(ours[i], numpy_transformer(params, obs[i], actions[i]), rtol=2e-4, atol=2e-4)


def test_position_sees_only_its_past(rng: np.random.Generator) -> None:
    """Position i depends on every action 0..i and on none after it: padding has no influence."""
    params = random_params()
    obs, actions = jnp.asarray(rng.normal(size=5)), jnp.asarray(rng.normal(size=(6, 3)))
    by_obs, by_actions = jax.jit(jax.jacobian(transformer, (1, 2)))(params, obs, actions)
    depends = np.abs(np.asarray(by_actions)).max((1, 3)) > 1e-6  # [i, width, j, action]
    np.testing.assert_array_equal(depends, np.tril(np.ones((6, 6), bool)))
    assert (np.abs(np.asarray(by_obs)).max((1, 2)) > 1e-6).all()


def test_dropout_is_off_without_key(rng: np.random.Generator) -> None:
    params = random_params()
    obs, actions = jnp.asarray(rng.normal(size=(2, 5))), jnp.asarray(rng.normal(size=(2, 6, 3)))
    plain = plain_transformer(params, obs, actions)
    np.testing.assert_array_equal(plain_transformer(params, obs, actions, 0.5), plain)
    dropped = plain_transformer(params, obs, actions, 0.5, jax.random.key(0))
    assert np.abs(np.asarray(dropped - plain)).max() > 0.1


def test_dropout_is_everywhere(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the embedding, and in each block of attention and of both residuals; each time with a mask of its own."""
    drawn = []

    def noted(kept: Any, rate: float, x: jax.Array) -> jax.Array:
        drawn.append(kept)
        return dropout(kept, rate, x)

    monkeypatch.setattr("delayrl.core.transformer.dropout", noted)
    obs, actions = jnp.asarray(rng.normal(size=(2, 5))), jnp.asarray(rng.normal(size=(2, 6, 3)))
    params = random_params()
    masks = jax.jit(lambda key: (transformer(params, obs, actions, 0.5, key), drawn)[1])(jax.random.key(0))
    stream, square = (2, 6, 16), (2, 6, 6)
    assert [mask.shape for mask in masks] == [stream, *[square, stream, stream] * 3]
    assert len({(mask.shape, np.asarray(mask).tobytes()) for mask in masks}) == 10


@pytest.mark.parametrize("seed", [0, 1, 2**31 + 5])
def test_bits_are_threefry_of_jax(seed: int) -> None:
    key = jax.random.key(seed)
    expected = threefry_2x32(jax.random.key_data(key), jnp.arange(2 * 501, dtype=jnp.uint32))
    np.testing.assert_array_equal(threefry(key, 501).reshape(-1), expected)


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_dropout_keeps_the_mean(rate: float) -> None:
    """In every mask; and two masks of one draw have nothing to do with each other."""
    one, other = dropout_masks(jax.random.key(0), rate, [(1000, 1001), (1001, 1000)])
    for kept in (one, other):
        x = dropout(kept, rate, jnp.ones(kept.shape))
        assert abs(float((x == 0).mean()) - rate) < 0.002
        assert abs(float(x.mean()) - 1) < 0.005
    a, b = np.asarray(one, float).ravel(), np.asarray(other, float).ravel()
    for first, second in [(a, b), (a[1:], a[:-1]), (a[1000:], a[:-1000]), (a[500_500:], a[:500_500])]:
        assert abs(np.corrcoef(first, second)[0, 1]) < 0.005


def test_mlp_by_hand() -> None:
    """relu(1·2 - 1) = 1 and relu(-2 + 1) = 0, so -3·1 + 5·0 + 1 = -2: the output has no activation."""
    layers = [
        {"w": jnp.array([[2.0, -2.0]]), "b": jnp.array([-1.0, 1.0])},
        {"w": jnp.array([[-3.0], [5.0]]), "b": jnp.ones(1)},
    ]
    np.testing.assert_allclose(networks.mlp(layers, jnp.ones(1)), [-2.0])


def test_critics_by_hand() -> None:
    """(30, -18) at (s, a) = (1, 1) and (-9, 22) at (1, -1)."""
    critic = [[{"w": jnp.array([[s], [a]]), "b": jnp.zeros(1)}] for s, a in ((10.5, 19.5), (2.0, -20.0))]
    s, one, other = jnp.ones(1), jnp.ones(1), -jnp.ones(1)
    np.testing.assert_allclose(networks.twin(critic, s, one), [30.0, -18.0])
    np.testing.assert_allclose(networks.twin(critic, s, other), [-9.0, 22.0])
    twins = networks.twin_init(jax.random.key(0), (3, 1))
    assert not np.array_equal(twins[0][0]["w"], twins[1][0]["w"])


@pytest.mark.parametrize("log_std", [-5.0, 0.0, 2.0])
def test_density_of_the_squashed_gaussian(log_std: float) -> None:
    """log π(a) = log N(atanh a) - log(1 - a²), in float64 by SciPy."""
    policy = networks.Gaussian(jnp.array([0.3, -1.0]), jnp.full(2, log_std))
    for seed in range(20):
        action, log_prob = networks.sample(policy, jax.random.key(seed))
        a = np.clip(np.asarray(action, np.float64), -1 + 1e-6, 1 - 1e-6)
        if np.abs(a).max() > 0.999:
            continue
        raw = np.arctanh(a)
        expected = stats.norm.logpdf(raw, policy.mean, np.exp(log_std)) - np.log1p(-(a**2))
        np.testing.assert_allclose(log_prob, expected.sum(), rtol=2e-3, atol=2e-2)


def test_mode_is_squashed() -> None:
    np.testing.assert_allclose(
        networks.mode(networks.Gaussian(jnp.array([0.5, -2.0]), jnp.zeros(2))), np.tanh([0.5, -2])
    )


def test_density_does_not_overflow() -> None:
    policy = networks.Gaussian(jnp.array([30.0]), jnp.array([0.0]))
    assert np.isfinite(networks.sample(policy, jax.random.key(0))[1])


def test_log_std_bounds() -> None:
    params = networks.mlp_init(jax.random.key(0), (3, 8, 4))
    x = 1e3 * jax.random.normal(jax.random.key(1), (100, 3))
    rescaled = networks.gaussian(params, x, (-5.0, 2.0)).log_std
    clipped = networks.gaussian(params, x, (-20.0, 2.0), "clip").log_std
    assert float(rescaled.min()) >= -5
    assert float(rescaled.max()) <= 2
    assert float(clipped.min()) >= -20
    assert float(clipped.max()) <= 2
    middle = networks.gaussian(jax.tree.map(jnp.zeros_like, params), x[:1], (-5.0, 2.0)).log_std
    np.testing.assert_allclose(middle, -1.5)


def test_torch_default_initialisation() -> None:
    layer = networks.linear_init(jax.random.key(0), 400, 300)
    for values in (layer["w"], layer["b"]):
        assert float(jnp.abs(values).max()) <= 1 / 20
        assert abs(float(values.std()) - 1 / 20 / 3**0.5) < 2e-3


def test_initialisation_with_a_given_width() -> None:
    layer = networks.linear_init(jax.random.key(0), 400, 300, 0.02)
    assert abs(float(layer["w"].std()) - 0.02) < 1e-3
    assert not layer["b"].any()


def test_transformer_initialisation() -> None:
    params = transformer_init(jax.random.key(0), 5, 3, 6, 64, 1)
    assert abs(float(params["join"]["w"].std()) - 0.02) < 1e-3
    assert not params["join"]["b"].any()
    assert abs(float(params["blocks"][0]["qkv"]["w"].max()) - (6 / 256) ** 0.5) < 1e-3


@pytest.mark.parametrize("shape", [(6,), (40, 6), (4000, 6), (4001, 6), (1000, 5, 6), (3, 4000, 6)])
def test_gradients_of_a_layer(shape: tuple[int, ...]) -> None:
    """Of few rows and of many, which are two products, alone and for several seeds: those of a plain product."""
    random = np.random.default_rng(0)
    x, w, b = (jnp.asarray(random.normal(size=size), jnp.float32) for size in (shape, (6, 3), 3))

    def gradients(layer: Callable[..., Any]) -> Callable[..., Any]:
        return jax.jit(jax.grad(lambda x, w, b: jnp.sin(layer({"w": w, "b": b}, x)).sum(), (0, 1, 2)))

    halves = math.prod(shape[:-1]) in (4000, 5000, 12000)
    assert ("[2," in str(jax.make_jaxpr(linear)({"w": w, "b": b}, x))) == halves
    expected = gradients(lambda params, x: x @ params["w"] + params["b"])(x, w, b)
    alone = gradients(linear)(x, w, b)
    seeds = jax.jit(jax.vmap(gradients(linear)))(*(jnp.stack([0 * y, y]) for y in (x, w, b)))
    for one, other, several in zip(expected, alone, seeds, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=2e-3)
        np.testing.assert_allclose(one, several[1], rtol=1e-4, atol=2e-3)


@pytest.mark.parametrize("shape", [(7,), (40, 7), (2, 40, 7)])
def test_gradients_of_layer_norm(shape: tuple[int, ...]) -> None:
    """Written out for speed: those that JAX takes of the formula, for inputs far from mean 0, alone and for seeds."""
    random = np.random.default_rng(0)
    x = jnp.asarray(5 + 3 * random.normal(size=shape), jnp.float32)
    scale, shift = (jnp.asarray(random.normal(size=7), jnp.float32) for _ in range(2))

    def formula(params: dict, x: jax.Array) -> jax.Array:
        variance = x.var(-1, keepdims=True)
        return (x - x.mean(-1, keepdims=True)) / jnp.sqrt(variance + 1e-5) * params["scale"] + params["shift"]

    def gradients(norm: Callable[..., Any]) -> Callable[..., Any]:
        return jax.jit(jax.grad(lambda a, b, x: jnp.sin(norm({"scale": a, "shift": b}, x)).sum(), (0, 1, 2)))

    params = {"scale": scale, "shift": shift}
    program = str(jax.make_jaxpr(gradients(networks.layer_norm))(scale, shift, x))
    assert program.count("dot_general[") == program.count("HIGHEST, Precision.HIGHEST") > 0  # or a GPU would round them
    np.testing.assert_allclose(networks.layer_norm(params, x), formula(params, x), rtol=1e-4, atol=1e-5)
    expected = gradients(formula)(scale, shift, x)
    alone = gradients(networks.layer_norm)(scale, shift, x)
    seeds = jax.jit(jax.vmap(gradients(networks.layer_norm)))(*(jnp.stack([0 * y, y]) for y in (scale, shift, x)))
    for one, other, several in zip(expected, alone, seeds, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=2e-5)
        np.testing.assert_allclose(one, several[1], rtol=1e-4, atol=2e-5)


def test_masks_under_another_generator_of_jax() -> None:
    keys = [jax.random.key(seed, impl="rbg") for seed in (0, 1)]
    first, second = (dropout_masks(key, 0.5, [(64, 8)])[0] for key in keys)
    assert 0.3 < float(first.mean()) < 0.7
    assert (first != second).any()
