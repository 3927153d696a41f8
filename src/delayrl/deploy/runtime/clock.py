"""Times as a controller takes them: steps or seconds, read or given, and checked."""

import math
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np

from delayrl.errors import DelayRLError

Stamps = Literal["steps", "seconds"]
SHORTEST_STEP, LONGEST_STEP = 1e-6, 1e6
"""Bounds of a step, in seconds."""
LARGEST_TIME = 1e15
"""The largest distance from 0, in steps or seconds. Beyond it, floating point cannot tell neighbouring times apart."""


class ClockError(DelayRLError):
    """Time did not go forward."""


class Clock:
    """Check times, and read the present one.

    Args:
        stamps: the unit of all times.
        dt: seconds a step; None for stamps in steps.
        read: returns the present time in seconds.
    """

    def __init__(self, stamps: Stamps, dt: Any, read: Callable[[], float]) -> None:
        if stamps not in get_args(Stamps):
            raise DelayRLError(f"stamps are in steps or in seconds; got {stamps!r}")
        if stamps == "steps" and dt is not None:
            raise DelayRLError("dt goes with stamps='seconds'; steps have no length")
        valid = isinstance(dt, int | float | np.number) and not isinstance(dt, bool)
        if stamps == "seconds" and not (valid and SHORTEST_STEP <= dt <= LONGEST_STEP):
            allowed = f"{SHORTEST_STEP:g} .. {LONGEST_STEP:g}"
            raise DelayRLError(f"stamps in seconds need the seconds of a step, {allowed}: give dt=…; got {dt!r}")
        self.stamps, self._read = stamps, read
        self.period = 1.0 if dt is None else float(dt)

    def number(self, time: float) -> float:
        """Return a time as a float. Raises DelayRLError if it is not a number, or a fraction of a step."""
        if isinstance(time, bool | np.bool_) or not isinstance(time, int | float | np.integer | np.floating):
            raise DelayRLError(f"a time is a number of {self.stamps}; got {time!r}")
        try:
            value = float(time)
        except OverflowError:  # an integer beyond the range of floats
            value = math.inf if time > 0 else -math.inf
        if self.stamps == "steps" and math.isfinite(value) and value != math.floor(value):
            raise DelayRLError(f"steps are whole numbers; got {time!r}. For seconds: stamps='seconds'")
        return value

    def now(self, now: float | None, step: int) -> float:
        """Return `now` as a float; if it is None, the time on the clock, or `step` with stamps in steps."""
        if now is None:
            now = self._read() if self.stamps == "seconds" else step
        value = self.number(now)
        if not abs(value) <= LARGEST_TIME:
            raise ClockError(f"now must be finite, within ±{LARGEST_TIME:g}; got {value}")
        return value
