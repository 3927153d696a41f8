"""Measure how long one decision takes and write the table in the docs: `python benchmarks/latency.py`.

The bundles have the preset `paper` and the sizes of HalfCheetah-v5 (17 observations, 6 actions, 50 ms per step). Their
weights are untrained, because values do not change the time. Tries run one after another, each backend in its own
process on one thread of one core. The spread over the tries is due to other work on the machine.
`--table` only rewrites the table from the rows.
"""

import argparse
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import jsonl
import numpy as np
from pages import HERE, insert

from delayrl.deploy.bundle import BACKENDS
from delayrl.deploy.files import write_files
from delayrl.deploy.latency import latency
from delayrl.deploy.packing import pack
from delayrl.report.markup import markdown_table

ROWS = HERE / "results" / "latency.jsonl"
SIZES, DT, DELAYS, NAMES = (17, 6), 0.05, (5, 25, 50), ("vdpo", "bpql")
KEYS = ("p50", "p99", "max", "processor_p99")
WORDS = {"numpy": "NumPy", "onnx": "ONNX Runtime", "jax": "JAX", "cpp": "C++ example"}


def build(folder: Path, name: str, delay: int) -> Path:
    """Write a bundle with untrained weights and return its folder."""
    import jax

    from delayrl.agents.registry import AGENTS
    from delayrl.core.types import Spec
    from delayrl.deploy.export import network_of
    from delayrl.play.policy import Policy

    agent, spec = AGENTS[name].presets["paper"].agent, Spec(*SIZES, delay)
    policy = Policy(agent, agent.init(spec, jax.random.key(0)), spec, -np.ones(SIZES[1]), np.ones(SIZES[1]))
    write_files(out := folder / f"{name}-{delay}", pack(*network_of(policy), {"agent": name, "dt": DT}))
    return out


def in_cpp(program: Path, bundle: Path, delay: int, decisions: int) -> dict[str, Any]:
    """Measure with the C++ example's own clock, pinned to one core."""
    pin = ["taskset", "-c", str(max(os.sched_getaffinity(0)))] if shutil.which("taskset") else []
    command = [*pin, str(program), str(bundle), "--latency", str(decisions), str(delay)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(zip(KEYS, map(float, done.stdout.split()), strict=True))


def measure(tries: int, decisions: int) -> None:
    """Measure every backend on every bundle and write the rows."""
    from delayrl.run.provenance import versions

    package = versions()
    try:
        import onnxruntime

        package["onnxruntime"] = onnxruntime.__version__
    except ImportError:
        pass
    lines: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "controller"
        source = HERE.parent / "examples" / "cpp" / "controller.cpp"
        compiler = shutil.which("g++")
        if compiler:
            flags = ["-std=c++17", "-O3", "-march=native"]
            subprocess.run([compiler, *flags, "-o", str(program), str(source)], check=True)
            package["compiler"] = subprocess.run(
                [compiler, "-dumpfullversion"], capture_output=True, text=True
            ).stdout.strip()
        lines.append({"versions": package, "decisions": decisions, "dt": DT})
        bundles = {(name, delay): build(Path(folder), name, delay) for name in NAMES for delay in DELAYS}
        for number in range(tries):
            for (name, delay), bundle in bundles.items():
                common = {"try": number, "agent": name, "delay": delay, "load": round(os.getloadavg()[0], 2)}
                for backend in BACKENDS:
                    (row,) = latency(bundle, backend, decisions=decisions, ages=[delay])
                    lines.append(common | {"backend": backend, **{k: round(row[k], 4) for k in KEYS}})
                if compiler:
                    lines.append(common | {"backend": "cpp", **in_cpp(program, bundle, delay, decisions)})
            print(f"try {number + 1} of {tries} done")
    jsonl.write(ROWS, lines)


def table() -> str:
    """Return a Markdown table: medians over the tries, with the lowest and highest values."""
    head, *rows = jsonl.read(ROWS)
    body = []
    for name in NAMES:
        for delay in DELAYS:
            for backend in WORDS:
                measured = [r for r in rows if (r["agent"], r["delay"], r["backend"]) == (name, delay, backend)]
                if not measured:
                    continue
                cells = [f"`{name}`", delay, WORDS[backend]]
                for key in KEYS:
                    values = [row[key] for row in measured]
                    cells.append(f"{np.median(values):.2f} ({min(values):.2f}–{max(values):.2f})")
                body.append(cells)
    package, tries = head["versions"], 1 + max(row["try"] for row in rows)
    loads = [row["load"] for row in rows]
    titles = ["policy", "Δ", "backend", "p50 ms", "p99 ms", "max ms", "p99 of processor time, ms"]
    about = (
        f"Preset `paper`, {SIZES[0]} observations, {SIZES[1]} actions, age Δ, fresh weights; the task's control "
        f"period is {1000 * head['dt']:g} ms. Median of {tries} tries of {head['decisions']:,} decisions each "
        f"(lowest–highest), back to back, on one thread of one core of a machine with {package['cores']} shared x86 "
        f"cores and no GPU (load average {min(loads):.1f}–{max(loads):.1f} meanwhile). "
        f"NumPy {package['numpy']}, onnxruntime "
        f"{package.get('onnxruntime', '-')}, jax {package['jax']}, g++ {package.get('compiler', '-')} with "
        f"`-O3 -march=native`. Rows: `benchmarks/results/latency.jsonl`."
    )
    return f"{markdown_table(titles, body)}\n\n{about}"


def main() -> None:
    """Measure unless `--table` is given, then write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tries", type=int, default=5)
    parser.add_argument("--decisions", type=int, default=2000)
    parser.add_argument("--table", action="store_true", help="only rewrite the table from the rows")
    given = parser.parse_args()
    if not given.table:
        measure(given.tries, given.decisions)
    insert(HERE.parent / "docs" / "deploy.md", "latency", table())


if __name__ == "__main__":
    main()
