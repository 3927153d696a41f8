"""Worker processes on this machine."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path

from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError
from delayrl.run.cell import Cell


@dataclass
class LocalBackend:
    """Runs up to `workers` cells at a time, each in a process of its own."""

    runs: Path
    workers: int
    device: str | None = None
    running: dict[str, tuple[Cell, subprocess.Popen[str]]] = field(default_factory=dict)

    def room(self) -> int:
        """Return how many more cells may be started now."""
        return self.workers - len(self.running)

    def start(self, cell: Cell) -> None:
        """Start a worker on a cell. Raises DelayRLError if that fails."""
        self.running[cell.id] = cell, start_worker(self.runs / cell.folder, self.device)

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Return the cells whose process has ended since the last call."""
        ended = [(cell, process) for cell, process in self.running.values() if process.poll() is not None]
        for cell, _ in ended:
            del self.running[cell.id]
        return [(cell, read_outcome(process)) for cell, process in ended]

    def stop(self) -> None:
        """Send SIGTERM, on which `train` stores a checkpoint and ends."""
        for _, process in self.running.values():
            process.terminate()

    def close(self) -> None:
        """Kill the workers that still run."""
        for _, process in self.running.values():
            process.kill()
            process.communicate()
        self.running.clear()


def start_worker(folder: Path, device: str | None) -> subprocess.Popen[str]:
    """Start a worker process, which Ctrl-C does not reach. Raises DelayRLError if the disk or the system refuses."""
    command = [sys.executable, "-m", "delayrl.bench.worker", str(folder), *([device] if device else [])]
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


def default_workers(device: str | None) -> int:
    """Return half of the cores; 1 with an accelerator, because JAX takes nearly all of its memory for one process."""
    if device != "cpu" and entry_points(group="jax_plugins"):
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // 2)
