"""Measure any training loop from inside its environment, which counts steps and pauses the loop between slices.

The side's own training loop runs unchanged. At the end of a slice, the environment's `step` waits until the device is
idle, reports, and returns only when the next slice is requested. So exactly N complete training steps lie between two
reports, and the side uses no processor between slices.

This file also runs in the peers' environments: it needs Gymnasium and nothing of delayrl.
"""

import json
import os
import resource
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

import gymnasium as gym

PREFIX = "delayrl-speed/"


def pin() -> None:
    """Pin this process to as many cores as OpenMP is given, because XLA takes its number of threads from there."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[: int(os.environ["OMP_NUM_THREADS"])])


class Stop(BaseException):
    """End a side's training loop from inside its environment."""


class Gate:
    """Answer requests, one JSON object per line: {"steps": N} runs a slice of N environment steps, end of file stops.

    Args:
        requests: where requests are read from.
        reports: where reports are written. A slice's report has `seconds`, `processor` (seconds of all threads),
            `peak_bytes` (largest resident set so far), and `parts` (seconds by part) if the side times parts.
        warmup: environment steps before the first report.
        settle: waits until the device is idle.
        hello: returns the first report.
    """

    def __init__(
        self,
        requests: TextIO,
        reports: TextIO,
        warmup: int,
        settle: Callable[[], None],
        hello: Callable[[], dict[str, Any]],
    ):
        self._requests, self._reports, self._settle, self._hello = requests, reports, settle, hello
        self._left, self._began = warmup, None
        self.parts: dict[str, float] = defaultdict(float)

    def tick(self) -> None:
        """Count an environment step that begins; between slices, wait."""
        if self._left == 0:
            self._between()
        self._left -= 1

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Add the time of the block to a part of the slice."""
        began = time.perf_counter()
        yield
        self._settle()
        self.parts[name] += time.perf_counter() - began

    def _between(self) -> None:
        self._settle()
        now = time.perf_counter(), time.process_time()
        if self._began is None:
            report = self._hello()
        else:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            report = {"seconds": now[0] - self._began[0], "processor": now[1] - self._began[1], "peak_bytes": peak}
            report |= {"parts": dict(self.parts)} if self.parts else {}
        self._reports.write(json.dumps(report) + "\n")
        self._reports.flush()
        line = self._requests.readline()
        if not line:
            raise Stop
        self._left = int(json.loads(line)["steps"])
        self.parts.clear()
        self._began = time.perf_counter(), time.process_time()


class Gated(gym.Wrapper):
    """Let the gate count the steps of a task."""

    def __init__(self, env: gym.Env, gate: Gate):
        super().__init__(env)
        self._gate = gate

    def step(self, action: Any) -> Any:
        """Step, after waiting for the next slice if the last one has ended."""
        self._gate.tick()
        return self.env.step(action)


def register(gate: Gate, task: str, *, endless: bool = False) -> str:
    """Register `task` with the gate and return its Gymnasium id; `endless` removes the time limit."""

    def entry(**options: Any) -> gym.Env:
        return Gated(gym.make(task, disable_env_checker=True, **options).unwrapped, gate)

    limit = None if endless else gym.spec(task).max_episode_steps
    gym.register(PREFIX + task, entry_point=entry, max_episode_steps=limit, disable_env_checker=True)
    return PREFIX + task
