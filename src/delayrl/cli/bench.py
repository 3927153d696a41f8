"""`delayrl bench`: plan, run, status, collect, report."""

import argparse
import re
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

from delayrl.bench import folders
from delayrl.bench.grid import Cell, Grid, load_grid, shipped
from delayrl.bench.status import Standing, duration, line, standing, status, table
from delayrl.cli.main import Parser
from delayrl.errors import DelayRLError


def bench(arguments: list[str]) -> None:
    """Entry point of `delayrl bench`."""
    parser = Parser(prog="delayrl bench", description="Run a grid of agents, tasks, delays and seeds.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, what: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=what, description=what)
        names = ", ".join(shipped())
        sub.add_argument("grid", metavar="GRID", help=f"a .toml file, or one of {names}")
        sub.add_argument(
            "--runs", type=Path, default=Path("runs/bench"), help="folder of the cells (default: runs/bench)"
        )
        return sub

    command("plan", "list the cells of a grid, and which are done")
    run = command("run", "work on a grid; the same command goes on")
    run.add_argument("--cells", nargs="+", metavar="ID", help="only these")
    run.add_argument("--backend", choices=["local", "slurm", "ray"], default="local", help="(default: local)")
    run.add_argument(
        "--workers", type=int, metavar="N", help="cells at a time (default: half of the cores; one with a GPU)"
    )
    run.add_argument("--time-limit", type=seconds, metavar="TIME", help="stop at a checkpoint then, e.g. 9m or 1h30m")
    run.add_argument(
        "--tries",
        type=int,
        default=5,
        metavar="N",
        help="times in a row that a cell may die with nothing new (default: 5)",
    )
    run.add_argument("--device", choices=["cpu", "gpu"], help="(default: what JAX finds)")
    run.add_argument(
        "--sbatch", action="append", default=[], metavar="OPTION", help="slurm: e.g. --sbatch=--partition=gpu"
    )
    run.add_argument("--submit", action="store_true", help="slurm: hand the script to sbatch too")
    run.add_argument("--address", help="ray: HOST:PORT of a cluster, or auto (default: one of its own here)")
    run.add_argument("--cpus", type=float, default=1.0, help="ray: cores for each cell (default: 1)")
    run.add_argument("--gpus", type=float, default=0.0, help="ray: GPUs for each cell (default: 0)")
    command("status", "progress, speed, time left, failures").add_argument(
        "--workers", type=int, default=1, metavar="N", help="for the time left: cells at a time (default: 1)"
    )
    command("collect", "write the rows of a grid into one SQLite table").add_argument(
        "--out", type=Path, help="the table (default: GRID.sqlite in the folder of the cells)"
    )
    command("report", "tables, curves and one HTML page of what is there").add_argument(
        "--out", type=Path, metavar="DIR", help="a folder (default: GRID-report in the folder of the cells)"
    )
    given = parser.parse_args(arguments)
    if given.command == "report" and given.grid.endswith(".sqlite"):
        _report_table(Path(given.grid), given)
        return
    grid = load_grid(given.grid)
    if given.command != "plan":
        _claim(grid, given, look=True)
    if given.command == "run":
        _check_backend(run, given)
    {"plan": _plan, "run": _run, "status": _status, "collect": _collect, "report": _report}[given.command](grid, given)


def _plan(grid: Grid, given: argparse.Namespace) -> None:
    for cell in grid.cells:
        print(f"{cell.id}  {status(cell, given.runs):<7}  {cell}, preset {cell.preset}, {cell.steps:,} steps")
    runs = sum(len(cell.seeds) for cell in grid.cells)
    steps = sum(cell.steps * len(cell.seeds) for cell in grid.cells)
    print(f"\n{grid.name}: {len(grid.cells)} cells, {runs} runs, {steps:,} steps")
    print(grid.description) if grid.description else None


def _status(grid: Grid, given: argparse.Namespace) -> None:
    _at_least_one("--workers", given.workers)
    print(table(grid, given.runs, given.workers))


def _collect(grid: Grid, given: argparse.Namespace) -> None:
    from delayrl.bench.results import collect

    out = given.out or given.runs / f"{grid.name}.sqlite"
    count = collect(grid, given.runs, out)
    done = sum(status(cell, given.runs) == "done" for cell in grid.cells)
    print(f"{out}: {count:,} rows; {done} of {len(grid.cells)} cells are done")


def _report(grid: Grid, given: argparse.Namespace) -> None:
    from delayrl.bench.results import rows_of, versions_of

    out = given.out or given.runs / f"{grid.name}-report"
    rows, used = rows_of(grid.cells, given.runs), versions_of(grid.cells, given.runs)
    _write_report(rows, standing(grid.cells, given.runs), out, grid.name, used)


def _report_table(table: Path, given: argparse.Namespace) -> None:
    from delayrl.bench.results import read_table

    rows, cells, used = read_table(table)
    _write_report(rows, cells, given.out or table.with_name(f"{table.stem}-report"), table.stem, used)


def _write_report(
    rows: Iterable[dict[str, Any]], cells: Standing, out: Path, title: str, versions: list[dict[str, Any]]
) -> None:
    from delayrl.report.report import report
    from delayrl.report.summary import Cell as Shown

    shown = [
        Shown(c.id, c.agent, c.env, c.label, c.preset, c.protocol, c.seeds, c.overrides, p.state, p.step, c.steps)
        for c, p in cells
    ]
    print(f"open {report(rows, shown, out, title, versions)}; the same as Markdown lies beside it")


def _run(grid: Grid, given: argparse.Namespace) -> None:
    from delayrl.bench.runner import STOPPED, Backend, Local, default_workers, work_off

    cells = _chosen(grid, given.cells)
    _at_least_one("--tries", given.tries)
    _at_least_one("--workers", given.workers)
    _claim(grid, given, look=False)
    if given.backend == "slurm":
        _slurm(grid, cells, given)
        return
    workers = given.workers or default_workers(given.device)
    backend: Backend = Local(given.runs, workers, given.device)
    if given.backend == "ray":
        from delayrl.bench.ray import OnRay

        backend = OnRay(given.runs, given.address, given.workers, given.cpus, given.gpus, given.device)
        workers = max(1, backend.room())
    live = _Live(cells, given.runs, workers)
    with _asked_to_stop() as stop:
        report = work_off(
            cells,
            given.runs,
            backend,
            tries=given.tries,
            time_limit=given.time_limit,
            stop=stop,
            say=live.say,
            tick=live.tick,
        )
    live.end()
    print(f"{grid.name}: {len(report.done)} of {len(cells)} cells done")
    if report.failed:
        first = next(iter(report.failed.values()))
        count = f"{len(report.failed)} of {len(cells)} cells failed"
        raise DelayRLError(f"{count}, the first: {first} (`delayrl bench status` has them all)")
    if report.left:
        print("stopped at a checkpoint; the same command goes on")
        sys.exit(STOPPED)


def _slurm(grid: Grid, cells: Sequence[Cell], given: argparse.Namespace) -> None:
    from delayrl.bench import slurm

    left = [cell for cell in cells if status(cell, given.runs) != "done"]
    if not left:
        print(f"{grid.name}: all {len(cells)} cells are done")
        return
    words = ["--tries", str(given.tries), "--workers", "1", *(["--device", given.device] if given.device else [])]
    text = slurm.script(grid, left, given.runs, time_limit=given.time_limit, options=given.sbatch, arguments=words)
    file = slurm.write(grid, left, given.runs, text)
    print(f"{file}: {len(left)} cells")
    print(f"submitted as job {slurm.submit(file)}" if given.submit else f"next: sbatch {file}")


def _claim(grid: Grid, given: argparse.Namespace, look: bool) -> None:
    folders.claim(given.runs, grid.name, grid.source, grid.ids, grid.is_shipped, look)


def _chosen(grid: Grid, ids: list[str] | None) -> list[Cell]:
    if ids is None:
        return list(grid.cells)
    for word in ids:
        if word not in grid.ids:
            raise DelayRLError(f"{grid.name} has no cell {word}; `delayrl bench plan` lists them")
    return [cell for cell in grid.cells if cell.id in ids]


def _check_backend(run: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """DelayRLError for an option that the chosen backend does not have: it would be ignored in silence."""
    for backend, names in {"slurm": ("sbatch", "submit"), "ray": ("address", "cpus", "gpus")}.items():
        for name in names:
            if given.backend != backend and getattr(given, name) != run.get_default(name):
                raise DelayRLError(f"--{name} needs --backend {backend}; got --backend {given.backend}")


def _at_least_one(name: str, value: int | None) -> None:
    if value is not None and value < 1:
        raise DelayRLError(f"{name} must be at least 1; got {value}")


def seconds(text: str) -> float:
    """A time such as 90s, 9m, 1h30m or 2d, in seconds."""
    parts = re.fullmatch(r"(?:(\d+)d)?(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?", text.strip())
    units = (86400, 3600, 60, 1)
    total = sum(int(n or 0) * unit for n, unit in zip(parts.groups(), units, strict=True)) if parts else 0
    if not total:
        raise DelayRLError(f"a time is written as 90s, 9m, 1h30m or 2d, and is longer than nothing; got {text!r}")
    return total


@contextmanager
def _asked_to_stop() -> Iterator[Event]:
    event = Event()
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(kind, lambda *_: event.set()) for kind in kinds]
    try:
        yield event
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)


class _Live:
    """A line on stderr that says where the grid stands: rewritten on a terminal, now and then in a log."""

    def __init__(self, cells: Sequence[Cell], runs: Path, workers: int):
        self._cells, self._runs, self._workers = cells, runs, workers
        self._terminal = sys.stderr.isatty()
        self._every = 1.0 if self._terminal else 30.0
        self._next, self._began = 0.0, time.monotonic()

    def say(self, text: str) -> None:
        """A line that stays."""
        self.end()
        print(text, file=sys.stderr, flush=True)
        self._next = 0.0 if self._terminal else self._next

    def tick(self) -> None:
        """Show where it stands, if it is time."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + self._every
        text = f"{duration(now - self._began)}: {line(standing(self._cells, self._runs), self._workers)}"
        print(
            f"\r\033[K{text}" if self._terminal else text,
            end="" if self._terminal else "\n",
            file=sys.stderr,
            flush=True,
        )

    def end(self) -> None:
        """Remove the line that is rewritten."""
        if self._terminal:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
