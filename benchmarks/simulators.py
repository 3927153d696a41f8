"""Measure what a delay costs inside a compiled simulator: `python benchmarks/simulators.py` (needs delayrl[brax]).

Steps brax's halfcheetah with random actions, plain and delayed in turn, and reads what the policy would. Writes rows
and the table in docs/performance.md; `--table` only the table.
"""

import argparse
import time
from typing import Any

import jsonl
import numpy as np
from pages import HERE, insert

from delayrl.report.markup import markdown_table

ROWS = HERE / "results" / "simulators.jsonl"
DELAYS = ("5", "50", "uniform:1:5", "uniform:1:50", "episode:1:5+action=episode:0:5")
ROBOTS = (1024, 4096)
STEPS = 20


def measure(rounds: int, device: str) -> None:
    """Measure all delays in turn and write the rows."""
    import jax
    from brax import envs
    from brax.envs.wrappers import training

    from delayrl.batched.brax import wrap
    from delayrl.run.provenance import versions

    task = envs.get_environment("halfcheetah", backend="spring")
    rows: list[dict[str, Any]] = []
    for robots in ROBOTS:

        def rollout(env: Any, robots: int = robots) -> Any:
            def step(state: Any, key: Any) -> Any:
                action = jax.random.uniform(key, (robots, task.action_size), minval=-1, maxval=1)
                state = env.step(state, action)
                return state, sum(entry.mean() for entry in jax.tree.leaves(state.obs))

            return jax.jit(lambda state, key: jax.lax.scan(step, state, jax.random.split(key, STEPS)))

        programs = {}
        for name, env in {"": training.wrap(task, 1000), **{delay: wrap(task, delay) for delay in DELAYS}}.items():
            state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), robots))
            programs[name] = rollout(env), state
            jax.block_until_ready(programs[name][0](state, jax.random.key(0)))
        for number in range(rounds):
            for name, (program, state) in programs.items():
                began, processor = time.perf_counter(), time.process_time()
                jax.block_until_ready(program(state, jax.random.key(number)))
                took = {"wall": time.perf_counter() - began, "processor": time.process_time() - processor}
                rows.append({"name": device, "robots": robots, "delay": name, "round": number, **took})
        print(f"{robots} robots: done", flush=True)
    jsonl.replace(ROWS, {"versions": versions(), "steps": STEPS}, rows, ("name",))


def table() -> str:
    """Return a table for each device: time of a step with a delay over that without one, medians over the rounds."""
    parts = []
    for about, rows in jsonl.blocks(ROWS):
        used = about["versions"]
        clock = "processor" if used["device"] == "cpu" else "wall"
        body = []
        for robots in ROBOTS:
            times = {
                delay: np.array([row[clock] for row in rows if (row["robots"], row["delay"]) == (robots, delay)])
                for delay in ("", *DELAYS)
            }
            plain = 1000 * np.median(times[""]) / about["steps"]
            ratios = [f"{np.median(times[delay] / times['']):.2f}" for delay in DELAYS]
            body.append([f"{robots:,}", f"{plain:.1f}", *ratios])
        rounds = 1 + max(row["round"] for row in rows)
        kind = f"{used['cores']} x86 cores, processor time" if clock == "processor" else f"{used['device']}, wall time"
        table = markdown_table(["robots", "without, ms a step", *(f"`{delay}`" for delay in DELAYS)], body)
        parts.append(f"{table}\n\nMedian of {rounds} rounds in turn; {kind}; jax {used['jax']}.")
    return "\n\n".join(parts) + " Rows: `benchmarks/results/simulators.jsonl`."


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--name", default="cpu", help="of the device; rows of another one stay (default: cpu)")
    parser.add_argument("--table", action="store_true", help="write the table alone")
    given = parser.parse_args()
    if not given.table:
        measure(given.rounds, given.name)
    insert(HERE.parent / "docs" / "performance.md", "simulators", table())
