"""The runtime of a delayed policy: it keeps the history right. NumPy alone, no JAX.

A policy that acts on late observations needs three things that agree: the newest observation that has arrived, its age,
and the actions that the plant was given since. `Controller` owns all three, and shows its policy what
`delayrl.wrappers.Delayed` would, whatever the network does to the observations.

Time is a list of *steps*, one for each control period; each holds the action that the plant was given in it. s_k is the
state when k steps were over. When the action of step n is chosen, the age of s_k is n - k, and the actions of the steps
k..n-1 are those since. The age counts entries of this list; it is never computed from elapsed time.

`stamps="steps"`: the stamp of an observation is k. No clock is read: for tests, and for simulators that wait.

`stamps="seconds"`: the stamp is when the observation was made, on the clock that `now` is read from. With a period dt:
  - A command g seconds after the newest step began counts as m = ⌊g/dt + ½⌋ steps. The rule is m = 1, however uneven
    the period. m > 1: the plant went on for m - 1 steps without a command; they are in the history, dt apart. m = 0:
    the command before was hardly carried out; the new one takes its place.
  - An observation belongs to the step whose beginning is nearest to its stamp; halfway counts as the later one. None
    is younger than `now`.
  - Step 0 begins with the episode: at `reset`, or without one with the first observation or command. The steps before
    the first command, by the same rounding, had none: so a first observation that comes late is as old as it is.

A command that takes effect κ steps after it was given (`action_delay`) has its step begin κ·dt later. So commands in
flight are in the history, and an observation that is made now has the age κ.
"""

import math
import operator
import threading
import time
from collections.abc import Callable
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delayrl.deploy.runtime.history import Action, History
from delayrl.deploy.runtime.statistics import Moments, Statistics
from delayrl.errors import DelayRLError

Arrival = Literal["new", "late", "duplicate", "invalid", "future"]
"""What became of an observation: used, or why not."""
OnOverrun = Literal["hold", "clip", "raise"]
Stamps = Literal["steps", "seconds"]

KEPT = 64
"""Steps that are remembered beyond Δ + κ. An older observation is an overrun anyway; its age is then an estimate."""
SHORTEST, LONGEST = 1e-6, 1e6
"""Seconds of a step."""
FARTHEST = 1e15
"""No time is farther from 0, in steps or seconds: beyond, floating point does not tell neighbours apart."""


class OverrunError(DelayRLError):
    """The newest observation is older than any that the policy was trained for (`on_overrun="raise"`)."""


class ClockError(DelayRLError):
    """Time did not go forward."""


class Policy(Protocol):
    """What is run: sizes, the range of actions [A], the longest age Δ, and seconds a step (None where unknown)."""

    obs_size: int
    action_size: int
    low: NDArray[Any]
    high: NDArray[Any]
    max_age: int
    dt: float | None

    def __call__(self, obs: NDArray[Any], actions: NDArray[np.float32], age: int) -> NDArray[np.float32]:
        """The action [A] for an observation [S] of this age and the actions [Δ, A] since, oldest first, then zeros."""
        ...


