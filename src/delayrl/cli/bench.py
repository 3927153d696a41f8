"""`delayrl bench`: plan, run, status, collect and report a grid."""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from delayrl.bench import folders
from delayrl.bench.grid import Grid, load_grid, shipped
from delayrl.bench.status import HEAD, closing_lines, duration, failures, is_damaged, line, progress, standing, table
from delayrl.cli.console import StatusLine, positive, print_table
from delayrl.errors import STOPPED, DelayRLError, count
from delayrl.run.cell import Cell
from delayrl.training.signals import stop_signal

BACKEND_OPTIONS: dict[str, dict[str, Any]] = {
    "slurm": {"sbatch": [], "submit": False},
    "ray": {"address": None, "cpus": 1.0, "gpus": 0.0},
}
"""Defaults of the options that only one backend has."""
SQLITE = b"SQLite format 3\x00"
"""How a SQLite file begins."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the commands on a grid, each with its options."""
    commands = parser.add_subparsers(dest="action", metavar="COMMAND", required=True)

    def add_command(name: str, text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text)
        table = ", a table that `collect` wrote" if name == "report" else ""
        command.add_argument("grid", metavar="GRID", help=f"a .toml file{table}, or one of {', '.join(shipped())}")
        command.add_argument("--runs", type=Path, default="runs/bench", help="the cells' folder (default: runs/bench)")
        return command

    add_command("plan", "list the cells of a grid, and which are done")
    run = add_command("run", "run a grid; the same command resumes it")
    run.set_defaults(**BACKEND_OPTIONS["slurm"], **BACKEND_OPTIONS["ray"])
    add = run.add_argument
    add("--cells", nargs="+", action="extend", metavar="ID", help="only these cells")
    add("--backend", choices=["local", "slurm", "ray"], default="local", help="(default: local)")
    add("--workers", type=positive, metavar="N", help="cells at a time (default: one a core, or one with a GPU)")
    add("--time-limit", type=time_limit, metavar="TIME", help="stop at a checkpoint after, e.g., 9m or 1h30m")
    add(
        "--tries", type=positive, default=5, metavar="N", help="deaths of a cell in a row with nothing new (default: 5)"
    )
    add("--device", choices=["cpu", "gpu"], help="(default: JAX's choice)")
    add("--sbatch", action="append", metavar="OPTION", help="slurm: e.g. --sbatch=--partition=gpu")
    add("--submit", action="store_true", help="slurm: pass the script to sbatch as well")
    add("--address", help="ray: HOST:PORT of a cluster, or auto (default: a local one)")
    add("--cpus", type=float, help="ray: cores for each cell (default: 1)")
    add("--gpus", type=float, help="ray: GPUs for each cell (default: 0)")
    add = add_command("status", "show progress, speed, time left and failures").add_argument
    add("--workers", type=positive, default=1, metavar="N", help="cells at a time, for the time left (default: 1)")
    add = add_command("collect", "write the rows of a grid into one SQLite table").add_argument
    add("--out", type=Path, help="the table (default: GRID.sqlite in the folder of the cells)")
    words = "also take cells from this table: of another machine, or of a grid that shares them"
    add("--also", type=Path, action="append", default=[], metavar="TABLE", help=words)
    add = add_command("report", "write tables, curves and one HTML page of the results so far").add_argument
    add("--out", type=Path, metavar="DIR", help="a folder (default: GRID-report in the folder of the cells)")


def run(given: argparse.Namespace) -> None:
    """Run a command on a grid."""
    if given.action == "report" and _is_table(given.grid):
        _report(None, given)
        return
    grid = load_grid(given.grid)
    if given.action != "plan":
        folders.claim(given.runs, grid, check_only=True)
    {"plan": _plan, "run": _run, "status": _status, "collect": _collect, "report": _report}[given.action](grid, given)


def _is_table(grid: str) -> bool:
    """Tell whether the argument is a table. `collect --out` gives it any name, so its first bytes count."""
    if grid.endswith(".sqlite"):  # if it is none, reading it says what is wrong
        return True
    if grid in shipped() or not Path(grid).is_file():
        return False
    with open(grid, "rb") as file:
        return file.read(len(SQLITE)) == SQLITE


def _plan(grid: Grid, given: argparse.Namespace) -> None:
    changed = [{f"{k}={v}" for k, v in cell.condition.overrides.items() if k != "steps"} for cell in grid.cells]
    everywhere = set.intersection(*changed) if len(changed) > 1 else set()
    for cell, own in zip(grid.cells, changed, strict=True):
        condition = cell.condition
        setup = [f"preset {condition.preset}", f"{condition.steps:,} steps", *sorted(own - everywhere)]
        print(f"{cell.id}  {progress(cell, given.runs).state:<7}  {cell}, {', '.join(setup)}")
    if everywhere:
        print(f"\nall cells: {', '.join(sorted(everywhere))}")
    runs = sum(len(cell.seeds) for cell in grid.cells)
    steps = sum(cell.condition.steps * len(cell.seeds) for cell in grid.cells)
    print(f"\n{grid.name}: {count(len(grid.cells), 'cell')}, {count(runs, 'run')}, {count(steps, 'step')}")
    if grid.description:
        print(grid.description)


def _status(grid: Grid, given: argparse.Namespace) -> None:
    cells = standing(grid.cells, given.runs)
    print_table(HEAD, table(cells))
    print("", *closing_lines(grid.name, cells, given.workers), sep="\n")


def _collect(grid: Grid, given: argparse.Namespace) -> None:
    from delayrl.bench.results import cells_done, collect

    out = given.out or given.runs / f"{grid.name}.sqlite"
    rows = collect(grid, given.runs, out, given.also)
    print(f"{out}: {rows:,} rows; {cells_done(out)} of {len(grid.cells)} cells are done")


