"""Profile one update, operation by operation: `python benchmarks/speed/operations.py [WORK ...]`.

The update runs on one core, so that operations do not overlap and their times add up. XLA's profiler gives the time of
each operation and the compiled program its kind. Writes benchmarks/results/operations.jsonl.
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
DEFAULT = ("vdpo-5", "vdpo-64", "sac-sbx")  # the largest first: its buffers stay resident for the whole process
UPDATES = 30

LINE = re.compile(r"^ +(?:ROOT )?%(\S+) = (\([^=]*?\)|\S+) ([\w-]+)\(([^)]*)\)(.*)$", re.M)
BODY = re.compile(r"^%(\S+) \([^\n]*\{\n(.*?)^\}", re.S | re.M)


def kinds(program: str) -> dict[str, str]:
    """Return the kind of each operation of a compiled program, by name.

    Two kinds are miscounted. A product for the weights' gradient whose input XLA transposes first counts as forward.
    With 4,000 rows or more, where layers are computed as two products, all products count as attention's.
    """
    bodies = dict(BODY.findall(program))
    kind_of = {}
    for name, shape, operation, _, rest in LINE.findall(program):
        inside = re.search(r"calls=%([^\s,]+)", rest)
        text = rest + (bodies.get(inside[1], "") if inside else "")
        if operation == "dot" or (operation == "fusion" and " dot(" in text):
            if "lhs_batch_dims" in text:
                kind_of[name] = "products of attention"
            elif re.search(r"lhs_contracting_dims=\{0\}", text):
                kind_of[name] = "products for the weights' gradients"
            else:
                kind_of[name] = "products, forward and for the inputs' gradients"
        elif operation in ("while", "conditional"):
            continue  # their bodies are counted
        elif shape.startswith(("u32", "(u32")):
            kind_of[name] = "random bits"
        elif operation in ("copy", "concatenate", "transpose", "gather", "slice", "dynamic-slice"):
            kind_of[name] = "copies and gathers"
        elif "reduce(" in text:
            kind_of[name] = "sums"
        elif operation in ("fusion", "call"):
            kind_of[name] = "elementwise"
    return kind_of


def times(prepared: Prepared, index: int) -> dict[str, Any]:
    """Return the milliseconds and calls of an update of phase `index`, by kind of operation."""
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
    seconds = min(round_of_updates() for _ in range(3))
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
        "milliseconds": float(f"{1e3 * seconds:.4g}"),
        "gflop": float(f"{flops / 1e9:.4g}"),
        "kinds": {k: [float(f"{spent[k]:.3g}"), round(calls[k], 1)] for k in sorted(spent, key=lambda k: -spent[k])},
    }


def main() -> int:
    """Profile every phase of the named works and write the rows."""
    os.environ["OMP_NUM_THREADS"] = "1"
    pin()
    names = sys.argv[1:] or DEFAULT
    if unknown := [name for name in names if name not in WORKS]:
        print(f"unknown work {', '.join(unknown)}; choose from {', '.join(WORKS)}", file=sys.stderr)
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
            print(
                f"{name}, phase {index}: {row['milliseconds']:.2f} ms, of which {total:.2f} in known operations",
                file=sys.stderr,
            )
    RESULTS.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
