"""Ours and the peers, alternating: `make bench`, or `python benchmarks/speed/run.py --help`.

Writes benchmarks/results/speed.jsonl, one line a work; a work that is measured again takes the place of its line.
Tables and pictures are made of it by benchmarks/figures.py.
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

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results" / "speed.jsonl"
WAITING = {kind: ("", "passive") for kind in ("vdpo", "sb3", "cleanrl")}
"""How OpenMP's threads may wait: as it does by default, spinning for a while, or asleep. On a free machine torch is
faster with the one, on a busy machine with the other; it is measured with whichever is faster."""
TIMEOUT = 900
"""Seconds after which a side that says nothing is given up: the first line waits for its compilation."""


class MeasurementError(Exception):
    """A side that cannot be measured, in one line."""


class Side:
    """A worker process; between its slices it waits."""

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
        """Train so many steps of every seed; the report."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has been killed: `_read` says so
            self._process.stdin.write(json.dumps({"steps": steps * self.side["seeds"]}) + "\n")
            self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """Stop it, politely first."""
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
    """A side in the way of waiting in which it is fastest. Where one fails, none is left."""
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
    """The one of these that is fastest, after three slices of each in turn; the others are closed."""
    if len(sides) > 1:
        seconds = [[side.slice(steps)["seconds"] for side in sides] for _ in range(3)]
        order = np.argsort(np.median(seconds, axis=0))
        sides = [sides[i] for i in order]
    for side in sides[1:]:
        side.close()
    return sides[0]


def environment(threads: int, waiting: str = "") -> dict[str, str]:
    """The same for every side: threads, and room for two on one GPU; and how torch's threads wait (`WAITING`)."""
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
    """Median, and the quartiles around it."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return {"median": float(f"{middle:.4g}"), "low": float(f"{low:.4g}"), "high": float(f"{high:.4g}")}


def summary(side: dict[str, Any], steps: int, slices: list[dict[str, Any]]) -> dict[str, Any]:
    """One side of a row: seconds are of one environment step of one seed."""
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
    """Measure a work on all its sides that can be, slice by slice in turn; a row."""
    steps = args.steps or work.steps[args.device]
    sides = {role: complete(side, work, steps, args) for role, side in work.sides.items()}
    open_sides: dict[str, Side] = {}
    try:
        for role, side in sides.items():
            python = interpreter(side["kind"], args)
            if python is None:
                if role == "ours":
                    raise MeasurementError(f"{work.name} is ours alone")
                say(f"  {side['kind']} is left out: its environment is not given")
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
        "title": work.title,
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
    """Peer's time over ours, each slice against the one beside it; for one environment step of one seed."""
    scale = our_seeds / peer_seeds
    return {
        name: quartiles([scale * p[key] / o[key] for o, p in zip(ours, peer, strict=True)])
        for name, key in (("ratio", "seconds"), ("processor_ratio", "processor"))
    }


def floor(side: dict[str, Any], args: argparse.Namespace) -> dict[str, Any] | None:
    """The parts' times and the floor, by floor.py in a process of its own."""
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
    """A side with all that its worker must know. Cloning once a slice is one KL update a step, as scheduled."""
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
    """The Python of a side's environment; None where the user gave none."""
    if kind in ("ours", "dummy"):
        return sys.executable
    if kind == "sbx":
        return args.jax_python
    if (kind == "vdpo" and not args.vdpo) or (kind == "cleanrl" and not args.cleanrl):
        return None
    return args.torch_python


def write(row: dict[str, Any], path: Path) -> None:
    """Put a row in the place of the one of the same work, device and threads."""
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    kept = [line for line in lines if any(line[name] != row[name] for name in ("work", "device", "threads"))]
    order = [*WORKS, *SIZES]
    kept = [line for line in [*kept, row] if line["work"] in order]
    kept.sort(key=lambda line: (line["device"], order.index(line["work"]), -line["threads"]))
    path.write_text("".join(json.dumps(line) + "\n" for line in kept))


def say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def report(row: dict[str, Any]) -> str:
    """One line of what was found."""
    ours = row["ours"]
    words = f"  ours {1e3 * ours['seconds']['median']:.2f} ms ({ours['steps_per_second']:.0f} steps/s)"
    if "peer" in row:
        ratio = row["ratio"]
        words += f", {row['peer']['kind']} {1e3 * row['peer']['seconds']['median']:.2f} ms; "
        words += f"ratio {ratio['median']:.2f} ({ratio['low']:.2f} to {ratio['high']:.2f})"
        words += f", of processor time {row['processor_ratio']['median']:.2f}"
    return words + f"; load {row['load']['median']:.1f}"


def pair(text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("works", nargs="*", help="names of works; without any, those of the device (--list shows all)")
    parser.add_argument("--list", action="store_true", help="show the works and stop")
    parser.add_argument("--sizes", action="store_true", help="measure cost against size instead: ours alone")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--vdpo", metavar="PATH", help="a checkout of VDPO's released code")
    parser.add_argument("--cleanrl", metavar="PATH", help="a checkout of CleanRL")
    parser.add_argument("--torch-python", metavar="PYTHON", help="Python with torch: Stable-Baselines3, CleanRL, VDPO")
    parser.add_argument("--jax-python", metavar="PYTHON", help="Python with SBX")
    parser.add_argument("--threads", type=int, default=min(os.cpu_count() or 1, 16), help="cores for each side")
    parser.add_argument("--rounds", type=int, help="at least so many slices of each side (9; 5 on a GPU, 3 of --sizes)")
    parser.add_argument("--most", type=int, default=41, help="at most so many")
    parser.add_argument("--seconds", type=float, help="go on beyond --rounds until so long (30; 3 of --sizes)")
    parser.add_argument("--steps", type=int, help="environment steps of a slice, for trying out")
    parser.add_argument("--set", type=pair, action="append", default=[], metavar="NAME=VALUE", help="an option of ours")
    parser.add_argument("--no-floor", action="store_true", help="without parts and floor")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    if args.rounds is None:
        args.rounds = 3 if args.sizes else 5 if args.device == "gpu" else 9
    if args.seconds is None:
        args.seconds = 3 if args.sizes else 30
    return args


def main() -> int:
    """Measure what was asked for; each row is written as soon as it is there."""
    args = arguments()
    known = WORKS | SIZES
    if args.list:
        for work in known.values():
            print(f"{work.name:24s} {work.title}")
        return 0
    if unknown := [name for name in args.works if name not in known]:
        say(f"no work {', '.join(unknown)}; there are {', '.join(known)}")
        return 2
    for name, path in (("--vdpo", args.vdpo), ("--cleanrl", args.cleanrl)):
        if path and not Path(path).is_dir():
            say(f"{name}: {path} is no folder; give a checkout")
            return 2
    for name, python in (("--torch-python", args.torch_python), ("--jax-python", args.jax_python)):
        if python and not shutil.which(python):
            say(f"{name}: {python} is no Python that can be started")
            return 2
    if not args.out.parent.is_dir():
        say(f"--out: there is no folder {args.out.parent}")
        return 2
    if args.set and args.out == RESULTS:
        say("--set measures another work than the table says: give --out, a file of its own")
        return 2
    chosen = args.works or [w.name for w in (SIZES if args.sizes else WORKS).values() if args.device in w.steps]
    if not chosen:
        say(f"there are no such works of {args.device}; name some, and give --steps")
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