class Controller:
    """Runs a policy on a plant whose observations arrive late.

    `observe` may be called from another thread than `act`; neither makes the other wait for the policy.

    Args:
        policy: see `Policy`. It is asked once here, so that what it compiles at its first call delays no action.
        stamps: "steps" or "seconds", the unit of every stamp and of `now`.
        dt: seconds a step, for stamps in seconds; None for the policy's own.
        action_delay: steps from a command to its effect, κ. It is part of the age. None for the policy's own
            `action_delay`, that of its training; 0 where it has none.
        on_overrun: what `act` does while the newest observation is older than the policy's longest age Δ.
            "hold": the newest action of the history, once more; the policy is not asked.
            "clip": what the policy does at age Δ, for the observation and the first Δ actions after it: the right
            action for an earlier moment, from an input that training has seen. As "hold" once these are forgotten.
            "raise": `OverrunError`, and nothing is recorded.
        idle: what the plant does in a step without a command, [A]; None if it goes on with the one before (before the
            first: zeros, or what is nearest to them in range).
        clock: where `now` comes from when it is left out and stamps are in seconds.

    Raises:
        DelayRLError: arguments that do not fit each other.
    """

    _obs: NDArray[np.float64] | None
    _start: float
    _first: int | None

    def __init__(
        self,
        policy: Policy,
        *,
        stamps: Stamps = "steps",
        dt: float | None = None,
        action_delay: int | None = None,
        on_overrun: OnOverrun = "hold",
        idle: ArrayLike | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if stamps not in get_args(Stamps):
            raise DelayRLError(f"stamps are in steps or in seconds; got {stamps!r}")
        if on_overrun not in get_args(OnOverrun):
            raise DelayRLError(f"on_overrun is hold, clip or raise; got {on_overrun!r}")
        if action_delay is None:
            action_delay = getattr(policy, "action_delay", 0)
        if isinstance(action_delay, bool) or not isinstance(action_delay, int | np.integer) or action_delay < 0:
            raise DelayRLError(f"action_delay counts whole steps; got {action_delay!r}")
        if action_delay > policy.max_age:
            raise DelayRLError(
                f"an action delay of {action_delay} steps is itself above the policy's longest age, {policy.max_age}"
            )
        if stamps == "steps" and dt is not None:
            raise DelayRLError("dt goes with stamps='seconds'; steps have no length")
        if stamps == "seconds":
            dt = policy.dt if dt is None else dt
            if isinstance(dt, bool) or not isinstance(dt, int | float | np.number) or not SHORTEST <= dt <= LONGEST:
                allowed = f"{SHORTEST:g} .. {LONGEST:g}"
                raise DelayRLError(f"stamps in seconds need the seconds of a step, {allowed}: give dt=…; got {dt!r}")
        self.policy, self.stamps, self.on_overrun, self.action_delay = policy, stamps, on_overrun, int(action_delay)
        self._period, self._clock = 1.0 if dt is None else float(dt), clock
        self._idle = None if idle is None else self._action(idle, "idle")
        self._acting, self._state = threading.Lock(), threading.Lock()  # always taken in this order
        self._counts = dict.fromkeys([*get_args(Arrival), "decisions", "overruns", "overridden"], 0)
        self._missed = self._replaced = 0  # of the episodes before
        self._ages, self._delays, self._periods = Moments(), Moments(), Moments()
        self._episode = 0
        self._begin(0.0 if stamps == "steps" else -math.inf)
        policy(np.zeros(policy.obs_size), np.zeros((policy.max_age, policy.action_size), np.float32), 0)

    @property
    def ready(self) -> bool:
        """Whether an observation has arrived in this episode."""
        return self._obs is not None

    @property
    def episode(self) -> int:
        """How many times `reset` was called."""
        return self._episode

    @property
    def step(self) -> int:
        """The step that the newest command is for; -1 before the first."""
        return self._history.length - 1

    def reset(self, now: float | None = None) -> None:
        """Start an episode: forget observations and actions. What was stamped before `now` (seconds) will not be used.

        Raises:
            ClockError: `now` is not finite, or beyond ±1e15.
        """
        with self._acting, self._state:
            start = 0.0 if self.stamps == "steps" else self._time(now)
            self._missed += self._history.missed
            self._replaced += self._history.replaced
            self._episode += 1
            self._begin(start)

    def observe(self, obs: ArrayLike, stamp: float, now: float | None = None, *, episode: int | None = None) -> Arrival:
        """Take in an observation, in whatever order and however often it arrives.

        Args:
            obs: [S].
            stamp: when it was made: how many steps were over, or seconds.
            now: when it arrived; left out: the clock, or the steps commanded so far. These stand still until the first
                command, so give `now` until then: if s_0 is lost, s_1 would be of the future.
            episode: where it belongs, as `controller.episode` counts; None for the present one. Stamps in steps start
                again at 0: what may still travel when an episode ends must carry it.

        Returns:
            "new" if it is the newest now. Else why it is not used: "late" (older than the newest, or of another
            episode), "duplicate" (the newest's stamp; the first one counts), "invalid" (not finite in single precision,
            a step below 0, or a stamp beyond ±1e15), "future" (stamped more than half a period after `now`).

        Raises:
            DelayRLError: another size, a stamp that is no number or a fraction of a step: mistakes of a program,
                not of a network.
        """
        values = _numbers(obs, np.float64)
        if values.shape != (self.policy.obs_size,):
            raise DelayRLError(
                f"the policy takes observations of size {self.policy.obs_size}; got shape {values.shape}"
            )
        stamp = self._number(stamp)
        with self._state:
            arrival = self._judge(values, stamp, now, episode)
            self._counts[arrival] += 1
            if arrival == "new":
                self._obs, self._stamp = values, stamp
                if self._start == -math.inf:
                    self._start = stamp
        return arrival

    def act(self, now: float | None = None) -> Action:
        """Choose the command that is given to the plant at `now`.

        Args:
            now: how many steps are over, or seconds; left out: one step after the last call, or the clock. Where
                commands take effect at times that are known beforehand, the time of the effect, less κ·dt.

        Returns:
            [A], in the policy's range. It is in the history; if the plant does something else, tell `applied`.

        Raises:
            DelayRLError: no observation yet, or the policy's action is not finite. Nothing is recorded.
            ClockError: `now` is not after the last call, or more than half a period before the newest observation.
                Nothing is recorded.
            OverrunError: with `on_overrun="raise"`. Only the overrun is.
        """
        policy, limit = self.policy, self.policy.max_age
        with self._acting:
            with self._state:
                now = self._forward(now)
                if self._obs is None:
                    raise DelayRLError("no observation has arrived in this episode: wait until `controller.ready`")
                if self._stamp > now + self._period / 2:
                    raise ClockError(f"time went backwards: now is {now:g}, an observation of {self._stamp:g} is here")
                step, age, since = self._history.age(self._stamp, now, self._elapsed(now))
                warm = self._first is not None and step > self._first
                obs, stamp, action = self._obs.copy(), self._stamp, self._history.last.copy()
                if age > limit:
                    self._counts["overruns"] += 1
                    if self.on_overrun == "raise":
                        raise OverrunError(f"the policy was trained for ages 0..{limit}; the newest is {age} steps old")
            if age <= limit or (self.on_overrun == "clip" and len(since) == age):
                shown = min(age, limit)
                actions = np.zeros((limit, policy.action_size), np.float32)
                if shown:
                    actions[:shown] = since[:shown]
                action = self._action(policy(obs, actions, shown), "the policy's action")
                action = np.clip(action, policy.low, policy.high).astype(np.float32)
            with self._state:
                before = self._record(action, now)
                self._counts["decisions"] += 1
                if warm:
                    self._ages.add(age)
                    if self.stamps == "seconds":
                        self._delays.add(now - stamp)
                        self._periods.add(now - before)
        return action.copy()

    def override(self, action: ArrayLike, now: float | None = None) -> None:
        """Take down a command that somebody else (a person, a safe stop) gives to the plant at `now`; for `act`.

        Raises:
            DelayRLError: another size, or not finite.
            ClockError: `now` is not after the last call.
        """
        values = self._action(action, "the action")
        with self._acting, self._state:
            self._record(values, self._forward(now))
            self._counts["overridden"] += 1

    def applied(self, action: ArrayLike, step: int | None = None) -> bool:
        """Correct the history: what the plant really did in a step: an actuator saturated, a packet was lost.

        Args:
            action: [A]; it may lie outside of the policy's range.
            step: as `controller.step` was after `act`; None for the newest.

        Returns:
            Whether the step is still remembered.

        Raises:
            DelayRLError: another size, not finite, or a step that has no action.
        """
        values = self._action(action, "the action")
        with self._state:
            step = self._history.length - 1 if step is None else _whole(step)
            if not 0 <= step < self._history.length:
                raise DelayRLError(f"there are actions of {self._history.length} steps, from 0 on; got step {step}")
            return self._history.correct(values, step)

    @property
    def statistics(self) -> Statistics:
        """A snapshot."""
        with self._state:
            return Statistics(
                **self._counts,
                missed=self._missed + self._history.missed,
                replaced=self._replaced + self._history.replaced,
                counted=self._ages.count,
                age_mean=self._ages.mean,
                age_std=self._ages.std,
                age_max=int(self._ages.largest) if self._ages.count else 0,
                delay_mean=self._delays.mean,
                delay_std=self._delays.std,
                period_mean=self._periods.mean,
                period_std=self._periods.std,
            )

    def _begin(self, start: float) -> None:
        policy = self.policy
        first = np.clip(np.zeros(policy.action_size, np.float32), policy.low, policy.high).astype(np.float32)
        kept = policy.max_age + self.action_delay + KEPT
        self._history = History(self._period, self.action_delay, kept, self._idle, first)
        self._obs = None
        self._stamp, self._start = -math.inf, start  # start: -inf if the first observation or command is to say it
        self._last = -math.inf  # when the last command was given
        self._first = None  # steps before the first command

    def _record(self, action: Action, now: float) -> float:
        if self._start == -math.inf:
            self._start = now
        elapsed = self._elapsed(now)
        self._first = elapsed if self._first is None else self._first
        self._history.record(action, now, elapsed)
        before, self._last = self._last, now
        return before

    def _elapsed(self, now: float) -> int:
        """Steps from the start of the episode to `now`: without a command, if the first one is given then."""
        return max(0, math.floor((now - self._start) / self._period + 0.5))

    def _judge(self, values: NDArray[Any], stamp: float, now: float | None, episode: int | None) -> Arrival:
        with np.errstate(over="ignore"):  # policies compute in single precision
            finite = np.isfinite(values.astype(np.float32)).all()
        if not (finite and abs(stamp) <= FARTHEST) or (self.stamps == "steps" and stamp < 0):
            return "invalid"
        if (episode is not None and episode != self._episode) or stamp < self._start:
            return "late"
        if stamp > self._time(now) + self._period / 2:
            return "future"
        if stamp == self._stamp:
            return "duplicate"
        return "late" if stamp < self._stamp else "new"

    def _forward(self, now: float | None) -> float:
        """`now`, if it is after the last command."""
        now = self._time(now)
        if now <= self._last:
            raise ClockError(f"time went backwards: now is {now:g}, the last command was given at {self._last:g}")
        if self.stamps == "steps" and now < 0:
            raise ClockError(f"steps count from 0; now is {now:g}")
        return now

    def _time(self, now: float | None) -> float:
        """`now`, or what stands for it."""
        if now is None:
            now = self._clock() if self.stamps == "seconds" else max(0, self._history.length - self.action_delay)
        now = self._number(now)
        if not abs(now) <= FARTHEST:
            raise ClockError(f"now must be finite, within ±{FARTHEST:g}; got {now}")
        return now

    def _number(self, stamp: float) -> float:
        if isinstance(stamp, bool | np.bool_) or not isinstance(stamp, int | float | np.integer | np.floating):
            raise DelayRLError(f"a time is a number of {self.stamps}; got {stamp!r}")
        try:
            time = float(stamp)
        except OverflowError:  # a whole number above all floating-point ones
            time = math.inf if stamp > 0 else -math.inf
        if self.stamps == "steps" and math.isfinite(time) and time != math.floor(time):
            raise DelayRLError(f"steps are whole numbers; got {stamp!r}. For seconds: stamps='seconds'")
        return time

    def _action(self, action: ArrayLike, what: str) -> Action:
        values = _numbers(action, np.float32)
        if values.shape != (self.policy.action_size,) or not np.isfinite(values).all():
            raise DelayRLError(f"{what} must be {self.policy.action_size} finite numbers; got {values.tolist()}")
        return values


def _numbers(values: ArrayLike, dtype: Any) -> NDArray[Any]:
    try:
        with np.errstate(over="ignore"):  # to infinity, which is refused where it matters
            return np.array(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise DelayRLError(f"a flat array of numbers is needed; got {' '.join(repr(values).split())[:80]}") from error


def _whole(step: int) -> int:
    try:
        return operator.index(step)
    except TypeError:
        raise DelayRLError(f"a step is a whole number; got {step!r}") from None
