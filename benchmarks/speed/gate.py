"""Where every side is measured: an environment that counts its steps and stops its owner between two slices.

The side's own training loop runs as it is, whoever wrote it. Whenever a slice is over, the environment's `step` waits
until the device is idle, reports, and does not come back before the next slice is asked for. So from one report to the
next lie exactly N whole training steps, and between slices the side uses no processor.

Runs in the peers' environments too: needs Gymnasium, and nothing of ours.
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
    """Keep this process to as many cores as OpenMP is given: XLA takes the number of its threads from there."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[: int(os.environ["OMP_NUM_THREADS"])])


class Stop(BaseException):
    """Ends a side's training loop from inside its environment."""


class Gate:
    """Answers requests, one JSON object a line: {"steps": N} runs a slice of N environment steps, end of file stops.

    The first line is written once `warmup` steps are done: whatever `hello` gives. A slice's report has `seconds`,
    `processor` (seconds of all threads), `peak_bytes` (resident, ever), and seconds by part where the side times some.
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
        """Called as an environment step begins."""
        if self._left == 0:
            self._between()
        self._left -= 1

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Adds to the seconds of a part of the slice."""
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
    """A task whose steps the gate counts."""

    def __init__(self, env: gym.Env, gate: Gate):
        super().__init__(env)
        self._gate = gate

    def step(self, action: Any) -> Any:
        """Wait for the next slice where one has ended; then step."""
        self._gate.tick()
        return self.env.step(action)


def register(gate: Gate, task: str, *, endless: bool = False) -> str:
    """The id under which Gymnasium makes `task` with the gate; `endless` for loops that cannot take a time limit."""

    def entry(**options: Any) -> gym.Env:
        return Gated(gym.make(task, disable_env_checker=True, **options).unwrapped, gate)

    limit = None if endless else gym.spec(task).max_episode_steps
    gym.register(PREFIX + task, entry_point=entry, max_episode_steps=limit, disable_env_checker=True)
    return PREFIX + task