def _report(grid: Grid | None, given: argparse.Namespace) -> None:
    """Report a grid, or the table in the file that was named instead of one."""
    from delayrl.bench.results import configs_of, read_table, rows_of
    from delayrl.report.report import report

    rows: Any
    if grid is None:
        folder, name = Path(given.grid).parent, Path(given.grid).stem
        rows, cells, configs, description = read_table(Path(given.grid))
    else:
        folder, name, description = given.runs, grid.name, grid.description
        cells = standing(grid.cells, given.runs)
        whole = [cell for cell, progress in cells if not is_damaged(cell, given.runs, progress)]
        rows, configs = rows_of(whole, given.runs), configs_of(whole, given.runs)
    page = report(rows, cells, given.out or folder / f"{name}-report", name, configs, description)
    done = sum(progress.state == "done" for _, progress in cells)
    print(f"{name}: {done} of {len(cells)} cells are done\nopen {page}; the same as Markdown is beside it")
    for failure in failures(cells):
        print(failure, file=sys.stderr)


def _run(grid: Grid, given: argparse.Namespace) -> None:
    from delayrl.bench.runner import run_cells

    _check_backend(given)
    cells = _chosen(grid, given.cells)
    folders.claim(given.runs, grid)
    if given.backend == "slurm":
        _write_slurm(grid, cells, given)
        return
    backend, workers = _backend(given, grid)
    words = idle(cells, workers) if given.backend == "local" else ""
    if words and not any(folders.stored(given.runs / cell.folder, cell.seeds)[0] for cell in cells):
        print(words, file=sys.stderr)
    status_line = StatusLine(lambda elapsed: f"{duration(elapsed)}: {line(standing(cells, given.runs), workers)}")
    with stop_signal(patient=True) as stop:  # its workers have a minute
        tries, limit, say, tick = given.tries, given.time_limit, status_line.say, status_line.update
        completion = run_cells(cells, given.runs, backend, tries=tries, time_limit=limit, stop=stop, say=say, tick=tick)
    status_line.clear()
    print(f"{grid.name}: {len(completion.done)} of {len(cells)} cells done")
    if completion.failed:
        first = next(iter(completion.failed.values()))
        number = f"{len(completion.failed)} of {len(cells)} cells failed"
        failure = f"{number}, the first: {first} (`delayrl bench status` lists all)"
        if not completion.unfinished:
            raise DelayRLError(failure)
        print(failure, file=sys.stderr)
    if completion.unfinished:
        print("stopped at a checkpoint; the same command resumes it")
        sys.exit(STOPPED)


def idle(cells: Sequence[Cell], workers: int) -> str:
    """Return how a grid with fewer cells than workers would keep all of them busy, or "".

    Only before anything is stored: `lockstep` is part of a cell's id, so another one begins anew.
    """
    runs = sum(len(cell.seeds) for cell in cells)
    if not len(cells) < min(workers, runs):
        return ""
    most = max(1, runs // workers)
    left = f"{workers - len(cells)} of {workers} workers have no cell"
    return f"{left}; with `lockstep = {most}` in the grid there are more cells, of at most {most} seeds each"


def _backend(given: argparse.Namespace, grid: Grid) -> tuple[Any, int]:
    """Return the backend, and how many cells it runs at a time."""
    if given.backend == "ray":
        from delayrl.bench.backends.ray import RayBackend

        ray = RayBackend(given.runs, given.address, given.workers, given.cpus, given.gpus, given.device)
        return ray, max(1, ray.room())
    from delayrl.bench.backends.local import LocalBackend, default_workers

    workers = given.workers or default_workers(given.device, grid.replay_bytes)
    return LocalBackend(given.runs, workers, given.device), workers


def _write_slurm(grid: Grid, cells: Sequence[Cell], given: argparse.Namespace) -> None:
    from delayrl.bench.backends import slurm

    left = [cell for cell in cells if progress(cell, given.runs).state != "done"]
    if not left:
        print(f"{grid.name}: all {len(cells)} cells are done")
        return
    words = ["--tries", str(given.tries), "--workers", "1", *(["--device", given.device] if given.device else [])]
    limits = {"time_limit": given.time_limit, "workers": given.workers}
    text = slurm.script(grid, left, given.runs, **limits, options=given.sbatch, arguments=words)
    file = slurm.write(grid, left, given.runs, text)
    print(f"{file}: {len(left)} cells")
    print(f"submitted as job {slurm.submit(file)}" if given.submit else f"next: sbatch {file}")


def _chosen(grid: Grid, ids: list[str] | None) -> list[Cell]:
    for word in ids or ():
        if word not in grid.ids:
            raise DelayRLError(f"{grid.name} has no cell {word}; `delayrl bench plan` lists them")
    return [cell for cell in grid.cells if ids is None or cell.id in ids]


def _check_backend(given: argparse.Namespace) -> None:
    """Raise DelayRLError for an option of another backend, which would be ignored."""
    for backend, options in BACKEND_OPTIONS.items():
        for name, default in options.items():
            if given.backend != backend and getattr(given, name) != default:
                raise DelayRLError(f"--{name} needs --backend {backend}; got --backend {given.backend}")


def time_limit(text: str) -> int:
    """Return the seconds of a time such as 90s, 9m, 1h30m or 2d. Raises DelayRLError for another text."""
    match = re.fullmatch(r"(?:(\d+)d)?(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?", text.strip())
    days, hours, minutes, rest = (int(part or 0) for part in match.groups()) if match else (0, 0, 0, 0)
    total = 86400 * days + 3600 * hours + 60 * minutes + rest
    if not total:
        raise DelayRLError(f"a time is written as 90s, 9m, 1h30m or 2d, and is above 0; got {text!r}")
    return total
