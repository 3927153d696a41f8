"""Measure how long one decision takes: one process for each backend, one thread, one core."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.deploy.bundle import BACKENDS, load_bundle
from delayrl.errors import DelayRLError

AGES = (5, 25, 50)
WARM_UP = 50
ONE_THREAD = {
    **{f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")},
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "JAX_PLATFORMS": "cpu",
}


def ages_of(longest: int) -> list[int]:
    """Return the ages to measure: those of `AGES` that the policy serves, and its longest."""
    return sorted({age for age in AGES if age <= longest} | {longest})


def latency(
    bundle: str | Path, backend: str, *, decisions: int = 2000, ages: Sequence[int] | None = None
) -> list[dict[str, Any]]:
    """Time decisions back to back in a new process, each on new numbers, after a warm-up.

    Args:
        bundle: the folder of the bundle.
        backend: one of `BACKENDS`.
        decisions: how many to time for each age.
        ages: in steps; None for `ages_of` the policy's longest.

    Returns:
        A row for each age: `age` and `decisions`, and `p50`, `p99`, `max` and `processor_p99` in milliseconds. The last
        one leaves out the time in which the processor did something else.

    Raises:
        DelayRLError: a broken bundle, an age that it does not serve, or a backend that is not installed.
    """
    if not 1 <= decisions <= 10_000_000:
        raise DelayRLError(f"decisions must lie in 1 .. 10,000,000; got {decisions}")
    task = json.dumps([str(bundle), backend, decisions, None if ages is None else [int(age) for age in ages]])
    # -P: do not import modules from the working folder, which may be the bundle's
    command = [sys.executable, "-P", "-m", "delayrl.deploy.latency", task]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, capture_output=True, text=True)
    if done.returncode:
        raise DelayRLError((done.stderr.strip().splitlines() or [f"the measurement of {backend} broke off"])[-1])
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def measure(bundle: str, backend: str, decisions: int, ages: Sequence[int] | None) -> list[dict[str, Any]]:
    """Time decisions in this process; see `latency`."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    policy = load_bundle(bundle, backend)
    random, rows = np.random.default_rng(0), []
    for age in ages_of(policy.max_age) if ages is None else ages:
        if not 0 <= age <= policy.max_age:
            raise DelayRLError(f"the policy takes ages 0..{policy.max_age}; got {age}")
        times = np.zeros((2, decisions))  # milliseconds by the clock, and of the processor
        for i in range(-WARM_UP, decisions):
            obs = random.standard_normal(policy.obs_size, np.float32)
            actions = np.zeros((policy.max_age, policy.action_size), np.float32)
            actions[:age] = random.uniform(policy.low, policy.high, (age, policy.action_size))
            worked, began = time.process_time(), time.perf_counter()
            policy(obs, actions, age)
            if i >= 0:
                times[:, i] = 1000 * (time.perf_counter() - began), 1000 * (time.process_time() - worked)
        p50, p99 = np.percentile(times[0], [50, 99])
        quantiles = {"p50": p50, "p99": p99, "max": times[0].max(), "processor_p99": np.percentile(times[1], 99)}
        rows.append({"age": age, "decisions": decisions, **quantiles})
    return rows


def available(backend: str) -> bool:
    """Whether the packages of a backend are installed."""
    packages = ("onnx", "onnxruntime") if backend == "onnx" else (backend,)
    return all(find_spec(name) is not None for name in packages)


def table(rows: dict[str, list[dict[str, Any]]], period: float | None) -> tuple[list[str], list[list[str]]]:
    """Return the head and cells of a table, from the rows of each backend and the control period in seconds."""
    head = ["backend", "age", "p50 ms", "p99 ms", "max ms", "p99 of processor time"]
    head += ["p99 of the period"] if period else []
    cells = []
    for backend in BACKENDS:
        for row in rows.get(backend, []):
            times = [f"{row[name]:.3f}" for name in ("p50", "p99", "max", "processor_p99")]
            times += [f"{row['p99'] / (1000 * period):.1%}"] if period else []
            cells.append([backend, str(row["age"]), *times])
    return head, cells


if __name__ == "__main__":
    try:
        print(json.dumps(measure(*json.loads(sys.argv[1]))))
    except DelayRLError as error:
        sys.exit(str(error))
