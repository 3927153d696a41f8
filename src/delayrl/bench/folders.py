"""What is on disk for a cell, without JAX: who holds it, what happened to it, and how far it is.

```
RUNS/grids/NAME.json             which grid file has this name here
RUNS/TASK-delayN-AGENT-ID/       a cell; grids that hold the same cell share it
    cell.json                    what it is
    lock                         held, as a lock of the operating system, by the process that works on it
    journal.jsonl                begun, done, stopped, failed: when, where, with which versions
    worker.log                   stderr of the last try
    seed0/ seed1/ …              run folders
```
"""

import contextlib
import json
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from delayrl.errors import DelayRLError

State = Literal["todo", "running", "done", "failed"]


class LockedError(Exception):
    """Another process works on the cell."""


@dataclass(frozen=True)
class Progress:
    """How far a cell is. `step` counts each seed's environment steps; `speed` is steps a second, where it is known."""

    state: State
    step: int
    speed: float | None
    line: str
    """First line of the failure; where a running cell is worked on."""


@contextlib.contextmanager
def hold(folder: Path, patience: float = 1.0) -> Iterator[None]:
    """Hold the cell; the system lets go of it when the process ends, however it ends.

    Raises:
        LockedError: another process holds it.
    """
    import fcntl  # POSIX

    with open(folder / "lock", "a+") as file:
        give_up = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:  # perhaps only somebody who looks: `is_held` takes a moment
                if time.monotonic() > give_up:
                    raise LockedError from None
                time.sleep(0.05)
        with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
            file.truncate(0)
            file.write(f"{platform.node()} {os.getpid()}\n")
            file.flush()
        yield


def holder(folder: Path) -> str | None:
    """Host and process that hold the cell, or None."""
    import fcntl

    try:
        with open(folder / "lock") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read().strip() or "another process"
    except FileNotFoundError:
        return None
    return None


def note(folder: Path, event: str, **more: Any) -> None:
    """Add an event to the cell's journal."""
    line = {"event": event, "time": round(time.time(), 1), "host": platform.node(), **more}
    try:
        with open(folder / "journal.jsonl", "a+b") as file:
            file.seek(-1 if file.tell() else 0, os.SEEK_END)
            cut = file.read() not in (b"", b"\n")  # by a crash, or a full disk
            file.write(b"\n" * cut + json.dumps(line).encode() + b"\n")
    except OSError as error:
        raise DelayRLError(f"cannot write to {folder}: {error.strerror}") from error


def journal(folder: Path) -> list[dict[str, Any]]:
    """The cell's events, oldest first; a line that a crash cut off is left out."""
    found = []
    for line in _text(folder / "journal.jsonl").splitlines():
        with contextlib.suppress(ValueError):
            found.append(json.loads(line))
    return found


def seed_folders(folder: Path, seeds: tuple[int, ...]) -> list[Path]:
    """The run folders of a cell."""
    return [folder / f"seed{seed}" for seed in seeds]


def stored(folder: Path, seeds: tuple[int, ...]) -> tuple[int, bool]:
    """The step to which every seed is stored, and whether the cell is complete."""
    steps, complete = [], []
    for run in seed_folders(folder, seeds):
        step, whole = 0, False
        for path in sorted((run / "checkpoints").glob("[0-9]*"), reverse=True):
            with contextlib.suppress(ValueError, KeyError, TypeError):
                manifest = json.loads(_text(path / "manifest.json"))
                step, whole = int(manifest["step"]), bool(manifest["complete"])
                break
        steps.append(step)
        complete.append(whole and not (run / "replay").exists())  # else the last clearing up is to come
    return min(steps), all(complete)


def progress(folder: Path, seeds: tuple[int, ...]) -> Progress:
    """How far a cell is."""
    step, complete = stored(folder, seeds)
    who = holder(folder)
    events = journal(folder)
    metrics = _last(folder / f"seed{seeds[0]}" / "metrics.jsonl")
    speed = metrics.get("steps_per_second")
    if complete and who is None:
        return Progress("done", step, speed, "")
    if who is not None:
        return Progress("running", max(step, int(metrics.get("step", 0))), speed, who)
    if events and events[-1]["event"] == "failed":
        return Progress("failed", step, speed, str(events[-1].get("line", "")))
    return Progress("todo", step, speed, "")


def prepare(folder: Path, cell: Any) -> None:
    """Make the cell's folder and say in it what it is."""
    text = json.dumps(asdict(cell) | {"seeds": list(cell.seeds)}, indent=1)
    file = folder / "cell.json"
    if _text(file) == text:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        draft = file.with_name(f".cell-{os.getpid()}.draft")
        draft.write_text(text)
        draft.rename(file)
    except OSError as error:
        raise DelayRLError(f"cannot write to {folder}: {error.strerror}") from error


def claim(runs: Path, name: str, source: Path, ids: list[str], shipped: bool = False, look: bool = False) -> None:
    """Remember which file a grid's name stands for (or only `look`); an edited file keeps its name.

    Raises:
        DelayRLError: another file with other cells has used the name here.
    """
    record = runs / "grids" / f"{name}.json"
    here = f"delayrl:{name}" if shipped else os.path.relpath(source.resolve(), runs.resolve())
    with contextlib.suppress(ValueError):
        have = json.loads(_text(record))
        if have["source"] != here and have["cells"] != ids:
            raise DelayRLError(
                f"two grids are named {name!r}: {have['source']} (seen from {runs}) has used the name there; "
                f'give this one another name = "…", or another --runs'
            )
        look = look or have == {"source": here, "cells": ids}
    if look:
        return
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        draft = record.with_name(f".{name}-{os.getpid()}.draft")
        draft.write_text(json.dumps({"source": here, "cells": ids}))
        draft.rename(record)
    except OSError as error:
        raise DelayRLError(f"cannot write to {record.parent}: {error.strerror}") from error


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""


def _last(file: Path) -> dict[str, Any]:
    """The last whole line of a file of JSON lines."""
    try:
        with open(file, "rb") as stream:
            stream.seek(0, os.SEEK_END)
            stream.seek(max(0, stream.tell() - 8192))
            lines = stream.read().split(b"\n")[:-1]
        return dict(json.loads(lines[-1]))
    except (OSError, ValueError, IndexError):
        return {}
