"""The state of one episode: its times, the steps that the plant has gone through, and what has been observed.

Steps are numbered from the start of the episode. Only the newest ones are remembered.
"""

import math
import operator
from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delayrl.errors import DelayRLError

Action = NDArray[np.float32]
Stamps = Literal["steps", "seconds"]
Arrival = Literal["new", "late", "duplicate", "invalid", "future"]
"""What became of an observation; see `Statistics`. Only new ones are used."""
SHORTEST_STEP, LONGEST_STEP = 1e-6, 1e6
"""Bounds of a step, in seconds."""
MOST_HELD = 10_000
"""How many observations are held back at most."""
LARGEST_TIME = 1e15
"""The largest distance from 0, in steps or seconds. Beyond it, floating point cannot tell neighbouring times apart."""


class ClockError(DelayRLError):
    """Time did not go forward."""


class Clock:
    """Check times in one unit, and read the present one. `dt` is the seconds of a step; None for stamps in steps."""

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
        self.dt = 1.0 if dt is None else float(dt)

    @property
    def seconds(self) -> float:
        """The seconds of a step. Raises DelayRLError if stamps are in steps."""
        if self.stamps == "steps":
            raise DelayRLError("steps have no length in seconds; stamps='seconds' have")
        return self.dt

    def start(self, now: float | None) -> float:
        """Return when an episode starts that is reset at `now`; None reads the clock. Steps start at 0."""
        return 0.0 if self.stamps == "steps" else self.now(now, 0)

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
        dt: nominal length of a step; 1 if time is counted in steps.
        lead: steps from a command to its effect.
        capacity: how many steps are remembered.
        idle: the action of a step without a command, [A]; None to go on with the action before.
        first: the action of a step before the first command, [A], where `idle` is None.
        counts: the counters `missed` and `replaced`, which `record` updates.
    """

    def __init__(
        self, dt: float, lead: int, capacity: int, idle: Action | None, first: Action, counts: dict[str, int]
    ) -> None:
        self._dt, self.lead, self._capacity = dt, lead, capacity
        self._idle, self._first, self._counts = idle, first, counts
        self._begins: deque[float] = deque(maxlen=capacity)
        self._actions: deque[Action] = deque(maxlen=capacity)
        self.length = 0

    def held(self, now: float, elapsed: int) -> Action:
        """Return what the plant does at `now` if it gets no new command."""
        missed = self._gap(now, elapsed) > 1
        return self._actions[-1] if self._actions and not missed else self._uncommanded()

    def age(self, stamp: float, now: float, elapsed: int) -> tuple[int, int, list[Action]]:
        """Locate an observation that was made at `stamp`, for a command at `now`, `elapsed` steps after the start.

        Returns:
            The step of the observation; its age, which is the number of steps from there to the step of the command;
            and the actions of these steps, oldest first: fewer than the age if the oldest are no longer remembered.
        """
        gap = self._gap(now, elapsed)
        added = self._begins_up_to(now, gap)
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
            i = min(0, math.floor((stamp - begins[0]) / self._dt + 0.5))
        step = min(max(0, first + i), commanded - self.lead)
        return step, commanded - step, actions[max(0, step - first) :]

    def record(self, action: Action, now: float, elapsed: int) -> None:
        """Add a command given at `now`, and the steps without a command before it."""
        gap = self._gap(now, elapsed)
        added = self._begins_up_to(now, gap)
        if gap == 0:
            self._actions[-1] = action
            self._counts["replaced"] += 1
            return
        self._counts["missed"] += gap - 1 if self.length else elapsed
        self._actions.extend([*[self._uncommanded()] * (len(added) - 1), action])
        self._begins.extend(added)
        self.length += gap

    def correct(self, action: Action, step: int | None) -> bool:
        """Replace the action of a step, of the newest if None, and where the plant went on with it after that.

        Returns False if the step is no longer remembered.
        """
        try:
            number = self.length - 1 if step is None else operator.index(step)
        except TypeError:
            raise DelayRLError(f"a step is a whole number; got {step!r}") from None
        if not 0 <= number < self.length:
            raise DelayRLError(f"there are actions of {self.length} steps, from 0 on; got step {number}")
        position = number - (self.length - len(self._actions))
        if position < 0:
            return False
        corrected, own = self._actions[position], self._idle is not None or self._actions[position] is self._first
        self._actions[position] = action
        while not own and (position := position + 1) < len(self._actions) and self._actions[position] is corrected:
            self._actions[position] = action  # of a step without a command, in which the plant went on
        return True

    def _gap(self, now: float, elapsed: int) -> int:
        """Return the steps from the newest step to that of a command at `now`; 0 if they are the same."""
        if not self._begins:
            return elapsed + self.lead + 1
        return math.floor((now + self.lead * self._dt - self._begins[-1]) / self._dt + 0.5)

    def _begins_up_to(self, now: float, gap: int) -> list[float]:
        """Return when the `gap` steps after the newest begin, up to that of a command at `now`; long gaps are cut."""
        begin = now + self.lead * self._dt
        uncommanded = min(gap - 1, self._capacity)
        if uncommanded < 0:
            return []
        if self._begins:  # without a command the plant went on, a period at a time
            last = self._begins[-1]
            return [last + (gap - uncommanded + i) * self._dt for i in range(uncommanded)] + [begin]
        return [begin - (uncommanded - i) * self._dt for i in range(uncommanded)] + [begin]

    def _uncommanded(self) -> Action:
        """Return the action of a step that has no command."""
        if self._idle is not None:
            return self._idle
        return self._actions[-1] if self._actions else self._first


class Shown(NamedTuple):
    """The observation that a command is chosen on, and the newest one, seen from that command."""

    obs: NDArray[np.float64]
    age: int
    actions: list[Action]  # those since, oldest first; fewer than the age if the oldest are no longer remembered
    newest_age: int
    newest_delay: float  # the time from the newest's stamp to the command
    warm: bool  # whether the newest was made after the first command
    held: Action  # what the plant does if it gets no new command


class Episode:
    """Judge observations and record commands.

    Args:
        number: of the episode.
        start: when it began; -inf leaves that to the first observation or command.
        clock: checks times.
        history: of the steps.
        min_age: steps that observations are held back for.
        max_age: the policy's longest age; an observation is held back only as long as that leaves one to show.
    """

    def __init__(self, number: int, start: float, clock: Clock, history: History, min_age: int, max_age: int) -> None:
        self.number, self.history = number, history
        self._start, self._clock, self._min_age, self._max_age = start, clock, min_age, max_age
        self._kept: list[tuple[float, NDArray[np.float64]]] = []  # the one to show and those held back, by their stamps
        self._oldest = self._last_command = -math.inf  # the stamp that those to come must not be older than
        self._latest = -math.inf  # the latest time that was told
        self._first_command: int | None = None  # in steps from the start

    @property
    def ready(self) -> bool:
        """Whether an observation has arrived."""
        return bool(self._kept)

    def observe(self, obs: NDArray[np.float64], stamp: float, now: float | None, episode: int | None) -> Arrival:
        """Keep an observation if it is the newest, or to be held back; return what became of it."""
        arrival = self._judge(obs, stamp, now, episode)
        if arrival == "new":
            insort(self._kept, (stamp, obs), key=_stamp)
            if self._start == -math.inf:
                self._start = stamp
            if not self._holds:
                self._oldest = stamp
            del self._kept[: -MOST_HELD if self._holds else -1]
        return arrival

    @property
    def _holds(self) -> bool:
        """Whether observations are held back: not before the first command, as training begins with a fresh one."""
        return self._min_age > 0 and self._first_command is not None

    def command_time(self, now: float | None) -> float:
        """Return `now` as a float. Raises ClockError unless it is after the last command."""
        time = self._now(now)
        if time <= self._last_command:
            last = f"the last command was at {self._last_command:g}"
            raise ClockError(f"time went backwards, or stood still: now is {time:g}, and {last}")
        if self._clock.stamps == "steps" and time < 0:
            raise ClockError(f"steps count from 0; now is {time:g}")
        return time

    def shown(self, now: float) -> Shown:
        """Return the observation to show, with its age. Raises DelayRLError if none has arrived before `now`."""
        if not self._kept:
            hint = "wait until `controller.ready`; `statistics` counts what was refused"
            raise DelayRLError(f"this episode has no observation: {hint}")
        if (newest := self._kept[-1][0]) > now + self._clock.dt / 2:
            raise ClockError(f"now is {now:g}, more than half a step before the newest observation, made at {newest:g}")
        elapsed = self._elapsed(now)

        def located(kept: tuple[float, Any]) -> tuple[int, int, list[Action]]:
            return self.history.age(kept[0], now, elapsed)

        step, newest_age, actions = located(self._kept[-1])
        age = newest_age
        if len(self._kept) > 1:
            index = max(0, bisect_right(self._kept, -self._min_age, key=lambda kept: -located(kept)[1]) - 1)
            index += index + 1 < len(self._kept) and located(self._kept[index])[1] > self._max_age
            del self._kept[:index]
            _, age, actions = located(self._kept[0])
        self._oldest, obs = self._kept[0]
        warm = self._first_command is not None and step > self._first_command
        return Shown(obs.copy(), age, actions, newest_age, now - newest, warm, self.history.held(now, elapsed))

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
        time = self._now(now)
        self._latest = max(self._latest, time)
        if stamp > time + self._clock.dt / 2:
            return "future"
        place = bisect_left(self._kept, stamp, key=_stamp)
        if place < len(self._kept) and stamp == self._kept[place][0]:
            return "duplicate"
        back = self._holds and time < self._latest - self._clock.dt / 2  # stamps repeat what was held back
        return "late" if stamp < self._oldest or back else "new"

    def _now(self, now: float | None) -> float:
        return self._clock.now(now, max(0, self.history.length - self.history.lead))

    def _elapsed(self, now: float) -> int:
        """Return the steps from the start to `now`: none of them had a command if the first is given then."""
        return max(0, math.floor((now - self._start) / self._clock.dt + 0.5))


def _stamp(kept: tuple[float, NDArray[np.float64]]) -> float:
    return kept[0]


def numbers(values: ArrayLike, dtype: Any) -> NDArray[Any]:
    """Return an array of numbers of this type. Raises DelayRLError for anything else."""
    try:
        with np.errstate(over="ignore"):  # overflow gives infinity, which is refused where it matters
            return np.array(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise DelayRLError(f"a flat array of numbers is needed; got {' '.join(repr(values).split())[:80]}") from error
