"""What `--precision` costs in accuracy: `python benchmarks/precision.py` writes benchmarks/results/precision.jsonl.

Emulated on any device: what enters each layer's products, forward and backward, is rounded to the significant bits of
the format, and the sums are of float32, as such products are defined on a GPU. VDPO, preset `paper`, HalfCheetah-v5.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from delayrl.agents.registry import AGENTS
from delayrl.agents.vdpo import Unseen
from delayrl.core import networks, transformer
from delayrl.core.types import Spec
from delayrl.run.provenance import versions

OUT = Path(__file__).parent / "results" / "precision.jsonl"
MANTISSA = {"tensorfloat32": 10, "bfloat16": 7}  # bits; float32 has 23
SPEC, BATCH = Spec(17, 6, 5), 256


def layer(bits: int) -> Any:
    """`networks.linear` with products of rounded factors."""

    def rounded(x: Array) -> Array:
        return jax.lax.reduce_precision(x, 8, bits)

    @jax.custom_vjp
    def product(x: Array, w: Array) -> Array:
        return rounded(x) @ rounded(w)

    def backward(given: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
        x, w = given
        return rounded(g) @ rounded(w).T, rounded(x).T @ rounded(g)

    product.defvjp(lambda x, w: (product(x, w), (x, w)), backward)

    def linear(params: networks.Params, x: Array) -> Array:
        rows = product(x.reshape(-1, x.shape[-1]), params["w"])
        return rows.reshape(*x.shape[:-1], -1) + params["b"]

    return linear


def measure(bits: int, seed: int) -> tuple[Array, Array]:
    """Actions of the delayed policy at every age, and the gradient of the belief's loss, of fresh networks."""
    networks.linear = transformer.linear = layer(bits)
    agent = AGENTS["vdpo"].presets["paper"].agent
    init, draw, dropout = jax.random.split(jax.random.key(seed), 3)
    state = agent.init(SPEC, init)
    shapes = {"obs": (BATCH, 17), "actions": (BATCH, 5, 6), "states": (BATCH, 5, 17)}
    keys = jax.random.split(draw, 3)
    data = {n: jax.random.normal(k, shape) for (n, shape), k in zip(shapes.items(), keys, strict=True)}
    x = Unseen(data["obs"], jnp.tanh(data["actions"]), data["states"], jnp.ones((BATCH, 5), bool))
    mean = networks.mode(agent.policy(state, x.obs, x.actions))
    gradient = jax.grad(lambda params: agent.belief_loss(params, x, dropout)[0])((state.encoder, state.decoder))
    return mean, jnp.concatenate([g.ravel() for g in jax.tree.leaves(gradient)])


def distance(x: Array, exact: Array) -> float:
    return float(jnp.linalg.norm(x - exact) / jnp.linalg.norm(exact))


def main() -> int:
    """Five seeds, each format against float32."""
    lines, exact = [], [measure(23, seed) for seed in range(5)]
    for name, bits in MANTISSA.items():
        errors = [list(map(distance, measure(bits, seed), right)) for seed, right in enumerate(exact)]
        action_error, gradient_error = np.median(errors, 0).tolist()
        row = {"precision": name, "action": action_error, "gradient": gradient_error, "seeds": 5}
        lines.append(json.dumps(row | {"date": time.strftime("%Y-%m-%d"), "versions": versions()}))
        print(row, file=sys.stderr)
    OUT.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
