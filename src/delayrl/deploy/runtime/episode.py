"""The state of one episode: the newest observation, the commands, and the times that are still possible."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from delayrl.deploy.runtime.history import LARGEST_TIME, Action, Clock, ClockError, History
from delayrl.deploy.runtime.telemetry import Arrival
from delayrl.errors import DelayRLError


class Newest(NamedTuple):
    """The newest observation, seen from a command."""

    obs: NDArray[np.float64]
    age: int
    actions: list[Action]  # those since, oldest first; fewer than the age if the oldest are no longer remembered
    delay: float  # the time from the stamp to the command
    warm: bool  # whether the observation was made after the first command


class Episode:
    """Judge observations and record commands. A start of -inf leaves it to the first observation or command."""

    def __init__(self, number: int, start: float, clock: Clock, history: History) -> None:
        self.number, self.history = number, history
        self._start, self._clock = start, clock
        self.obs: NDArray[np.float64] | None = None  # the newest
        self._stamp = self._last_command = -math.inf
        self._first_command: int | None = None  # in steps from the start

    def observe(self, obs: NDArray[np.float64], stamp: float, now: float | None, episode: int | None) -> Arrival:
        """Keep an observation if it is the newest; return what became of it."""
        arrival = self._judge(obs, stamp, now, episode)
        if arrival == "new":
            self.obs, self._stamp = obs, stamp
            if self._start == -math.inf:
                self._start = stamp
        return arrival

    def command_time(self, now: float | None) -> float:
        """Return `now` as a float. Raises ClockError unless it is after the last command."""
        time = self._now(now)
        if time <= self._last_command:
            raise ClockError(f"time went backwards: now is {time:g}, the last command was at {self._last_command:g}")
        if self._clock.stamps == "steps" and time < 0:
            raise ClockError(f"steps count from 0; now is {time:g}")
        return time

    def newest(self, now: float) -> Newest:
        """Return the newest observation with its age. Raises DelayRLError if none has arrived before `now`."""
        if self.obs is None:
            raise DelayRLError("no observation has arrived in this episode: wait until `controller.ready`")
        if self._stamp > now + self._clock.period / 2:
            raise ClockError(f"time went backwards: now is {now:g}, an observation of {self._stamp:g} is here")
        step, age, actions = self.history.age(self._stamp, now, self._elapsed(now))
        warm = self._first_command is not None and step > self._first_command
        return Newest(self.obs.copy(), age, actions, now - self._stamp, warm)

    def record(self, action: Action, now: float) -> float:
        """Add a command to the history. Returns the time since the last one, infinite for the first."""
        if self._start == -math.inf:
            self._start = now
        elapsed = self._elapsed(now)
        if self._first_command is None:
            self._first_command = elapsed
        self.history.record(action, now, elapsed)
        period, self._last_command = now - self._last_command, now
        return period

    def _judge(self, obs: NDArray[Any], stamp: float, now: float | None, episode: int | None) -> Arrival:
        with np.errstate(over="ignore"):  # policies compute in single precision
            finite = np.isfinite(obs.astype(np.float32)).all()
        if not (finite and abs(stamp) <= LARGEST_TIME) or (self._clock.stamps == "steps" and stamp < 0):
            return "invalid"
        if (episode is not None and episode != self.number) or stamp < self._start:
            return "late"
        if stamp > self._now(now) + self._clock.period / 2:
            return "future"
        if stamp == self._stamp:
            return "duplicate"
        return "late" if stamp < self._stamp else "new"

    def _now(self, now: float | None) -> float:
        return self._clock.now(now, max(0, self.history.length - self.history.lead))

    def _elapsed(self, now: float) -> int:
        """Return the steps from the start to `now`: none of them had a command if the first is given then."""
        return max(0, math.floor((now - self._start) / self._clock.period + 0.5))
