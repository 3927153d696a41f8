"""Critics with batch norm, against batch norm written out."""

import jax
import jax.numpy as jnp
import numpy as np

from delayrl.agents.critics import critics_init, in_training, plain
from delayrl.core import networks


def written_out(critic: dict, x: np.ndarray) -> np.ndarray:
    """Batch norm, linear, ReLU, batch norm, …, with NumPy."""
    for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
        x = np.maximum(x, 0) if number else x
        x = (x - x.mean(0)) / np.sqrt(x.var(0) + 1e-3) * np.asarray(norm["scale"]) + np.asarray(norm["shift"])
        x = x @ np.asarray(layer["w"]) + np.asarray(layer["b"])
    return x[:, 0]


def drawn(seed: int) -> tuple[list, np.ndarray]:
    """Critics with norms of any scale and shift, and a batch far from mean 0 and deviation 1."""
    keys = iter(jax.random.split(jax.random.key(seed), 8))
    critics, _ = critics_init(next(keys), (5, 8, 8, 1), "batch")
    for critic in critics:
        critic["norms"] = [
            {"scale": 1 + jax.random.normal(key, (size,)), "shift": jax.random.normal(key, (size,))}
            for key, size in zip(keys, (5, 8, 8), strict=False)
        ]
    return critics, np.asarray(3 + 2 * jax.random.normal(jax.random.key(seed + 1), (32, 5)))


def test_values_are_batch_norms() -> None:
    critics, x = drawn(0)
    q, moments = in_training(critics, jnp.asarray(x))
    np.testing.assert_allclose(q, [written_out(critic, x) for critic in critics], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(moments[1][0].mean, x.mean(0), rtol=1e-5)
    np.testing.assert_allclose(moments[1][0].variance, x.var(0), rtol=1e-4)


def test_plain_critics_have_the_moments_in_their_layers() -> None:
    """With the batch's own moments they give the batch's values; one sample's no longer hang on the others."""
    critics, x = drawn(1)
    q, moments = in_training(critics, jnp.asarray(x))
    for rows in (slice(None), slice(3)):
        values = networks.twin(plain(critics, moments), jnp.asarray(x[rows, :3]), jnp.asarray(x[rows, 3:]))
        np.testing.assert_allclose(values, q[:, rows], rtol=1e-4, atol=1e-4)


def test_other_critics_start_as_their_targets() -> None:
    for norm in ("none", "layer"):
        critics, target = critics_init(jax.random.key(0), (5, 8, 1), norm)
        assert jax.tree.map(lambda x, y: bool((x == y).all()), critics, target) == jax.tree.map(lambda x: True, critics)
        assert plain(critics, target) == critics
