"""Run cells: which starts next, what is tried again, when to stop. A `Backend` says where they run.

A worker that dies is started again and resumes from its checkpoint. Only deaths that store nothing new count, and not
stops, so a long cell may be interrupted any number of times. An error that would come back is not tried again.
"""

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Protocol

from delayrl.bench import folders
from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError
from delayrl.run.cell import Cell

GRACE = 60.0
"""Seconds that workers have to reach a checkpoint when they are asked to stop; then they are killed."""
PAUSE = 0.2
"""Seconds between two looks at the workers."""
RETRY = 2.0
"""Seconds until a cell that another process holds is looked at again; tries in vain wait a multiple of it."""


class Backend(Protocol):
    """Where cells run."""

    def room(self) -> int:
        """Return how many more cells may be started now."""

    def start(self, cell: Cell) -> None:
        """Start a cell, whose folder is prepared. Raises DelayRLError if that fails."""

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Return the cells that ended since the last call."""

    def stop(self) -> None:
        """Ask all running cells to stop at a checkpoint."""

    def close(self) -> None:
        """Kill what still runs, and free what was set up for it."""


@dataclass
class Completion:
    """How the cells of a grid ended."""

    done: list[Cell] = field(default_factory=list)  # those included that were complete before
    failed: dict[str, str] = field(default_factory=dict)  # the first line of the failure, by cell id
    unfinished: list[Cell] = field(default_factory=list)  # stopped by the time limit or a signal


def run_cells(
    cells: Sequence[Cell],
    runs: Path,
    backend: Backend,
    *,
    tries: int = 5,
    time_limit: float | None = None,
    stop: Event | None = None,
    say: Callable[[str], None] = lambda line: None,
    tick: Callable[[], None] = lambda: None,
) -> Completion:
    """Run cells until each is done or failed, or the time is up.

    Args:
        cells: in the order in which they start; complete ones are skipped.
        runs: the folder of the cells' folders.
        backend: where they run.
        tries: how often in a row a cell may die without storing anything new.
        time_limit: seconds until all cells are asked to stop at a checkpoint.
        stop: set this event to stop before the time is up.
        say: takes messages for people.
        tick: is called a few times a second.
    """
    began, stopped = time.monotonic(), None
    queue = _Queue(runs, backend, tries, say)
    for cell in cells:
        queue.add(cell)
    try:
        while queue.waiting or queue.running:
            now = time.monotonic()
            time_is_up = time_limit is not None and now - began >= time_limit
            if stopped is None and (time_is_up or (stop is not None and stop.is_set())):
                stopped = now
                queue.stop()
            if stopped is not None and now - stopped > GRACE:
                break
            queue.start(now)
            outcomes = backend.ended()
            queue.running -= len(outcomes)
            for cell, outcome in outcomes:
                queue.end(cell, outcome, now)
            tick()
            time.sleep(PAUSE)
    except Exception:
        queue.let_stop()
        raise
    finally:
        backend.close()
    completion = queue.completion
    ended = {cell.id for cell in completion.done + completion.unfinished} | completion.failed.keys()
    completion.unfinished += [cell for cell in cells if cell.id not in ended]
    return completion


class _Queue:
    """Cells that wait, run or have ended."""

    def __init__(self, runs: Path, backend: Backend, tries: int, say: Callable[[str], None]):
        self.waiting, self.running, self.completion = deque[Cell](), 0, Completion()
        self._runs, self._backend, self._tries, self._say = runs, backend, tries, say
        self._stopping = False
        self._not_before = dict[str, float]()
        self._in_vain, self._stops, self._step = Counter[str](), Counter[str](), dict[str, int]()

    def add(self, cell: Cell) -> None:
        """Queue a cell, unless it is complete; if it is, and damaged, it has failed."""
        folder = self._runs / cell.folder
        folders.prepare(folder, cell)
        if not folders.stored(folder, cell.seeds)[1]:
            self.waiting.append(cell)
        elif line := folders.damage(folder, cell):
            self.completion.failed[cell.id] = line
        else:
            self.completion.done.append(cell)

    def start(self, now: float) -> None:
        """Start waiting cells while the backend has room."""
        for _ in range(len(self.waiting)):
            if self._backend.room() < 1:
                break
            cell = self.waiting.popleft()
            folder = self._runs / cell.folder
            if now < self._not_before.get(cell.id, 0):
                self.waiting.append(cell)
            elif folders.holder(folder) is not None:  # starting a worker would empty the log of the one that holds it
                self._retry(cell, now + RETRY)
            else:
                if cell.id not in self._step:
                    self._step[cell.id] = folders.stored(folder, cell.seeds)[0]
                try:
                    self._backend.start(cell)
                    self.running += 1
                except DelayRLError as error:
                    self._fail(cell, str(error))

    def end(self, cell: Cell, outcome: Outcome, now: float) -> None:
        """Sort in a cell whose worker has ended: done, failed, or to be tried again."""
        kind, line = outcome
        step = folders.stored(self._runs / cell.folder, cell.seeds)[0]
        if step > self._step[cell.id] or kind == "locked":
            self._in_vain[cell.id] = self._stops[cell.id] = 0
        else:
            self._in_vain[cell.id] += kind == "died"
            self._stops[cell.id] += kind == "stopped"
        step = self._step[cell.id] = max(step, self._step[cell.id])  # 0 is also what a disk that does not answer gives
        in_vain = self._in_vain[cell.id]
        if kind == "done":
            self.completion.done.append(cell)
            self._say(f"done: {cell}")
        elif kind == "failed":
            self._fail(cell, line)
        elif kind == "died" and in_vain >= self._tries:
            self._fail(cell, f"{self._tries} deaths, and nothing new was stored; the last: {line}")
        elif self._stopping:
            self.completion.unfinished.append(cell)
        elif kind == "locked":  # another runner has it, and may leave it unfinished
            self._retry(cell, now + RETRY)
        else:
            self._retry(cell, now + RETRY * (in_vain + self._stops[cell.id]))  # what ended it may last for a while
            self._say(f"again from step {step:,}: {cell}: {line}")

    def stop(self) -> None:
        """Start nothing more, and ask what runs to stop."""
        self._stopping = True
        self.completion.unfinished += self.waiting
        self.waiting.clear()
        self._backend.stop()

    def let_stop(self) -> None:
        """Let what runs reach a checkpoint, unless the backend itself fails."""
        with contextlib.suppress(Exception):  # the first error is the one to show
            self._backend.stop()
            until = time.monotonic() + GRACE
            while self.running > 0 and time.monotonic() < until:
                self.running -= len(self._backend.ended())
                time.sleep(PAUSE)

    def _retry(self, cell: Cell, not_before: float) -> None:
        self.waiting.append(cell)
        self._not_before[cell.id] = not_before

    def _fail(self, cell: Cell, line: str) -> None:
        self.completion.failed[cell.id] = line
        with contextlib.suppress(DelayRLError):  # the disk may be full
            folders.note(self._runs / cell.folder, "failed", line=line)
        self._say(f"failed: {cell}: {line}")
