"""Matrix products in the precision of a run. XLA follows that setting on accelerators; on a CPU we round factors."""

from typing import Literal

import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Float

Precision = Literal["float32", "tensorfloat32", "bfloat16"]
BFLOAT16 = ("BF16_BF16_F32", "bfloat16")
"""`jax.default_matmul_precision` of bfloat16 factors and float32 sums: on accelerators, and on a CPU.

JAX's "bfloat16" is tensorfloat32 on a GPU. With the other name XLA's CPU compiler aborts at some products.
"""
FEW = 32
"""Fewer outputs cost little, and stay in float32 on a CPU: Q-values, and those of policies of up to 15 actions."""


def setting(precision: Precision) -> str:
    """Return what `jax.default_matmul_precision` takes for the device of this context (`jax.default_device`)."""
    if precision != "bfloat16":
        return precision
    device = jax.default_device.value
    return BFLOAT16[getattr(device, "platform", device or jax.default_backend()) == "cpu"]


def product(x: Float[Array, "*rows inputs"], w: Float[Array, "*copies inputs outputs"]) -> Float[Array, "*rows _"]:
    """Return X W in the precision that `jax.default_matmul_precision` asks for. W's leading axes are X's too.

    One row is not worth rounding W; and under `jax.vmap` its gradient would be a matrix for each. It stays in float32.
    """
    if jax.default_matmul_precision.value not in BFLOAT16 or w.shape[-1] < FEW or x.ndim == 1:
        return x @ w
    return _rounded_product(x, w)


@jax.custom_vjp
def _rounded_product(x: Array, w: Array) -> Array:
    return _contract(x, w, -1, -2)


def _slopes(factors: tuple[Array, Array], slope: Array) -> tuple[Array, Array]:
    x, w = factors
    return _contract(slope, w, -1, -1), _contract(x, slope, -2, -2)


_rounded_product.defvjp(lambda x, w: (_rounded_product(x, w), (x, w)), _slopes)


def _contract(x: Array, y: Array, x_axis: int, y_axis: int) -> Array:
    """Sum products of rounded factors over an axis of each, one of the last two; those before are batches."""
    copies = tuple(range(x.ndim - 2))

    def on_cpu(x: Array, y: Array) -> Array:
        if x_axis == -2:  # XLA's fast product wants a left factor in the order of its rows (docs/performance.md)
            x = with_layout_constraint(jnp.swapaxes(x, -1, -2), Layout(tuple(range(x.ndim))))
        numbers = (((x.ndim - 1,), (y.ndim + y_axis,)), (copies, copies))
        x, y = x.astype(jnp.bfloat16), y.astype(jnp.bfloat16)
        return jax.lax.dot_general(x, y, numbers, jax.lax.Precision.DEFAULT, jnp.float32)

    def elsewhere(x: Array, y: Array) -> Array:
        return jax.lax.dot_general(x, y, (((x.ndim + x_axis,), (y.ndim + y_axis,)), (copies, copies)))

    return jax.lax.platform_dependent(x, y, cpu=on_cpu, default=elsewhere)
