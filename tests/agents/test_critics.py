"""Twin critics, plain and with batch norm, against batch norm written out."""

import jax
import jax.numpy as jnp
import numpy as np

from delayrl.agents.critics import Moments, critics_init, lower_q, q_values
from delayrl.core.networks import linear_init
from delayrl.core.precision import setting

SIZES = (5, 8, 8, 1)


def written_out(critic: dict, x: np.ndarray, moments: list | None = None) -> np.ndarray:
    """Batch norm, linear, ReLU, batch norm, …, with NumPy in float64; by the batch's moments or by others."""
    x = x.astype(np.float64)
    for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
        x = np.maximum(x, 0) if number else x
        mean, variance = map(np.asarray, moments[number]) if moments else (x.mean(0), x.var(0))
        x = (x - mean) / np.sqrt(variance + 1e-3) * np.asarray(norm["scale"]) + np.asarray(norm["shift"])
        x = x @ np.asarray(layer["w"], np.float64) + np.asarray(layer["b"])
    return x[:, 0]


def drawn(seed: int, sizes: tuple[int, ...] = SIZES) -> tuple[list, list]:
    """Critics with norms of any scale and shift, and running moments of any mean and variance."""
    critics, running = critics_init(jax.random.key(seed), sizes, "batch")
    rng = np.random.default_rng(seed)
    for critic in critics:
        critic["norms"] = [
            {"scale": jnp.asarray(1 + rng.normal(size=n), jnp.float32), "shift": jnp.asarray(rng.normal(size=n))}
            for n in sizes[:-1]
        ]
    running = [
        [Moments(jnp.asarray(rng.normal(size=n)), jnp.asarray(rng.uniform(0.2, 3, n))) for n in sizes[:-1]]
        for _ in running
    ]
    return critics, running


def test_values_by_running_moments() -> None:
    """Of a batch, of a batch of batches, and of one sample, each critic by its own."""
    critics, running = drawn(0)
    x = np.random.default_rng(1).normal(3, 2, (32, 5)).astype(np.float32)
    expected = np.stack([written_out(critic, x, own) for critic, own in zip(critics, running, strict=True)])
    for shape in ((32,), (4, 8)):
        batch = jnp.asarray(x.reshape(*shape, 5))
        q = q_values(critics, running, batch[..., :3], batch[..., 3:])
        np.testing.assert_allclose(q, expected.reshape(2, *shape), rtol=1e-4, atol=1e-4)
    one = q_values(critics, running, jnp.asarray(x[7, :3]), jnp.asarray(x[7, 3:]))
    np.testing.assert_allclose(one, expected[:, 7], rtol=1e-4, atol=1e-4)


def test_nearly_constant_inputs_in_bfloat16() -> None:
    """An input that varies by a thousandth of its mean is centred before it is rounded to eight bits."""
    critics, running = drawn(2, (5, 64, 64, 1))
    x = np.random.default_rng(3).normal(size=(64, 5)).astype(np.float32)
    x[:, 0] = 100 + 0.1 * x[:, 0]
    for own in running:
        own[0] = Moments(own[0].mean.at[0].set(100), own[0].variance.at[0].set(0.01))
    expected = np.stack([written_out(critic, x, own) for critic, own in zip(critics, running, strict=True)])
    with jax.default_matmul_precision(setting("bfloat16")):
        q = q_values(critics, running, jnp.asarray(x[:, :3]), jnp.asarray(x[:, 3:]))
    assert np.abs(q - expected).max() < 0.05 * expected.std()


def test_plain_critics_start_as_their_targets() -> None:
    for norm in ("none", "layer"):
        critics, target = critics_init(jax.random.key(0), SIZES, norm)
        for one, other in zip(jax.tree.leaves(critics), jax.tree.leaves(target), strict=True):
            np.testing.assert_array_equal(one, other)


def test_lower_q_by_hand() -> None:
    """(30, -18) at (s, a) = (1, 1) and (-9, 22) at (1, -1): the first has the lower minimum."""
    critic = [[{"w": jnp.array([[s], [a]]), "b": jnp.zeros(1)}] for s, a in ((10.5, 19.5), (2.0, -20.0))]
    s, one, other = jnp.ones(1), jnp.ones(1), -jnp.ones(1)
    np.testing.assert_allclose(q_values(critic, [], s, one), [30.0, -18.0])
    np.testing.assert_allclose(q_values(critic, [], s, other), [-9.0, 22.0])
    assert lower_q(critic, [], s, one, other) == lower_q(critic, [], s, other, one) == 1.0


def test_lower_q_by_running_moments() -> None:
    """Q(s, a) = ±(a - mean) for both critics: which of two actions is lower hangs on their running moments."""
    layer = linear_init(jax.random.key(0), 2, 1) | {"w": jnp.array([[0.0], [1.0]]), "b": jnp.zeros(1)}
    norm = {"scale": jnp.ones(2), "shift": jnp.zeros(2)}
    critics = [
        {"layers": [layer], "norms": [norm]},
        {"layers": [layer | {"w": -layer["w"]}], "norms": [norm]},
    ]
    one, other = jnp.ones(1), -jnp.ones(1)
    for mean, lower in ((0.5, other), (-0.5, one)):  # |a - mean| is larger for it, and one critic has its negative
        running = [[Moments(jnp.array([0.0, mean]), jnp.ones(2))]] * 2
        assert lower_q(critics, running, jnp.ones(1), one, other) == lower
