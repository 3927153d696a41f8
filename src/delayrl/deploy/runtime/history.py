"""Times as a controller takes them, and the steps that a plant has gone through, with the action of each.

Steps are numbered from the start of the episode. Only the newest ones are remembered.
"""

import math
import operator
from collections import deque
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError

Action = NDArray[np.float32]
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


class History:
    """Keep the steps, when they begin, and their actions. Only this class rounds time to steps.

    Args:
        period: nominal length of a step; 1 if time is counted in steps.
        lead: steps from a command to its effect.
        capacity: how many steps are remembered.
        idle: the action of a step without a command, [A]; None to go on with the action before.
        first: the action before any other, [A].
        counts: the counters `missed` and `replaced`, which `record` updates.
    """

    def __init__(
        self, period: float, lead: int, capacity: int, idle: Action | None, first: Action, counts: dict[str, int]
    ) -> None:
        self._period, self.lead, self._capacity = period, lead, capacity
        self._idle, self._first, self._counts = idle, first, counts
        self._begins: deque[float] = deque(maxlen=capacity)
        self._actions: deque[Action] = deque(maxlen=capacity)
        self.length = 0

    @property
    def last(self) -> Action:
        """What the plant does if it gets no other command."""
        return self._actions[-1] if self._actions else self._uncommanded()

    def age(self, stamp: float, now: float, elapsed: int) -> tuple[int, int, list[Action]]:
        """Locate an observation, for a command at `now`.

        Args:
            stamp: when the observation was made.
            now: when the command is given.
            elapsed: steps before `now`; used only if there has been no command yet.

        Returns:
            The step of the observation; its age, which is the number of steps from there to the step of the command;
            and the actions of these steps, oldest first. There are fewer actions than the age says if the oldest are
            no longer remembered.
        """
        gap, added = self._gap(now, elapsed), self._begins_up_to(now, elapsed)
        begins, actions = [*self._begins, *added], [*self._actions, *[self._uncommanded()] * (len(added) - 1)]
        if gap == 0:
            actions = actions[:-1]
        elif gap - 1 > self._capacity:  # the added steps alone fill the history
            begins, actions = added, actions[1 - len(added) :]
        commanded = self.length - 1 + gap
        first = commanded + 1 - len(begins)
        i = len(begins) - 1
        while i > 0 and stamp < (begins[i - 1] + begins[i]) / 2:
            i -= 1
        if i == 0 and first > 0:  # no longer remembered: count back one period at a time
            i = min(0, math.floor((stamp - begins[0]) / self._period + 0.5))
        step = min(max(0, first + i), commanded - self.lead)
        return step, commanded - step, actions[max(0, step - first) :]

    def record(self, action: Action, now: float, elapsed: int) -> None:
        """Add a command given at `now`, and the steps without a command before it."""
        gap, added = self._gap(now, elapsed), self._begins_up_to(now, elapsed)
        if gap == 0:
            self._actions[-1] = action
            self._counts["replaced"] += 1
            return
        self._counts["missed"] += gap - 1 if self.length else elapsed
        self._actions.extend([*[self._uncommanded()] * (len(added) - 1), action])
        self._begins.extend(added)
        self.length += gap

    def correct(self, action: Action, step: int | None) -> bool:
        """Replace the action of a step, of the newest if None. Returns False if the step is no longer remembered."""
        try:
            number = self.length - 1 if step is None else operator.index(step)
        except TypeError:
            raise DelayRLError(f"a step is a whole number; got {step!r}") from None
        if not 0 <= number < self.length:
            raise DelayRLError(f"there are actions of {self.length} steps, from 0 on; got step {number}")
        position = number - (self.length - len(self._actions))
        if position >= 0:
            self._actions[position] = action
        return position >= 0

    def _gap(self, now: float, elapsed: int) -> int:
        """Return the steps from the newest step to that of a command at `now`; 0 if they are the same."""
        if not self._begins:
            return elapsed + self.lead + 1
        return math.floor((now + self.lead * self._period - self._begins[-1]) / self._period + 0.5)

    def _begins_up_to(self, now: float, elapsed: int) -> list[float]:
        """Return when the steps after the newest begin, up to that of a command at `now`; long gaps are cut."""
        begin, gap = now + self.lead * self._period, self._gap(now, elapsed)
        uncommanded = min(gap - 1, self._capacity)
        if uncommanded < 0:
            return []
        if self._begins:  # without a command the plant went on, a period at a time
            last = self._begins[-1]
            return [last + (gap - uncommanded + i) * self._period for i in range(uncommanded)] + [begin]
        return [begin - (uncommanded - i) * self._period for i in range(uncommanded)] + [begin]

    def _uncommanded(self) -> Action:
        """Return the action of a step that has no command."""
        if self._idle is not None:
            return self._idle
        return self._actions[-1] if self._actions else self._first
