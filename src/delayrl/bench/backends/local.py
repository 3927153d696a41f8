"""Worker processes on this machine."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path

from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError
from delayrl.run.cell import Cell

WORKER_BYTES = 3 * 2**29
"""Memory of a worker beside its replays: programs, libraries, a task (1 to 1.5 GB measured)."""


@dataclass
class LocalBackend:
    """Runs up to `workers` cells at a time, each in a process of its own on its share of the cores.

    Two cells on one core each learn more in an hour than two that compete for both (docs/performance.md).
    """

    runs: Path
    workers: int
    device: str | None = None
    running: dict[str, tuple[Cell, subprocess.Popen[str], list[int]]] = field(default_factory=dict, init=False)
    free: list[list[int]] = field(default_factory=list, init=False)  # shares of the cores without a worker

    def __post_init__(self) -> None:
        """Divide the cores."""
        self.free = shares(cores(), self.workers)

    def room(self) -> int:
        """Return how many more cells may be started now."""
        return self.workers - len(self.running)

    def start(self, cell: Cell) -> None:
        """Start a worker on a cell. Raises DelayRLError if that fails."""
        process = start_worker(self.runs / cell.folder, self.device, self.free[0])
        self.running[cell.id] = cell, process, self.free.pop(0)

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Return the cells whose process has ended since the last call."""
        ended = [entry for entry in self.running.values() if entry[1].poll() is not None]
        for cell, _, share in ended:
            del self.running[cell.id]
            self.free.append(share)
        return [(cell, read_outcome(process)) for cell, process, _ in ended]

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


def start_worker(folder: Path, device: str | None, share: Sequence[int] = ()) -> subprocess.Popen[str]:
    """Start a worker process, which Ctrl-C does not reach. Raises DelayRLError if the disk or the system refuses."""
    options = [*(["--device", device] if device else []), *(["--cores", *map(str, share)] if share else [])]
    command = [sys.executable, "-m", "delayrl.bench.worker", str(folder), *options]
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
    return max(1, min(len(cores()), free_memory() // (WORKER_BYTES + replay_bytes)))


def uses_accelerator(device: str | None) -> bool:
    """Whether workers on this device compute elsewhere than on the processor."""
    return device != "cpu" and bool(entry_points(group="jax_plugins"))


def shares(available: Sequence[int], workers: int) -> list[list[int]]:
    """Return the cores of each worker: as many for each, none in two shares. Of more workers than cores, no shares."""
    size = len(available) // workers
    if size == 0:
        return [[] for _ in range(workers)]
    return [list(available[i * size : (i + 1) * size]) for i in range(workers)]


def cores() -> list[int]:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def free_memory() -> int:
    """Return the bytes that new processes can take; on systems that do not say so, as if there was enough."""
    about = Path("/proc/meminfo")
    found = re.search(r"^MemAvailable:\s+(\d+) kB", about.read_text(), re.MULTILINE) if about.exists() else None
    return int(found[1]) * 1024 if found else 2**62
