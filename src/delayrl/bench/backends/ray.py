"""Ray: one actor for each running cell, on an existing cluster or on a local one.

The actor starts a worker process, as the local backend does. When a node dies, the locks of its cells are released and
the cells start again elsewhere. All nodes must share the folder of the runs and have delayrl installed.
"""

import math
import os
import platform
import socket
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from delayrl.bench.backends.local import read_outcome, start_worker
from delayrl.bench.runner import PAUSE
from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError, described, first_line, one_line
from delayrl.run.cell import Cell

TIMEOUT = 5.0
"""Seconds that a Ray address has to accept a connection."""


class Supervisor:
    """The actor on a node: starts a cell's worker, waits until it ends, and asks it to stop."""

    def __init__(self) -> None:
        self._stop = threading.Event()

    def run(self, folder: str, device: str | None) -> tuple[str, str]:
        """Run the cell in this folder. Returns how it ended."""
        if not (Path(folder) / "cell.json").is_file():
            return Outcome("failed", f"{folder} cannot be seen from {platform.node()}: the nodes must share it")
        process = start_worker(Path(folder), device)
        while process.poll() is None:
            if self._stop.wait(PAUSE):
                process.terminate()
                process.wait()
        return read_outcome(process)

    def stop(self) -> None:
        """Ask the worker to stop at a checkpoint."""
        self._stop.set()


@dataclass
class RayBackend:
    """Runs cells on a Ray cluster."""

    runs: Path  # the folder of the cells' folders
    address: str | None = None  # HOST:PORT of the cluster, or "auto"; None starts a local one
    workers: int | None = None  # the most cells at a time; None leaves the limit to the cluster
    cpus: float = 1.0  # cores for each cell
    gpus: float = 0.0  # GPUs for each cell
    device: str | None = None  # "cpu" or "gpu"; None leaves the choice to JAX
    running: dict[str, tuple[Cell, Any, Any]] = field(default_factory=dict)  # cell, actor, answer

    def __post_init__(self) -> None:
        if not (0 <= self.cpus < math.inf and 0 <= self.gpus < math.inf and self.cpus + self.gpus):
            raise DelayRLError(f"a cell takes cores or GPUs; got --cpus {self.cpus:g} --gpus {self.gpus:g}")
        self._ray = connect(self.address)
        resources = {"num_cpus": self.cpus, "num_gpus": self.gpus}
        self._actor = self._ray.remote(max_concurrency=2, max_restarts=0, **resources)(Supervisor)
        if self.room() < 1:  # waiting would never end
            total = self._ray.cluster_resources()
            self.close()
            raise DelayRLError(
                f"a cell takes {self.cpus:g} cores and {self.gpus:g} GPUs (--cpus, --gpus), but this Ray cluster "
                f"has {total.get('CPU', 0):g} and {total.get('GPU', 0):g}"
            )

    def room(self) -> int:
        """Return how many more cells the cluster's cores and GPUs hold now, `workers` at most."""
        total = self._ray.cluster_resources()
        limits = [int(total.get("CPU", 0) / self.cpus)] if self.cpus else []
        limits += [int(total.get("GPU", 0) / self.gpus)] if self.gpus else []
        limits += [self.workers] if self.workers else []
        return min(limits) - len(self.running)

    def start(self, cell: Cell) -> None:
        """Start an actor on a cell."""
        actor = self._actor.remote()
        answer = actor.run.remote(str((self.runs / cell.folder).resolve()), self.device)
        self.running[cell.id] = cell, actor, answer

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Return the cells that answered since the last call, and those whose node or actor died."""
        ended = []
        for cell, actor, answer in list(self.running.values()):
            ready, _ = self._ray.wait([answer], timeout=0)
            if not ready:
                continue
            try:
                outcome = Outcome(*self._ray.get(answer))
            except self._ray.exceptions.RayError as error:
                outcome = Outcome("died", described(error))
            del self.running[cell.id]
            self._ray.kill(actor)
            ended.append((cell, outcome))
        return ended

    def stop(self) -> None:
        """Ask all running cells to stop at a checkpoint."""
        for _, actor, _ in self.running.values():
            actor.stop.remote()

    def close(self) -> None:
        """Kill the actors, on which their workers store a checkpoint, and disconnect. A local cluster ends."""
        for _, actor, _ in self.running.values():
            self._ray.kill(actor)
        self.running.clear()
        self._ray.shutdown()


def connect(address: str | None) -> Any:
    """Return `ray`, connected to a cluster or a new local one. Raises DelayRLError if it is missing or none answers."""
    with one_line("the backend ray cannot be imported"):
        import ray
    quiet = {"log_to_driver": False, "logging_level": "error", "ignore_reinit_error": True}
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if address is None:
        # without an address Ray would join one that is here already, or that RAY_ADDRESS names
        ray.init(address="local", include_dashboard=False, **quiet)
        return ray
    _check_address(address)
    errors: list[BaseException] = []

    def join() -> None:
        try:
            ray.init(address=address, **quiet)
        except BaseException as error:  # Ray may also call sys.exit
            errors.append(error)

    thread = threading.Thread(target=join, daemon=True)
    thread.start()
    thread.join(6 * TIMEOUT)
    if errors or thread.is_alive():
        reason = first_line(errors[0]) if errors else "it does not answer"
        raise DelayRLError(f"no Ray cluster at {address}: {reason}")
    return ray


def _check_address(address: str) -> None:
    """Raise DelayRLError if nothing listens at an address. Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if address == "auto":
        return
    if not host or not port.isdigit():
        raise DelayRLError(f"--address must be HOST:PORT of a Ray cluster, or auto; got {address!r}")
    try:
        socket.create_connection((host, int(port)), timeout=TIMEOUT).close()
    except OSError as error:
        raise DelayRLError(f"no Ray cluster at {address}: {error.strerror or error}") from error
