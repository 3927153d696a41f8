"""Measure delayrl and its peers in alternating slices: `make bench`, or `python benchmarks/speed/run.py --help`.

Writes benchmarks/results/speed.jsonl, one line per work; a new measurement replaces the line of the same work.
benchmarks/figures.py turns the lines into tables and pictures.
"""

import argparse
import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from works import SIZES, WORKS, Work

from delayrl.cli.console import name_and_value

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results" / "speed.jsonl"
WAITING = {kind: ("", "passive") for kind in ("vdpo", "sb3", "cleanrl")}
"""How OpenMP's threads wait: spinning for a while (the default) or asleep. Torch is usually faster with the first on a
free machine and with the second on a busy one, so each peer is measured with the faster."""
TIMEOUT = 900
"""Seconds without a line after which a side is given up. The first line waits for compilation."""


class MeasurementError(Exception):
    """Raised in one line if a side cannot be measured."""


class Side:
    """A worker process that waits between its slices."""

    def __init__(self, python: str, side: dict[str, Any], threads: int, waiting: str = ""):
        self.name, self.side, self.waiting = side["kind"], side, waiting
        words = (side["name"], side["kind"], str(side["seeds"]), waiting)
        self._log = HERE / "logs" / ("-".join(word for word in words if word) + ".log")
        self._log.parent.mkdir(exist_ok=True)
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [python, str(HERE / "worker.py"), json.dumps(side)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=environment(threads, waiting),
            )
        self.hello = self._read()

    def slice(self, steps: int) -> dict[str, Any]:
        """Train this many steps of every seed and return the report."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has been killed: `_read` raises
            self._process.stdin.write(json.dumps({"steps": steps * self.side["seeds"]}) + "\n")
            self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """Stop the process; kill it if it is still running after 20 seconds."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], TIMEOUT)
        line = self._process.stdout.readline() if ready else ""
        if not line:
            self._process.kill()
            self.close()
            said = [words for words in self._log.read_text().splitlines() if words.strip()]
            why = said[-1] if ready and said else "it ended" if ready else f"nothing within {TIMEOUT} s"
            raise MeasurementError(f"{self.name} cannot be measured: {why} (log: {self._log})")
        return json.loads(line)


def start(python: str, side: dict[str, Any], threads: int, ways: tuple[str, ...], steps: int) -> Side:
    """Start a side with each way of waiting and keep the fastest. If one fails, close all."""
    sides: list[Side] = []
    try:
        for way in ways:
            sides.append(Side(python, side, threads, way))
        return fastest(sides, steps)
    except BaseException:
        for other in sides:
            other.close()
        raise


def fastest(sides: list[Side], steps: int) -> Side:
    """Return the fastest of these sides after three slices of each in turn, and close the others."""
    if len(sides) > 1:
        seconds = [[side.slice(steps)["seconds"] for side in sides] for _ in range(3)]
        order = np.argsort(np.median(seconds, axis=0))
        sides = [sides[i] for i in order]
    for side in sides[1:]:
        side.close()
    return sides[0]


