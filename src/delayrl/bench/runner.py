"""Working off cells: which next, what to try again, when to stop. Where they run is a `Backend`; here the local one.

A worker that dies is started again and goes on from its checkpoint. Only tries that store nothing new count, so a
long cell may be interrupted as often as it likes. A mistake (DelayRLError) is not tried again.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from threading import Event
from typing import Protocol

from delayrl.bench import folders
from delayrl.bench.grid import Cell
from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError

GRACE = 60.0
"""Seconds that workers have to reach a checkpoint when they are asked to stop; then they are killed."""
PAUSE = 0.2
STOPPED = 75
"""Exit status of a run that is not finished, and goes on with the same command (EX_TEMPFAIL)."""


class Backend(Protocol):
    """Where cells run."""

    def room(self) -> int:
        """How many more cells may be started now."""
        ...

    def start(self, cell: Cell) -> None:
        """Have the cell worked on. Its folder is prepared."""
        ...

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """The cells that ended since the last call."""
        ...

    def stop(self) -> None:
        """Ask all that run to stop at a checkpoint."""
        ...

    def close(self) -> None:
        """End all that still run, and what was set up for them."""
        ...


@dataclass
class Local:
    """Worker processes on this machine."""

    runs: Path
    workers: int
    device: str | None = None
    running: dict[str, tuple[Cell, subprocess.Popen[str]]] = field(default_factory=dict)

    def room(self) -> int:
        """Up to `workers` cells at a time."""
        return self.workers - len(self.running)

    def start(self, cell: Cell) -> None:
        """One process for each cell."""
        self.running[cell.id] = cell, start_worker(self.runs / cell.folder, self.device)

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Those whose process has ended."""
        found = [(cell, process) for cell, process in self.running.values() if process.poll() is not None]
        for cell, _ in found:
            del self.running[cell.id]
        return [(cell, read_outcome(process)) for cell, process in found]

    def stop(self) -> None:
        """SIGTERM, on which `train` writes a checkpoint."""
        for _, process in self.running.values():
            process.terminate()

    def close(self) -> None:
        """SIGKILL for what is left."""
        for _, process in self.running.values():
            process.kill()
            process.communicate()
        self.running.clear()


def start_worker(folder: Path, device: str | None) -> subprocess.Popen[str]:
    """A process that works on a cell. Ctrl-C does not reach it; whoever started it passes it on."""
    command = [sys.executable, "-m", "delayrl.bench.worker", str(folder), *([device] if device else [])]
    try:
        with open(folder / "worker.log", "w") as log:
            return subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True
            )
    except OSError as error:
        raise DelayRLError(f"cannot start a worker in {folder}: {error.strerror}") from error


def read_outcome(process: subprocess.Popen[str]) -> Outcome:
    """What a worker that has ended said, or what ended it."""
    answer, _ = process.communicate()
    with contextlib.suppress(ValueError, TypeError):
        return Outcome(*json.loads(answer))
    code = process.returncode
    if code == -signal.SIGTERM:  # before training began, when there was nothing to store
        return Outcome("stopped", "stopped before it began")
    if code < 0:
        return Outcome("died", f"killed by {signal.Signals(-code).name}" + (" (memory?)" if code == -9 else ""))
    return Outcome("died", f"the worker ended with status {code}; see worker.log")


@dataclass
class Report:
    """What came of working on cells."""

    done: list[Cell] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """First line of the failure by cell id."""
    left: list[Cell] = field(default_factory=list)
    """Not finished: the time was up, or somebody asked to stop."""


def work_off(
    cells: Sequence[Cell],
    runs: Path,
    backend: Backend,
    *,
    tries: int = 5,
    time_limit: float | None = None,
    grace: float = GRACE,
    stop: Event | None = None,
    say: Callable[[str], None] = lambda line: None,
    tick: Callable[[], None] = lambda: None,
) -> Report:
    """Work on cells until each is done or failed, or the time is up.

    Args:
        cells: in the order in which they are started; those that are complete are skipped.
        runs: the folder of the cells' folders.
        backend: where they run.
        tries: how often a cell may die in a row without storing anything new.
        time_limit: seconds until all are asked to stop at a checkpoint.
        grace: seconds that they then have before they are killed (which loses only what they did since).
        stop: set it to stop before the time is up.
        say: takes lines for people.
        tick: called a few times a second.
    """
    began, stop, report = time.monotonic(), stop or Event(), Report()
    waiting: deque[Cell] = deque()
    for cell in cells:
        folders.prepare(runs / cell.folder, cell)
        complete = folders.stored(runs / cell.folder, cell.seeds)[1]
        (report.done if complete else waiting).append(cell)
    active, not_before = 0, dict[str, float]()
    in_vain, reached = Counter[str](), dict[str, int]()
    asked: float | None = None

    def fail(cell: Cell, line: str) -> None:
        report.failed[cell.id] = line
        with contextlib.suppress(DelayRLError):  # the disk may be full
            folders.note(runs / cell.folder, "failed", line=line)
        say(f"failed: {cell}: {line}")

    try:
        while waiting or active:
            now = time.monotonic()
            if asked is None and (stop.is_set() or (time_limit is not None and now - began >= time_limit)):
                asked = now
                report.left += waiting
                waiting.clear()
                backend.stop()
            if asked is not None and now - asked > grace:
                break
            for _ in range(len(waiting)):
                if backend.room() < 1:
                    break
                cell = waiting.popleft()
                if now < not_before.get(cell.id, 0):
                    waiting.append(cell)
                    continue
                if folders.holder(runs / cell.folder) is not None:  # a worker of ours would empty its log
                    waiting.append(cell)
                    not_before[cell.id] = now + 2
                    continue
                if cell.id not in reached:
                    reached[cell.id] = folders.stored(runs / cell.folder, cell.seeds)[0]
                try:
                    backend.start(cell)
                    active += 1
                except DelayRLError as error:
                    fail(cell, str(error))
            for cell, outcome in backend.ended():
                active -= 1
                kind, line = outcome
                step = folders.stored(runs / cell.folder, cell.seeds)[0]
                in_vain[cell.id] = 0 if step > reached[cell.id] or kind == "locked" else in_vain[cell.id] + 1
                reached[cell.id] = step
                if kind == "died" and in_vain[cell.id] >= tries:
                    kind, line = "failed", f"{tries} tries stored nothing new; the last: {line}"
                if kind == "done":
                    report.done.append(cell)
                    say(f"done: {cell}")
                elif kind == "failed":
                    fail(cell, line)
                elif asked is not None:
                    report.left.append(cell)
                elif kind == "locked":  # another runner's; perhaps it leaves it unfinished
                    waiting.append(cell)
                    not_before[cell.id] = now + 2
                else:
                    waiting.append(cell)
                    not_before[cell.id] = now + 2 * in_vain[cell.id]  # what killed it may still be there
                    say(f"again from step {step:,}: {cell}: {line}")
            tick()
            time.sleep(PAUSE)
    finally:
        backend.close()
    finished = {cell.id for cell in report.done} | set(report.failed) | {cell.id for cell in report.left}
    report.left += [cell for cell in cells if cell.id not in finished]
    return report


def default_workers(device: str | None) -> int:
    """Half of the cores; one where there is an accelerator, whose memory one process takes whole."""
    if device != "cpu" and entry_points(group="jax_plugins"):
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // 2)
