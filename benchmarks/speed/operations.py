"""Where an update's time goes, operation by operation: `python benchmarks/speed/operations.py [WORK ...]`.

On one core, so that operations do not overlap and their times add up; XLA's profiler gives each operation's time, its
program says what the operation is. Writes benchmarks/results/operations.jsonl.
"""

import json
import math
import os
import re
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from floor import Prepared, matmul_flops, prepare, update
from gate import pin
from jax.profiler import ProfileData
from works import WORKS

from delayrl.run.provenance import versions

RESULTS = Path(__file__).parent.parent / "results" / "operations.jsonl"
DEFAULT = ("vdpo-5", "vdpo-64", "sac-sbx")  # the largest first: what it asks of the memory holds for the process
UPDATES = 30

LINE = re.compile(r"^ +(?:ROOT )?%(\S+) = (\([^=]*?\)|\S+) ([\w-]+)\(([^)]*)\)(.*)$", re.M)
BODY = re.compile(r"^%(\S+) \([^\n]*\{\n(.*?)^\}", re.S | re.M)


def kinds(program: str) -> dict[str, str]:
    """Of each operation of a compiled program, by its name: what it is.

    A product for the weights' gradient whose input XLA transposes first counts as one forward; of 4,000 rows and more,
    where layers are made as two products, all count as attention's.
    """
    bodies = dict(BODY.findall(program))
    found = {}
    for name, shape, operation, _, rest in LINE.findall(program):
        inside = re.search(r"calls=%([^\s,]+)", rest)
        text = rest + (bodies.get(inside[1], "") if inside else "")
        if operation == "dot" or (operation == "fusion" and " dot(" in text):
            if "lhs_batch_dims" in text:
                found[name] = "products of attention"
            elif re.search(r"lhs_contracting_dims=\{0\}", text):
                found[name] = "products for the weights' gradients"
            else:
                found[name] = "products, forward and for the inputs' gradients"
        elif operation in ("while", "conditional"):
            continue  # what is inside counts
        elif shape.startswith(("u32", "(u32")):
            found[name] = "random bits"
        elif operation in ("copy", "concatenate", "transpose", "gather", "slice", "dynamic-slice"):
            found[name] = "copies and gathers"
        elif "reduce(" in text:
            found[name] = "sums"
        elif operation in ("fusion", "call"):
            found[name] = "elementwise"
    return found


def times(prepared: Prepared, index: int) -> dict[str, Any]:
    """Milliseconds of an update of phase `index` by kind of operation, and how often each is called."""
    agent, spec, _, state, replay, keys = prepared
    phase = agent.phases()[index]
    reach = (phase.batch, spec.delay, agent.ahead(spec))
    step = jax.jit(lambda state, replay, keys, i: update(phase, reach, state, replay, keys, i), donate_argnums=0)
    compiled = step.lower(state, replay, keys, jnp.int32(0)).compile()

    def round_of_updates() -> float:
        now = jax.block_until_ready(jax.tree.map(jnp.copy, state))
        began = time.perf_counter()
        for i in range(UPDATES):
            now = compiled(now, replay, keys, jnp.int32(i))
        jax.block_until_ready(now)
        return (time.perf_counter() - began) / UPDATES

    round_of_updates()
    whole = min(round_of_updates() for _ in range(3))
    known, spent, calls = kinds(compiled.as_text()), defaultdict[str, float](float), defaultdict[str, float](float)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            round_of_updates()
        for file in Path(folder).rglob("*.xplane.pb"):
            for plane in ProfileData.from_file(str(file)).planes:
                for event in (event for line in plane.lines for event in line.events):
                    if kind := known.get(event.name):
                        spent[kind] += event.duration_ns / 1e6 / UPDATES
                        calls[kind] += 1 / UPDATES
    flops = matmul_flops(lambda *a: update(phase, reach, *a), state, replay, keys, jnp.int32(0))
    return {
        "milliseconds": float(f"{1e3 * whole:.4g}"),
        "gflop": float(f"{flops / 1e9:.4g}"),
        "kinds": {k: [float(f"{spent[k]:.3g}"), round(calls[k], 1)] for k in sorted(spent, key=lambda k: -spent[k])},
    }


def main() -> int:
    """Profile both phases of the works named, and write their rows."""
    os.environ["OMP_NUM_THREADS"] = "1"
    pin()
    names = sys.argv[1:] or DEFAULT
    if unknown := [name for name in names if name not in WORKS]:
        print(f"no work {', '.join(unknown)}; there are {', '.join(WORKS)}", file=sys.stderr)
        return 2
    lines = []
    for name in names:
        work = WORKS[name]
        prepared = prepare(work.sides["ours"])
        for index in range(len(prepared.agent.phases())):
            load = os.getloadavg()[0]
            row = {"work": name, "title": work.title.split(";")[0], "phase": index, "load": round(load, 2)}
            row |= times(prepared, index) | {"date": time.strftime("%Y-%m-%d"), "versions": versions()}
            lines.append(json.dumps(row))
            total = math.fsum(ms for ms, _ in row["kinds"].values())
            print(f"{name}, phase {index}: {row['milliseconds']:.2f} ms, of it seen {total:.2f}", file=sys.stderr)
    RESULTS.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
