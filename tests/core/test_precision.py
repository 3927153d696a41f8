"""Products of rounded factors, forward and backward, beside NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delayrl.core.networks import mlp, mlp_init
from delayrl.core.precision import BFLOAT16, FEW, product, setting

SHAPES = [((24, 40), (40, 48)), ((2, 24, 40), (2, 40, 48))]


def drawn(*shapes: tuple[int, ...]) -> list[np.ndarray]:
    """Numbers that bfloat16 does not have."""
    return [np.random.default_rng(i).normal(size=shape).astype(np.float32) for i, shape in enumerate(shapes)]


def rounded(x: np.ndarray) -> np.ndarray:
    return np.asarray(jnp.asarray(x).astype(jnp.bfloat16), np.float64)


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize(("rows", "weights"), SHAPES)
def test_factors_are_rounded_and_sums_are_not(rows, weights, lockstep: bool) -> None:
    """The result, and what a loss's slope is at both factors: each a product of two rounded arrays."""
    x, w, slope = drawn(rows, weights, (*rows[:-1], weights[-1]))

    def both(x, w, slope):
        y, back = jax.vjp(product, x, w)
        return y, *back(slope)

    with jax.default_matmul_precision(setting("bfloat16")):
        if lockstep:
            pairs = jax.jit(jax.vmap(both))(*(np.stack([a, 2 * a]) for a in (x, w, slope)))
            found = [pair[0] for pair in pairs]
            for pair in pairs:  # doubling is exact
                np.testing.assert_array_equal(4 * pair[0], pair[1])
        else:
            found = jax.jit(both)(x, w, slope)
    x, w, slope = (rounded(a) for a in (x, w, slope))
    expected = [x @ w, slope @ np.swapaxes(w, -1, -2), np.swapaxes(x, -1, -2) @ slope]
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == jnp.float32
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-4)


def test_setting_of_a_device() -> None:
    """By the device of the context; a CPU is one wherever there is an accelerator beside it."""
    assert [setting(name) for name in ("float32", "tensorfloat32", "bfloat16")] == [
        "float32",
        "tensorfloat32",
        "bfloat16",
    ]
    with jax.default_device(jax.devices("cpu")[0]):
        assert setting("bfloat16") == "bfloat16"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        assert setting("bfloat16") == "BF16_BF16_F32"
        with jax.default_device(jax.devices("cpu")[0]):
            assert setting("bfloat16") == "bfloat16"


def test_other_precisions_few_outputs_and_one_row_are_float32() -> None:
    """The same numbers as without a setting."""
    x, w, few = drawn((24, 40), (40, FEW), (40, FEW - 1))
    cases = [(BFLOAT16[0], x, w, False), (BFLOAT16[1], x, w, False), (BFLOAT16[1], x, few, True)]
    cases += [(BFLOAT16[1], x[0], w, True), ("float32", x, w, True)]
    for precision, rows, weights, same in cases:
        with jax.default_matmul_precision(precision):
            assert np.array_equal(jax.jit(product)(rows, weights), jax.jit(jnp.matmul)(rows, weights)) == same


def test_gradient_of_a_network() -> None:
    """Close to float32's and not equal to it."""
    params = mlp_init(jax.random.key(0), (40, 64, 64, 3), norm="layer")
    x = jnp.asarray(drawn((32, 40))[0])
    slopes = []
    for precision in ("float32", BFLOAT16[1]):
        with jax.default_matmul_precision(precision):
            grad = jax.jit(jax.grad(lambda params: (mlp(params, x) ** 2).mean()))(params)
        slopes.append(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(grad)]))
    assert 1e-4 < np.linalg.norm(slopes[1] - slopes[0]) / np.linalg.norm(slopes[0]) < 0.1