def environment(threads: int, waiting: str = "") -> dict[str, str]:
    """Return the environment of a side: threads, room for two sides on one GPU, how torch waits (`WAITING`)."""
    return (
        {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        | ({"OMP_WAIT_POLICY": waiting} if waiting else {})
        | {
            "OMP_NUM_THREADS": str(threads),
            "MKL_NUM_THREADS": str(threads),
            "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.3",
            "PYTHONUNBUFFERED": "1",
        }
    )


def quartiles(values: list[float]) -> dict[str, float]:
    """Return the median and the quartiles around it."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return {"median": float(f"{middle:.4g}"), "low": float(f"{low:.4g}"), "high": float(f"{high:.4g}")}


def summary(side: dict[str, Any], steps: int, slices: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise one side of a row, in seconds per environment step of one seed."""
    count = steps * side["seeds"]
    seconds = [s["seconds"] / count for s in slices]
    parts = {name for s in slices for name in s.get("parts", {})}
    return {
        "kind": side["kind"],
        "seeds": side["seeds"],
        "seconds": quartiles(seconds),
        "steps_per_second": float(f"{1 / np.median(seconds):.4g}"),
        "processor": quartiles([s["processor"] / count for s in slices]),
        "peak_bytes": max(s["peak_bytes"] for s in slices),
        "slices": [float(f"{s:.4g}") for s in seconds],
    } | (
        {"parts": {p: quartiles([s["parts"].get(p, 0) / count for s in slices]) for p in sorted(parts)}}
        if parts
        else {}
    )


def compare(work: Work, args: argparse.Namespace) -> dict[str, Any] | None:
    """Measure a work on all available sides, slice by slice in turn. Return a row, or None if ours fails."""
    steps = args.steps or work.steps[args.device]
    sides = {role: complete(side, work, steps, args) for role, side in work.sides.items()}
    open_sides: dict[str, Side] = {}
    try:
        for role, side in sides.items():
            python = interpreter(side["kind"], args)
            if python is None:
                if role == "ours":
                    raise MeasurementError(f"{work.name} is ours alone")
                say(f"  {side['kind']} is left out: no environment given")
                continue
            try:
                ways = WAITING.get(side["kind"], ("",)) if args.device == "cpu" else ("",)
                open_sides[role] = start(python, side, args.threads, ways, steps)
            except MeasurementError as error:
                say(f"  {error}")
                if role == "ours":
                    return None
        slices: dict[str, list[dict[str, Any]]] = {role: [] for role in open_sides}
        load: list[float] = []
        until = time.perf_counter() + args.seconds
        number = 0
        while number < args.rounds or (number < args.most and time.perf_counter() < until):
            for role, side_process in open_sides.items():
                slices[role].append(side_process.slice(steps))
            load.append(os.getloadavg()[0])
            number += 1
    finally:
        for side_process in open_sides.values():
            side_process.close()
    row: dict[str, Any] = {
        "work": work.name,
        "title": work.title + f"; Python {sys.version_info.major}.{sys.version_info.minor}" * work.pythons,
        "device": args.device,
        "threads": args.threads,
        "steps": steps,
        "load": quartiles(load),
        "date": time.strftime("%Y-%m-%d"),
        "versions": open_sides["ours"].hello["versions"],
        "task": sides["ours"]["env"],
        "delay": sides["ours"]["delay"],
        "agent": sides["ours"]["agent"],
        "preset": sides["ours"]["preset"],
        "options": sides["ours"]["options"],
        "ours": summary(sides["ours"], steps, slices["ours"]),
    }
    if "peer" in open_sides:
        row["peer"] = summary(sides["peer"], steps, slices["peer"])
        row["peer"]["waiting"] = open_sides["peer"].waiting or "default"
        row["peer"]["packages"] = open_sides["peer"].hello["packages"]
        row |= ratios(slices["ours"], slices["peer"], sides["ours"]["seeds"], sides["peer"]["seeds"])
    if not args.no_floor:
        row["floor"] = floor(sides["ours"], args)
    return row


def ratios(ours: list[dict[str, Any]], peer: list[dict[str, Any]], our_seeds: int, peer_seeds: int) -> dict[str, Any]:
    """Return the peer's time divided by ours, per pair of neighbouring slices and per step of one seed."""
    scale = our_seeds / peer_seeds
    return {
        name: quartiles([scale * p[key] / o[key] for o, p in zip(ours, peer, strict=True)])
        for name, key in (("ratio", "seconds"), ("processor_ratio", "processor"))
    }


def floor(side: dict[str, Any], args: argparse.Namespace) -> dict[str, Any] | None:
    """Run floor.py in its own process and return the times of the parts and the floor; None if it fails."""
    done = subprocess.run(
        [sys.executable, str(HERE / "floor.py"), json.dumps(side)],
        capture_output=True,
        text=True,
        env=environment(args.threads),
    )
    if done.returncode:
        say(f"  no floor: {(done.stderr.strip().splitlines() or ['it ended'])[-1]}")
        return None
    return json.loads(done.stdout.splitlines()[-1])


def complete(side: dict[str, Any], work: Work, steps: int, args: argparse.Namespace) -> dict[str, Any]:
    """Add all that the worker needs to a side. Cloning once per slice keeps the scheduled one KL update per step."""
    options = dict(side.get("options", {}))
    if side.get("agent") == "vdpo":
        options |= {"clone_every": steps, "clone_updates": steps}
    if side["kind"] == "vdpo":
        options |= {"kl_freq": steps}
    if side["kind"] == "ours":
        options |= dict(args.set)
    path = {"vdpo": args.vdpo, "cleanrl": args.cleanrl}.get(side["kind"])
    fixed = {
        "name": work.name,
        "device": args.device,
        "path": path and str(Path(path).resolve()),
        "warmup": steps + 4,
    }
    return {"seeds": 1, "delay": 0, **fixed, **side, "options": options}


def interpreter(kind: str, args: argparse.Namespace) -> str | None:
    """Return the Python of a side's environment; None if the user gave none."""
    if kind in ("ours", "dummy"):
        return sys.executable
    if kind == "sbx":
        return args.jax_python
    if (kind == "vdpo" and not args.vdpo) or (kind == "cleanrl" and not args.cleanrl):
        return None
    return args.torch_python


def write(row: dict[str, Any], path: Path) -> None:
    """Replace the row of the same work, title, device and threads."""
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    names = (
        ("work", "title", "device", "threads")
        if (WORKS | SIZES)[row["work"]].pythons
        else ("work", "device", "threads")
    )
    kept = [line for line in lines if any(line[name] != row[name] for name in names)]
    order = [*WORKS, *SIZES]
    kept = [line for line in [*kept, row] if line["work"] in order]
    kept.sort(key=lambda line: (line["device"], order.index(line["work"]), -line["threads"]))
    path.write_text("".join(json.dumps(line) + "\n" for line in kept))


def say(words: str) -> None:
    """Print to stderr at once."""
    print(words, file=sys.stderr, flush=True)


def report(row: dict[str, Any]) -> str:
    """Summarise a row in one line."""
    ours = row["ours"]
    words = f"  ours {1e3 * ours['seconds']['median']:.2f} ms ({ours['steps_per_second']:.0f} steps/s)"
    if "peer" in row:
        ratio = row["ratio"]
        words += f", {row['peer']['kind']} {1e3 * row['peer']['seconds']['median']:.2f} ms; "
        words += f"ratio {ratio['median']:.2f} ({ratio['low']:.2f} to {ratio['high']:.2f})"
        words += f", of processor time {row['processor_ratio']['median']:.2f}"
    return words + f"; load {row['load']['median']:.1f}"


def arguments() -> argparse.Namespace:
    """Parse the command line; the default effort depends on what is measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("works", nargs="*", help="names of works (--list); default: all of the device")
    parser.add_argument("--list", action="store_true", help="list the works and exit")
    parser.add_argument("--sizes", action="store_true", help="measure cost against size instead, ours alone")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--vdpo", metavar="PATH", help="a checkout of VDPO's released code")
    parser.add_argument("--cleanrl", metavar="PATH", help="a checkout of CleanRL")
    parser.add_argument("--torch-python", metavar="PYTHON", help="Python with torch: Stable-Baselines3, CleanRL, VDPO")
    parser.add_argument("--jax-python", metavar="PYTHON", help="Python with SBX")
    parser.add_argument("--threads", type=int, default=min(os.cpu_count() or 1, 16), help="cores for each side")
    parser.add_argument("--rounds", type=int, help="at least this many slices per side (9; 5 on a GPU, 3 with --sizes)")
    parser.add_argument("--most", type=int, default=41, help="at most this many slices per side")
    parser.add_argument("--seconds", type=float, help="continue beyond --rounds for this long (30; 3 with --sizes)")
    parser.add_argument("--steps", type=int, help="environment steps of a slice")
    parser.add_argument(
        "--set", type=name_and_value, action="append", default=[], metavar="NAME=VALUE", help="set our option"
    )
    parser.add_argument("--no-floor", action="store_true", help="skip parts and floor")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    if args.rounds is None:
        args.rounds = 3 if args.sizes else 5 if args.device == "gpu" else 9
    if args.seconds is None:
        args.seconds = 3 if args.sizes else 30
    return args


def main() -> int:
    """Measure the requested works and write each row as soon as it is complete."""
    args = arguments()
    known = WORKS | SIZES
    if args.list:
        for work in known.values():
            print(f"{work.name:24s} {work.title}")
        return 0
    if unknown := [name for name in args.works if name not in known]:
        say(f"unknown work {', '.join(unknown)}; choose from {', '.join(known)}")
        return 2
    for name, path in (("--vdpo", args.vdpo), ("--cleanrl", args.cleanrl)):
        if path and not Path(path).is_dir():
            say(f"{name}: {path} is not a folder; give the path of a checkout")
            return 2
    for name, python in (("--torch-python", args.torch_python), ("--jax-python", args.jax_python)):
        if python and not shutil.which(python):
            say(f"{name}: {python} cannot be started; give the path of a Python")
            return 2
    if not args.out.parent.is_dir():
        say(f"--out: no folder {args.out.parent}; create it first")
        return 2
    if args.set and args.out == RESULTS:
        say("--set changes the works that the table describes; give --out FILE")
        return 2
    chosen = args.works or [w.name for w in (SIZES if args.sizes else WORKS).values() if args.device in w.steps]
    if not chosen:
        say(f"no such works are defined for {args.device}; name works and give --steps")
        return 2
    if elsewhere := [name for name in chosen if not args.steps and args.device not in known[name].steps]:
        say(f"{', '.join(elsewhere)} has no slice length for {args.device}; give --steps")
        return 2
    began, status = time.perf_counter(), 0
    for number, name in enumerate(chosen):
        gone = time.perf_counter() - began
        left = f", about {gone / number * (len(chosen) - number) / 60:.0f} min left" if number else ""
        say(f"{name} ({number + 1} of {len(chosen)}{left})")
        try:
            row = compare(known[name], args)
        except MeasurementError as error:
            say(f"  {error}")
            row = None
        if row:
            write(row, args.out)
            say(report(row))
        else:
            status = 2
    return status


if __name__ == "__main__":
    sys.exit(main())
