"""Time the parts of our training step and estimate its floor: `python floor.py SIDE` prints one JSON object.

The floor is the arithmetic of the matrix products at the best rate at which this machine multiplies matrices. Each part
is timed alone; in training the parts overlap, so their sum may exceed a step.
"""

import json
import math
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gate import pin

from delayrl.agents.base import Agent, Phase
from delayrl.agents.registry import AGENTS
from delayrl.core import replay as ring
from delayrl.core.precision import setting
from delayrl.core.types import Spec, Transition
from delayrl.delays import Delay
from delayrl.envs.making import delay_of, make
from delayrl.play.policy import spec_of
from delayrl.run.configuration import override
from delayrl.training.actor import Actor
from delayrl.training.buffers import keep_buffers
from delayrl.training.checks import replay_bytes
from delayrl.training.products import matmul_flops
from delayrl.training.train import on_device

ROWS = 2_000
"""Rows of the replay for timing the parts. They fit into the caches, unlike a full replay, but a batch is small."""


def amortised(phases: list[tuple[int, int, float]]) -> float:
    """Return the cost per environment step of phases, each (every so many steps, updates, cost of one update)."""
    return sum(updates * cost / every for every, updates, cost in phases)


def median_seconds(function: Callable[[], Any], seconds: float = 0.6, least: int = 5) -> float:
    """Time a call until its result is ready and return the median, in seconds."""
    jax.block_until_ready(function())
    times: list[float] = []
    until = time.perf_counter() + seconds
    while len(times) < least or (time.perf_counter() < until and len(times) < 1000):
        began = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def rate(left: tuple[int, int], right: tuple[int, int], transposed: str = "", seconds: float = 0.5) -> float:
    """Return the best rate of a product, in operations per second; the best, because others may use the machine."""
    a, b = jnp.ones(left), jnp.ones(right)
    products = {"": lambda a, b: a @ b, "left": lambda a, b: a.T @ b, "right": lambda a, b: a @ b.T}
    multiply = jax.jit(products[transposed])
    size = multiply(a, b).size * 2 * (left[0] if transposed == "left" else left[1])
    multiply(a, b).block_until_ready()
    best, until = math.inf, time.perf_counter() + seconds
    while time.perf_counter() < until:
        began = time.perf_counter()
        multiply(a, b).block_until_ready()
        best = min(best, time.perf_counter() - began)
    return size / best


SQUARES = {"cpu": (512, 1024, 2048), "gpu": (2048, 4096, 8192)}
"""Sizes large enough for the device's best rate. A GPU finishes small ones before the next call arrives."""


def rates(rows: int, width: int, device: str) -> dict[str, float]:
    """Return rates of squares, and of a square layer's products: forward, weights' gradient, inputs' gradient."""
    x, w = (rows, width), (width, width)
    return {
        "square": max(rate((size, size), (size, size)) for size in SQUARES[device]),
        "forward": rate(x, w),
        "weights": rate(x, x, "left"),
        "inputs": rate(x, w, "right"),
    }


