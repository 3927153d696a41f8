"""Worker processes on this machine."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError
from delayrl.run.cell import Cell
from delayrl.training.machine import cores, free_memory, uses_accelerator

WORKER_BYTES = 3 * 2**29
"""Memory of a worker beside its replays: programs, libraries, a task (1 to 1.5 GB measured)."""


@dataclass
class LocalBackend:
    """Runs up to `workers` cells at a time, each in a process of its own on one core.

    Two cells on one core each learn more in an hour than two that share both (docs/performance.md). And a cell's sums
    are then those of one thread, however many cells run beside it.
    """

    runs: Path
    workers: int
    device: str | None = None
    running: dict[str, tuple[Cell, subprocess.Popen[str], int | None]] = field(default_factory=dict)

    def room(self) -> int:
        """Return how many more cells may be started now."""
        return self.workers - len(self.running)

    def start(self, cell: Cell) -> None:
        """Start a worker on a cell. Raises DelayRLError if that fails."""
        own = {process.pid: core for _, process, core in self.running.values()}
        core = None if uses_accelerator(self.device) else free_core(own)
        self.running[cell.id] = cell, start_worker(self.runs / cell.folder, self.device, core), core

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Return the cells whose process has ended since the last call."""
        ended = [(cell, process) for cell, process, _ in self.running.values() if process.poll() is not None]
        for cell, _ in ended:
            del self.running[cell.id]
        return [(cell, read_outcome(process)) for cell, process in ended]

    def stop(self) -> None:
        """Send SIGTERM, on which `train` stores a checkpoint and ends."""
        for _, process, _ in self.running.values():
            process.terminate()

    def close(self) -> None:
        """Kill the workers that still run."""
        for _, process, _ in self.running.values():
            process.kill()
            process.communicate()
        self.running.clear()


def start_worker(folder: Path, device: str | None, core: int | None = None) -> subprocess.Popen[str]:
    """Start a worker process, which Ctrl-C does not reach. Raises DelayRLError if the disk or the system refuses."""
    command = [sys.executable, "-m", "delayrl.bench.worker", str(folder)]
    command += ["--device", device] if device else []
    command += [] if core is None else ["--core", str(core)]
    try:
        with open(folder / "worker.log", "w") as log:
            return subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True
            )
    except OSError as error:
        raise DelayRLError(f"cannot start a worker in {folder}: {error.strerror}") from error


def read_outcome(process: subprocess.Popen[str]) -> Outcome:
    """Return what a worker that has ended printed, or what ended it."""
    answer, _ = process.communicate()
    with contextlib.suppress(ValueError, TypeError):
        return Outcome(*json.loads(answer))
    code = process.returncode
    if code == -signal.SIGTERM:  # train handles this signal, so training had not begun
        return Outcome("stopped", "stopped before it began")
    if code < 0:
        hint = " (out of memory?)" if code == -signal.SIGKILL else ""
        return Outcome("died", f"killed by {signal.Signals(-code).name}{hint}")
    return Outcome("died", f"the worker ended with status {code}; see worker.log")


def default_workers(device: str | None, replay_bytes: int) -> int:
    """Return how many cells to run at a time: one for each core, as far as memory goes; one with an accelerator.

    `replay_bytes` are those of the largest cell. JAX takes nearly all memory of an accelerator for one process.
    """
    if uses_accelerator(device):
        return 1
    return max(1, min(cores(), free_memory() // (WORKER_BYTES + replay_bytes)))


def free_core(own: Mapping[int, int | None]) -> int | None:
    """Return the core with the fewest workers; None if processes cannot be kept on one.

    `own` are the cores of this runner's workers by process: the system may not show a new one yet. It shows those of
    other runners.
    """
    if not hasattr(os, "sched_setaffinity"):
        return None
    taken = Counter(own.values())
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):  # it has ended, or is no worker
            words = (process / "cmdline").read_bytes().split(b"\0")
            if b"delayrl.bench.worker" in words and b"--core" in words and int(process.name) not in own:
                taken[int(words[words.index(b"--core") + 1])] += 1
    return min(sorted(os.sched_getaffinity(0)), key=lambda core: taken[core])
