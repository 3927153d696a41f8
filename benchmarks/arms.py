"""Time the updates of the ladder's arms in turn: `python benchmarks/arms.py` writes benchmarks/results/arms.jsonl.

Processor time of one thread, for one seed and one environment step, sampling included; acting and the task are the
same for all. Each round takes every arm once, so that other work on the machine meets all of them.
"""

import argparse
import functools
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "speed"))
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import jsonl
import ladder
from floor import filled, update

from delayrl.bench.grid import load_grid
from delayrl.core.precision import setting
from delayrl.envs.making import make
from delayrl.play.policy import spec_of
from delayrl.run.condition import Condition, resolve
from delayrl.run.provenance import versions

OUT = Path(__file__).parent / "results" / "arms.jsonl"
GRID = "any-age-ladder"
ROWS, TURN = 2_000, 20  # rows of the replay, updates of a turn


def updates(condition: Condition) -> Callable[[], float]:
    """Compile an arm's update. What is returned makes TURN of them and says the processor seconds of a step."""
    c = condition
    setup = resolve(c.agent, c.env, c.delay, c.preset, c.protocol, c.overrides)
    spec = spec_of(make(c.env, c.delay, rescale=True))
    (phase,), keys = setup.agent.phases(), jax.random.split(jax.random.key(0), 1)
    state = jax.vmap(functools.partial(setup.agent.init, spec))(keys)
    replay = jax.tree.map(lambda x: x[None], filled(spec, ROWS))
    reach = (phase.batch, spec.delay, setup.agent.ahead(spec))
    step = jax.jit(functools.partial(update, phase, reach), donate_argnums=0)

    def turn() -> float:
        nonlocal state
        began = time.process_time()
        with jax.default_matmul_precision(setting(setup.schedule.precision)):
            for count in range(TURN):
                state = step(state, replay, keys, count)
        jax.block_until_ready(state)
        return (time.process_time() - began) / TURN * phase.updates / phase.every

    turn()
    return turn


def measure(rounds: int) -> list[dict[str, Any]]:
    """Return a row for each arm, in the order of the grid."""
    arms = {ladder.arm(cell.condition): cell.condition for cell in load_grid(GRID).cells}
    turns = {}
    for name, condition in arms.items():
        if condition.agent != "random":
            turns[name] = updates(condition)
            print(f"{len(turns)} of {len(arms) - 1} compiled: {name}", flush=True)
    seconds = [{name: turn() for name, turn in turns.items()} for _ in range(rounds)]
    return [{"arm": name, "ms": [round(1e3 * found[name], 3) for found in seconds]} for name in turns]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    rows = measure(parser.parse_args().rounds)
    jsonl.write(OUT, [{"versions": versions()}, *rows])
