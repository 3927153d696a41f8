"""Measure what `--precision` costs in accuracy: `python benchmarks/precision.py`.

The script emulates the formats on any device. It rounds the factors of each layer's products, forward and backward, to
the significant bits of the format and adds in float32, as a GPU does. VDPO, preset `paper`, HalfCheetah-v5.
Writes benchmarks/results/precision.jsonl.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jsonl
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
    """Return a `networks.linear` that rounds its factors to so many bits of mantissa."""

    def rounded(x: Array) -> Array:
        return jax.lax.reduce_precision(x, 8, bits)

    @jax.custom_vjp
    def product(x: Array, w: Array) -> Array:
        return rounded(x) @ rounded(w)

    def backward(factors: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
        x, w = factors
        return rounded(g) @ rounded(w).T, rounded(x).T @ rounded(g)

    product.defvjp(lambda x, w: (product(x, w), (x, w)), backward)

    def linear(params: networks.Params, x: Array) -> Array:
        rows = product(x.reshape(-1, x.shape[-1]), params["w"])
        return rows.reshape(*x.shape[:-1], -1) + params["b"]

    return linear


def measure(bits: int, seed: int) -> tuple[Array, Array]:
    """Return the delayed policy's actions at every age and the gradient of the belief loss, of untrained networks."""
    networks.linear = transformer.linear = layer(bits)
    agent = AGENTS["vdpo"].presets["paper"].agent
    init_key, data_key, dropout_key = jax.random.split(jax.random.key(seed), 3)
    state = agent.init(SPEC, init_key)
    shapes = {"obs": (BATCH, 17), "actions": (BATCH, 5, 6), "states": (BATCH, 5, 17)}
    keys = jax.random.split(data_key, 3)
    data = {n: jax.random.normal(k, shape) for (n, shape), k in zip(shapes.items(), keys, strict=True)}
    x = Unseen(data["obs"], jnp.tanh(data["actions"]), data["states"], jnp.ones((BATCH, 5), bool))
    mean = networks.mode(agent.policy(state, x.obs, x.actions))
    gradient = jax.grad(lambda params: agent.belief_loss(params, x, dropout_key)[0])((state.encoder, state.decoder))
    return mean, jnp.concatenate([g.ravel() for g in jax.tree.leaves(gradient)])


def distance(x: Array, exact: Array) -> float:
    """Return the length of the error relative to the length of `exact`."""
    return float(jnp.linalg.norm(x - exact) / jnp.linalg.norm(exact))


def main() -> int:
    """Compare each format with float32 on five seeds."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    lines, exact = [], [measure(23, seed) for seed in range(5)]
    for name, bits in MANTISSA.items():
        errors = [list(map(distance, measure(bits, seed), right)) for seed, right in enumerate(exact)]
        action_error, gradient_error = np.median(errors, 0).tolist()
        row = {"precision": name, "action": action_error, "gradient": gradient_error, "seeds": 5}
        lines.append(row | {"date": time.strftime("%Y-%m-%d"), "versions": versions()})
        print(row, file=sys.stderr)
    jsonl.write(OUT, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