def filled(spec: Any, rows: int) -> ring.Replay:
    """Return a replay filled with episodes of 1,000 random steps."""
    random = np.random.default_rng(0)
    number = np.arange(rows)
    moment = number % 1000

    def noise(*shape: int) -> jax.Array:
        return jnp.asarray(random.standard_normal((rows, *shape), np.float32))

    steps = Transition(
        noise(spec.obs_size),
        jnp.minimum(moment, spec.delay),
        jnp.tanh(noise(spec.action_size)),
        noise(),
        jnp.zeros(rows, bool),
        jnp.asarray(moment == 999),
        noise(spec.obs_size),
        jnp.minimum(moment + 1, spec.delay),
    )
    empty = ring.init(spec, rows + rows // 1000 + 2)
    return jax.jit(lambda: jax.lax.scan(lambda r, step: (ring.append(r, step), None), empty, steps)[0])()


class Prepared(NamedTuple):
    """One side's agent as in training, with a state and a filled replay for each seed."""

    agent: Agent
    spec: Spec
    actor: Actor
    state: Any
    replay: ring.Replay
    keys: Any


def prepare(side: dict[str, Any]) -> Prepared:
    """Build what a side trains, without its loop."""
    agent = override(AGENTS[side["agent"]].presets[side["preset"]].agent, side["options"])
    delay: Delay = delay_of(side["env"], side["delay"])
    actor = Actor(make(side["env"], delay.observed(), rescale=True), 0, agent.privileged)
    spec = spec_of(actor.env)
    keep_buffers(agent, spec, side["seeds"])  # as `train` does
    keys = jax.vmap(jax.random.key)(jnp.arange(side["seeds"]))
    state = jax.jit(jax.vmap(partial(agent.init, spec)))(keys)
    replay = jax.tree.map(lambda x: jnp.stack([x] * side["seeds"]), filled(spec, ROWS))
    return Prepared(agent, spec, actor, state, replay, keys)


def parts(side: dict[str, Any]) -> dict[str, Any]:
    """Measure a side.

    Returns:
        `parts`: seconds of each part of a training step of all seeds. `flops`: operations of the products in one seed's
        step. `rates`: operations per second. `replay_bytes`: of one seed. `obs_size` and `peak_bytes`.
    """
    agent, spec, actor, state, replay, keys = prepare(side)
    seeds, first_replay = side["seeds"], jax.tree.map(lambda x: x[0], replay)
    seen = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * seeds), actor.seen)

    act = jax.jit(jax.vmap(partial(agent.act, explore=True)))
    seconds = {"act": median_seconds(lambda: np.asarray(act(state, seen, keys)))}
    random = np.random.default_rng(0)
    seconds["environment"] = seeds * median_seconds(
        lambda: actor.step(random.uniform(-1, 1, spec.action_size).astype(np.float32))
    )
    flops = matmul_flops(partial(agent.act, explore=True), *jax.tree.map(lambda x: x[0], (state, seen)), keys[0])
    costs = []
    for index, phase in enumerate(agent.phases()):
        reach = (phase.batch, spec.delay, agent.ahead(spec))
        update_cost = update_seconds(phase, reach, state, replay, keys)
        seconds[f"phase {index}"] = amortised([(phase.every, phase.updates, update_cost)])
        batch = jax.eval_shape(partial(windows, reach), first_replay, keys[0])
        single = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), state)
        cost = matmul_flops(phase.update, single, batch, keys[0], jax.ShapeDtypeStruct((), jnp.int32))
        costs.append((phase.every, phase.updates, cost))
    flops += amortised(costs)
    rows = phase.batch * max(spec.delay, 1)
    capacity = side.get("capacity", 1_000_000)
    return {
        "parts": seconds,
        "flops": flops,
        "rates": rates(rows, getattr(agent, "width", 256), side["device"]),
        "obs_size": spec.obs_size,
        "replay_bytes": replay_bytes(spec, capacity),
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def windows(reach: tuple[int, int, int], replay: ring.Replay, key: Any) -> Any:
    """Sample a batch of windows for one seed."""
    return ring.sample(replay, key, *reach, jnp.int32(0))


def update(phase: Phase, reach: tuple[int, int, int], state: Any, replay: ring.Replay, keys: Any, i: Any) -> Any:
    """Make the i-th update of all seeds, sampling included, and return their new states."""

    def update_seed(state: Any, replay: ring.Replay, key: Any) -> Any:
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        return phase.update(state, windows(reach, replay, sample_key), update_key, i)[0]

    return jax.vmap(update_seed)(state, replay, keys)


def update_seconds(phase: Phase, reach: tuple[int, int, int], state: Any, replay: ring.Replay, keys: Any) -> float:
    """Return the mean seconds of an update of all seeds, sampling included, over SAC's two turns or a short round."""
    count = 2 if phase.updates == 1 else 20

    @jax.jit
    def several(state: Any, replay: ring.Replay, keys: Any) -> Any:
        def step(state: Any, i: Any) -> Any:
            return update(phase, reach, state, replay, keys, i), None

        return jax.lax.scan(step, state, jnp.arange(count))[0]

    return median_seconds(partial(several, state, replay, keys)) / count


def main() -> None:
    """Measure the side and print its JSON object."""
    pin()
    side = json.loads(sys.argv[1])
    # training's precision: a GPU's default is coarser
    precision = side["options"].get("precision", "float32")
    if on_cpu := side["device"] == "cpu":  # set by name: `keep_buffers` must come before JAX looks for devices
        jax.config.update("jax_platforms", "cpu")
    with on_device(None if on_cpu else side["device"]), jax.default_matmul_precision(setting(precision)):
        print(json.dumps(parts(side)))


if __name__ == "__main__":
    main()
