"""What is stored of a cell: its lock, its journal and its newest step. No JAX.

```
RUNS/grids/NAME.json             the grid file that has this name here
RUNS/TASK-delayN-AGENT-ID/       a cell; grids that contain the same cell share its folder
    cell.json                    its condition and seeds
    lock                         locked by the process that works on the cell
    journal.jsonl                begun, done, stopped, failed: when, where
    worker.log                   stderr of the last try
    seed0/ seed1/ …              run folders
```
"""

import contextlib
import json
import math
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from delayrl.errors import DelayRLError
from delayrl.run.checkpoint import Checkpoint, checkpoint_folders, read_checkpoint
from delayrl.run.disk import disk_errors, lock, parsed, write_file
from delayrl.run.folder import RunFolder

if TYPE_CHECKING:
    from delayrl.bench.grid import Grid
    from delayrl.run.cell import Cell


class LockedError(Exception):
    """Another process works on the cell."""


@contextlib.contextmanager
def hold_cell(folder: Path) -> Iterator[None]:
    """Lock a cell until the block or the process ends, however it ends.

    Raises:
        LockedError: another process still holds it after a second; `holder` takes it for a moment.
    """
    file = folder / "lock"
    file.touch()
    with lock(file, patience=1) as free:
        if not free:
            raise LockedError
        with contextlib.suppress(OSError):  # on a full disk the lock holds all the same
            file.write_text(f"{platform.node()} {os.getpid()}\n")
        yield


def holder(folder: Path) -> str | None:
    """Return the host and process id that hold the cell, or None."""
    file = folder / "lock"
    with contextlib.suppress(OSError), lock(file, shared=True) as free:  # there is none, or the disk does not answer
        return None if free else file.read_text().strip() or "another process"
    return None


def note(folder: Path, event: str, **details: Any) -> None:
    """Append an event to the cell's journal. Raises DelayRLError if the disk refuses."""
    line = {"event": event, "time": round(time.time(), 1), "host": platform.node(), **details}
    with disk_errors(folder), open(folder / "journal.jsonl", "a+b") as file:
        file.seek(-1 if file.tell() else 0, os.SEEK_END)
        cut = file.read() not in (b"", b"\n")  # the last line, by a crash or a full disk
        file.write(b"\n" * cut + json.dumps(line).encode() + b"\n")


def journal(folder: Path) -> list[dict[str, Any]]:
    """Return the cell's events, oldest first. Lines that a crash cut off, or a disk damaged, are ignored."""
    found = map(_loaded, _text(folder / "journal.jsonl").splitlines())
    return [event for event in found if "event" in event]


def seed_paths(folder: Path, seeds: tuple[int, ...]) -> list[Path]:
    """Return the run folder of each seed."""
    return [folder / f"seed{seed}" for seed in seeds]


def stored(folder: Path, seeds: tuple[int, ...]) -> tuple[int, bool]:
    """Return the step up to which every seed is stored, and whether the cell is complete."""
    steps, complete = [], []
    for run in seed_paths(folder, seeds):
        newest = _newest_checkpoint(run)
        steps.append(newest.step if newest else 0)
        # a complete run that still has a replay was killed before it could delete it
        complete.append(newest is not None and newest.complete and not os.path.exists(run / "replay"))
    return min(steps), all(complete)


def damage(folder: Path, cell: "Cell") -> str:
    """Return what has become of a complete cell's runs, and what to do about it, or "" if they look whole.

    Of each run this reads the configuration and the last row alone: what may be missing before is not looked for.
    """
    try:
        with advised(folder):
            for run in seed_paths(folder, cell.seeds):
                check_length(RunFolder(run), cell)
                if _last_line(run / "rows.jsonl").get("step") != cell.condition.steps:
                    raise DelayRLError(f"{run} ended, but rows of the last evaluation are missing")
    except DelayRLError as error:
        return str(error)
    return ""


def check_length(run: RunFolder, cell: "Cell") -> None:
    """Raise DelayRLError if a cell's run has other steps than the cell, or its configuration is damaged or gone."""
    if not run.exists:
        raise DelayRLError(f"{run.path} has lost its config.json")
    if (trained := run.config["schedule"]["steps"]) != cell.condition.steps:
        line = f"{run.path} was trained for {trained:,} steps, and its cell for {cell.condition.steps:,}"
        raise DelayRLError(line)


@contextlib.contextmanager
def advised(folder: Path) -> Iterator[None]:
    """Add to an error how to get a cell with a damaged run: its seeds begin together."""
    try:
        yield
    except DelayRLError as error:
        raise DelayRLError(f"{error}: move {folder} elsewhere, and run the cell again") from error


def newest_metrics(run: Path) -> dict[str, Any]:
    """Return the numbers in the last complete line of a run's metrics, or an empty dict if there is none."""
    found = _last_line(run / "metrics.jsonl")
    return {name: value for name, value in found.items() if isinstance(value, int | float) and abs(value) < math.inf}


def _last_line(file: Path) -> dict[str, Any]:
    """Return the object in the last complete line of a file, empty if there is none."""
    try:
        with open(file, "rb") as lines:
            end, read, block = lines.seek(0, os.SEEK_END), b"", 8192
            while len(read) < end and read.count(b"\n") < 3:  # what is before the last two may be half a line
                lines.seek(max(0, end - block))
                read, block = lines.read(end), 2 * block
        return _loaded(read.split(b"\n")[:-1][-1].decode(errors="replace"))
    except (OSError, IndexError):
        return {}


def prepare(folder: Path, cell: "Cell") -> None:
    """Make the cell's folder and write cell.json. Raises DelayRLError if the disk refuses."""
    _write(folder / "cell.json", json.dumps(cell.json | {"id": cell.id}, indent=1))


def claim(runs: Path, grid: "Grid", *, check_only: bool = False) -> None:
    """Record which file a grid's name stands for; if `check_only`, write nothing. An edited file keeps its name.

    Raises:
        DelayRLError: another file with other cells has used the name here.
    """
    file = runs / "grids" / f"{grid.name}.json"
    source = f"delayrl:{grid.name}" if grid.is_shipped else os.path.relpath(grid.source.resolve(), runs.resolve())
    claimed = {"source": source, "cells": grid.ids}
    recorded = claimed | _loaded(_text(file))
    if recorded["source"] != source and recorded["cells"] != grid.ids:
        raise DelayRLError(
            f"two grids are named {grid.name!r}: {recorded['source']} (seen from {runs}) has used the name there; "
            f'give this one another name = "…", or another --runs'
        )
    if not check_only:
        _write(file, json.dumps(claimed))


def _newest_checkpoint(run: Path) -> Checkpoint | None:
    with contextlib.suppress(DelayRLError):  # a disk may not answer for a moment
        for path in checkpoint_folders(run):
            with contextlib.suppress(DelayRLError):
                return read_checkpoint(path)
    return None


def _write(file: Path, text: str) -> None:
    """Write a file and its folder, unless it holds the text already."""
    if _text(file) != text:
        with disk_errors(file.parent):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_file(file, text.encode(), shared=True)


def _text(file: Path) -> str:
    try:
        return file.read_text(errors="replace")
    except OSError:
        return ""


def _loaded(text: str) -> dict[str, Any]:
    """Return the object that a text holds, empty if it holds none."""
    with contextlib.suppress(ValueError):
        return parsed(text)
    return {}
