"""Ray: an actor for each cell that is worked on, on a cluster that is there, or on a local one.

The actor supervises a worker process as the local backend does, so a node that dies takes its cells' locks with it
and they are started again elsewhere. All nodes must see the runs' folder, and have delayrl installed.
"""

import math
import os
import platform
import socket
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from delayrl.bench.grid import Cell
from delayrl.bench.runner import PAUSE, read_outcome, start_worker
from delayrl.bench.worker import Outcome
from delayrl.errors import DelayRLError

ANSWER = 5.0
"""Seconds that a Ray address has to answer."""


class Supervisor:
    """On a node: starts a cell's worker, waits for its end, passes on a wish to stop."""

    def __init__(self) -> None:
        self._stop = threading.Event()

    def run(self, folder: str, device: str | None) -> tuple[str, str]:
        """Work on the cell in this folder; how it ended."""
        if not (Path(folder) / "cell.json").is_file():
            return Outcome("failed", f"{folder} cannot be seen from {platform.node()}: the nodes must share it")
        process = start_worker(Path(folder), device)
        asked = False
        while process.poll() is None:
            if self._stop.is_set() and not asked:
                process.terminate()
                asked = True
            time.sleep(PAUSE)
        return read_outcome(process)

    def stop(self) -> None:
        """Ask the worker to stop at a checkpoint."""
        self._stop.set()


@dataclass
class OnRay:
    """The Ray backend."""

    runs: Path
    address: str | None = None
    workers: int | None = None
    cpus: float = 1.0
    gpus: float = 0.0
    device: str | None = None
    running: dict[str, tuple[Cell, Any, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (0 <= self.cpus < math.inf and 0 <= self.gpus < math.inf and self.cpus + self.gpus):
            raise DelayRLError(f"a cell takes cores, or GPUs; got --cpus {self.cpus:g} --gpus {self.gpus:g}")
        self._ray = connect(self.address)
        resources = {"num_cpus": self.cpus, "num_gpus": self.gpus}
        self._actor = self._ray.remote(max_concurrency=2, max_restarts=0, **resources)(Supervisor)
        if self.room() < 1:  # waiting would never end
            have = self._ray.cluster_resources()
            self.close()
            raise DelayRLError(
                f"a cell takes {self.cpus:g} cores and {self.gpus:g} GPUs (--cpus, --gpus), all of this Ray cluster "
                f"has {have.get('CPU', 0):g} and {have.get('GPU', 0):g}"
            )

    def room(self) -> int:
        """As many cells as the cluster's cores (and GPUs) hold now, at the most `workers`."""
        have = self._ray.cluster_resources()
        limits = [int(have.get("CPU", 0) / self.cpus)] if self.cpus else []
        limits += [int(have.get("GPU", 0) / self.gpus)] if self.gpus else []
        limits += [self.workers] if self.workers else []
        return min(limits) - len(self.running)

    def start(self, cell: Cell) -> None:
        """One actor for each cell."""
        actor = self._actor.remote()
        answer = actor.run.remote(str((self.runs / cell.folder).resolve()), self.device)
        self.running[cell.id] = cell, actor, answer

    def ended(self) -> list[tuple[Cell, Outcome]]:
        """Those that answered, and those whose node or actor died."""
        found = []
        answers = {answer: cell for cell, _, answer in self.running.values()}
        ready, _ = self._ray.wait(list(answers), num_returns=len(answers), timeout=0) if answers else ([], [])
        for answer in ready:
            cell = answers[answer]
            try:
                outcome = Outcome(*self._ray.get(answer))
            except self._ray.exceptions.RayError as error:
                outcome = Outcome("died", f"{type(error).__name__}: {str(error).strip().splitlines()[0]}")
            _, actor, _ = self.running.pop(cell.id)
            self._ray.kill(actor)
            found.append((cell, outcome))
        return found

    def stop(self) -> None:
        """Pass the wish on to every actor."""
        for _, actor, _ in self.running.values():
            actor.stop.remote()

    def close(self) -> None:
        """Kill what is left; their workers store a checkpoint. A local cluster ends, another is left."""
        for _, actor, _ in self.running.values():
            self._ray.kill(actor)
        self.running.clear()
        self._ray.shutdown()


def connect(address: str | None) -> Any:
    """Ray, connected to the cluster at an address, or to one of its own on this machine.

    Raises:
        DelayRLError: Ray is not installed, or nothing answers.
    """
    try:
        import ray
    except ImportError as error:
        raise DelayRLError("--backend ray needs `pip install 'delayrl[ray]'`") from error
    quiet = {"log_to_driver": False, "logging_level": "error", "ignore_reinit_error": True}
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if address is None:
        ray.init(include_dashboard=False, **quiet)
        return ray
    _knock(address)
    failed: list[BaseException] = []

    def join() -> None:
        try:
            ray.init(address=address, **quiet)
        except BaseException as error:  # Ray may also call sys.exit
            failed.append(error)

    thread = threading.Thread(target=join, daemon=True)
    thread.start()
    thread.join(6 * ANSWER)
    if failed or thread.is_alive():
        reason = str(failed[0]).strip().splitlines()[0] if failed and str(failed[0]).strip() else "it does not answer"
        raise DelayRLError(f"no Ray cluster at {address}: {reason}")
    return ray


def _knock(address: str) -> None:
    """Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if address == "auto":
        return
    if not host or not port.isdigit():
        raise DelayRLError(f"--address is HOST:PORT of a Ray cluster, or auto; got {address!r}")
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER).close()
    except OSError as error:
        raise DelayRLError(f"no Ray cluster at {address}: {error.strerror or error}") from error
