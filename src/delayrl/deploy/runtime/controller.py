"""Run a policy on a plant whose observations arrive late. Needs NumPy alone, no JAX.

Such a policy takes three things that must agree: the newest observation that has arrived, its age, and the actions
that the plant was given since. `Controller` keeps all three. It shows its policy what `delayrl.wrappers.Delayed` would
show, whatever the network does to the observations.

Time is a list of *steps*, one for each control period. Each holds the action that the plant was given in it. s_k is the
state after k steps. When the action of step n is chosen, the age of s_k is n - k, and the actions of the steps k..n-1
are those since. The age counts entries of this list; it is never computed from elapsed time.

With `stamps="steps"`, the stamp of an observation is k. No clock is read. Use it for tests, and for simulators that
wait.

With `stamps="seconds"`, the stamp is the time when the observation was made, on the clock that `now` is read from. With
a period dt:
  - A command g seconds after the newest step began counts as m = ⌊g/dt + ½⌋ steps. Usually m = 1, however uneven the
    period. If m > 1, the plant went on for m - 1 steps without a command; they enter the history, dt apart. If m = 0,
    the command before was hardly carried out; the new one replaces it.
  - An observation belongs to the step whose beginning is nearest to its stamp, and to the later of two that are equally
    near. No observation is younger than `now`.
  - Step 0 begins with the episode: at `reset`, or without a reset at the first observation or command. The steps before
    the first command, by the same rounding, had no command. So the first observation has its true age, even if it
    arrives late.

A command that takes effect κ steps after it was given (`action_delay`) has its step begin κ·dt later. So commands in
flight are in the history, and an observation that is made now has the age κ.
"""

import threading
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delayrl.deploy.runtime.episode import Action, Arrival, Clock, Episode, History, Stamps, numbers
from delayrl.deploy.runtime.telemetry import Statistics, Telemetry, served
from delayrl.errors import DelayRLError, DelayWarning

OnOverrun = Literal["hold", "clip", "raise"]
"""What `act` does while the newest observation is older than the policy's longest age Δ.

"hold" goes on with what the plant does: the newest action of the history, or `idle` after missed periods, clipped to
the policy's range. "clip" shows the policy the observation at age Δ with the first Δ actions after it, an input that
occurred in training; once these are forgotten, it holds. "raise" raises `OverrunError` and records nothing.
"""

EXTRA_STEPS = 64
"""Steps that the history keeps beyond Δ + κ. An observation that is older is an overrun, and its age an estimate."""


class OverrunError(DelayRLError):
    """The newest observation is older than any that the policy was trained for (`on_overrun="raise"`)."""


NEEDED = ("obs_size", "action_size", "low", "high", "max_age")  # what a policy must say of itself


class ControlPolicy(Protocol):
    """A policy that a controller can run: a function with its sizes and ranges, as attributes or properties.

    It may have `dt`, the seconds of a step, and `action_delay` and `min_age`, in steps, besides: the defaults of the
    Controller's arguments.
    """

    if TYPE_CHECKING:  # attributes, fields of a frozen dataclass and properties will all do

        @property
        def obs_size(self) -> int:
            """Return S."""

        @property
        def action_size(self) -> int:
            """Return A."""

        @property
        def low(self) -> ArrayLike:
            """Return the least action in range, [A]."""

        @property
        def high(self) -> ArrayLike:
            """Return the largest action in range, [A]."""

        @property
        def max_age(self) -> int:
            """Return Δ, the longest age that it accepts, in steps."""

    def __call__(self, obs: NDArray[Any], actions: NDArray[np.float32], age: int, /) -> ArrayLike:
        """Return the action [A] for an observation [S] of this age and the actions [Δ, A] since.

        The actions are in order, oldest first; zeros follow the first `age` of them.
        """


class Controller:
    """Run a policy on a plant whose observations arrive late.

    `observe` may be called from another thread than `act`, and does not wait for the policy.

    Args:
        policy: is called once here, at age 0, so that what is wrong is found, and no action waits until it compiles.
        stamps: "steps" or "seconds", the unit of every stamp and of `now`.
        dt: seconds a step, for stamps in seconds; None for the policy's own.
        action_delay: steps from a command to its effect, κ, which is part of the age. None for the policy's own
            `action_delay`, or 0 if it has none.
        min_age: steps that observations are held back for, so that the policy is shown no younger age than it knows;
            for the first command, the newest is shown. None for the policy's own `min_age`, or 0 if it has none.
        on_overrun: what `act` does while the newest observation is too old for the policy; see `OnOverrun`.
        idle: what the plant does in a step without a command, [A]. None if it goes on with the action before. Before
            the first it then does the policy's own `idle`, or zeros if it has none, clipped to the range.
        clock: returns `now` where it is left out and stamps are in seconds.

    Raises:
        DelayRLError: arguments that do not fit each other.
    """

    def __init__(
        self,
        policy: ControlPolicy,
        *,
        stamps: Stamps = "steps",
        dt: float | None = None,
        action_delay: int | None = None,
        min_age: int | None = None,
        on_overrun: OnOverrun = "hold",
        idle: ArrayLike | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        _check(policy)
        if on_overrun not in get_args(OnOverrun):
            raise DelayRLError(f"on_overrun is hold, clip or raise; got {on_overrun!r}")
        self.policy, self.stamps, self.on_overrun = policy, stamps, on_overrun
        self.action_delay = _steps(policy, "action_delay", action_delay)
        self.min_age = _steps(policy, "min_age", min_age)
        self._clock = Clock(stamps, getattr(policy, "dt", None) if stamps == "seconds" and dt is None else dt, clock)
        _warn_of_dt(policy, self._clock)
        self._act_lock, self._state_lock = threading.Lock(), threading.Lock()  # always taken in this order
        self._telemetry = Telemetry(stamps)
        actions = None if idle is None else _action(policy, idle, "idle"), _first_action(policy)
        sizes = self._clock.dt, self.action_delay, policy.max_age + self.action_delay + EXTRA_STEPS
        self._history = partial(History, *sizes, *actions, self._telemetry.counts)
        self._episode = self._new_episode(0, 0.0 if stamps == "steps" else -np.inf)
        _try(policy)

    def _new_episode(self, number: int, start: float) -> Episode:
        return Episode(number, start, self._clock, self._history(), self.min_age, self.policy.max_age)

    @property
    def dt(self) -> float:
        """The seconds of a step. Raises DelayRLError if stamps are in steps."""
        return self._clock.seconds

    @property
    def serves(self) -> str:
        """The delays of observations that the policy serves at this action delay, in words."""
        return served(self.min_age, self.policy.max_age, self.action_delay, None if self.stamps == "steps" else self.dt)

    @property
    def ready(self) -> bool:
        """Whether an observation has arrived in this episode."""
        return self._episode.ready

    @property
    def episode(self) -> int:
        """How many times `reset` was called."""
        return self._episode.number

    @property
    def step(self) -> int:
        """The step that the newest command is for; -1 before the first."""
        return self._episode.history.length - 1

    @property
    def statistics(self) -> Statistics:
        """What has happened so far, as a snapshot."""
        with self._state_lock:
            return self._telemetry.snapshot()

    def reset(self, now: float | None = None) -> None:
        """Start an episode: forget observations and actions. Later stamps before `now` (seconds) are ignored.

        Raises ClockError if `now` is not finite, or beyond ±1e15.
        """
        with self._act_lock, self._state_lock:
            self._episode = self._new_episode(self.episode + 1, self._clock.start(now))

    def observe(self, obs: ArrayLike, stamp: float, now: float | None = None, *, episode: int | None = None) -> Arrival:
        """Take in an observation. Call it for every one that arrives, in any order and as often as it arrives.

        Args:
            obs: [S].
            stamp: when it was made: how many steps were over, or seconds.
            now: when it arrived; by default the clock, or the steps commanded so far. These are 0 until the first
                command, so give `now` until then: if s_0 is lost, s_1 would lie in the future.
            episode: its episode, as `controller.episode` counts; None for the present one. Give it with stamps in
                steps, which start again at 0, if an observation may arrive after its episode has ended.

        Returns:
            What became of it: "new", "late", "duplicate", "invalid" or "future". `Statistics` explains these.

        Raises:
            DelayRLError: a wrong size, or a stamp that is not a number or a fraction of a step.
        """
        values, stamp = _observation(self.policy, obs), self._clock.number(stamp)
        with self._state_lock:
            arrival = self._episode.observe(values, stamp, now, episode)
            self._telemetry.counts[arrival] += 1
        return arrival

    def act(self, now: float | None = None) -> Action:
        """Choose the command that is given to the plant at `now`.

        Args:
            now: how many steps are over, or seconds; by default one step after the last call, or the clock. Where the
                time when the command takes effect is known, give that time less κ·dt.

        Returns:
            [A], in the policy's range. It is in the history; if the plant does something else, call `applied`.

        Raises:
            DelayRLError: no observation yet, or the policy's action is not finite. Nothing is recorded.
            ClockError: `now` is not after the last call, or more than half a period before the newest observation.
            OverrunError: with `on_overrun="raise"`. Only the overrun is counted.
        """
        policy, limit = self.policy, self.policy.max_age
        with self._act_lock:
            with self._state_lock:
                now = self._episode.command_time(now)
                shown = self._episode.shown(now)
                if (age := shown.age) > limit:
                    self._telemetry.counts["overruns"] += 1
                    if self.on_overrun == "raise":
                        self._telemetry.asked(shown)
                        raise OverrunError(f"the policy takes ages up to {limit}; the newest is {age} steps old")
            if age <= limit or (self.on_overrun == "clip" and len(shown.actions) == age):
                action = _decide(policy, shown.obs, shown.actions, min(age, limit))
            else:
                action = _in_range(policy, shown.held)
            with self._state_lock:
                self._telemetry.decided(shown, self._episode.record(action, now))
        return action.copy()

    def override(self, action: ArrayLike, now: float | None = None) -> None:
        """Record a command that somebody else (a person, a safe stop) gives to the plant at `now`, in place of `act`.

        Raises DelayRLError for a wrong size or numbers that are not finite, and ClockError if `now` is not after the
        last call.
        """
        values = _action(self.policy, action, "the action")
        with self._act_lock, self._state_lock:
            self._episode.record(values, self._episode.command_time(now))
            self._telemetry.counts["overridden"] += 1

    def applied(self, action: ArrayLike, step: int | None = None, *, episode: int | None = None) -> bool:
        """Correct the history where the plant did something else: an actuator saturated, a packet was lost.

        `action` is what the plant did, [A]; it may lie outside the policy's range. `step` is `controller.step` as it
        was after `act`, None for the newest; `episode` is `controller.episode` of that time, None for the present one.
        Returns whether the step is still remembered, which none of another episode is. Raises DelayRLError for a wrong
        size, numbers that are not finite, or a step that has no action.
        """
        values = _action(self.policy, action, "the action")
        with self._state_lock:
            return episode in (None, self.episode) and self._episode.history.correct(values, step)


def _first_action(policy: ControlPolicy) -> Action:
    """Return what the plant does before the first command: the policy's own `idle`, or zeros; in its range, [A]."""
    own = getattr(policy, "idle", None)
    first = np.zeros(policy.action_size) if own is None else own
    return _in_range(policy, _action(policy, first, "the policy's idle"))


def _try(policy: ControlPolicy) -> None:
    """Call a policy at age 0. Raises DelayRLError if its action has another size."""
    size = policy.action_size
    shape = np.shape(policy(np.zeros(policy.obs_size), np.zeros((policy.max_age, size), np.float32), 0))
    if shape != (size,):
        raise DelayRLError(f"the policy's action must be {size} numbers; got shape {shape}")


def _steps(policy: ControlPolicy, name: str, given: Any) -> int:
    """Return the given `action_delay` or `min_age`, or the policy's own. Raises DelayRLError if it cannot serve it."""
    steps = getattr(policy, name, 0) if given is None else given
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 0:
        raise DelayRLError(f"{name} counts whole steps; got {steps!r}")
    if steps > policy.max_age:
        raise DelayRLError(f"{name} is {steps} steps, and the policy's longest age {policy.max_age}")
    return int(steps)


def _decide(policy: ControlPolicy, obs: NDArray[Any], actions: Sequence[Action], age: int) -> Action:
    """Call the policy at an age that it serves, with the first `age` actions; return its action in range, [A]."""
    shown = np.zeros((policy.max_age, policy.action_size), np.float32)
    if age:
        shown[:age] = actions[:age]
    return _in_range(policy, _action(policy, policy(obs, shown, age), "the policy's action"))


def _check(policy: ControlPolicy) -> None:
    """Raise DelayRLError if a policy does not say of itself what a `ControlPolicy` does."""
    if missing := [name for name in NEEDED if not hasattr(policy, name)]:
        hint = "; export it, and give what `load_bundle` returns" if hasattr(policy, "spec") else ""
        raise DelayRLError(f"a policy also says its {', '.join(missing)} (see ControlPolicy); got {policy!r:.80}{hint}")
    if not isinstance(policy.max_age, int | np.integer) or policy.max_age < 0:
        raise DelayRLError(f"the policy's max_age is a whole number of steps, 0 or more; got {policy.max_age!r:.80}")
    low, high = numbers(policy.low, np.float64), numbers(policy.high, np.float64)
    if not low.shape == high.shape == (policy.action_size,) or not (low <= high).all():
        line = f"the policy's low and high are {policy.action_size} numbers each, none of low above that of high"
        raise DelayRLError(f"{line}; got {low.tolist()} and {high.tolist()}")


def _warn_of_dt(policy: ControlPolicy, clock: Clock) -> None:
    """Warn if steps are far from as long as those that the policy learned with."""
    learned = getattr(policy, "dt", None)
    if clock.stamps == "seconds" and learned and not 0.9 < clock.dt / learned < 1.1:
        line = f"the policy learned with steps of {learned:g} s; got dt = {clock.dt:g} s"
        warnings.warn(f"{line}: ages are counted in these", DelayWarning, stacklevel=3)


def _in_range(policy: ControlPolicy, action: Action) -> Action:
    return np.clip(action, policy.low, policy.high).astype(np.float32)


def _observation(policy: ControlPolicy, obs: ArrayLike) -> NDArray[np.float64]:
    values = numbers(obs, np.float64)
    if values.shape != (policy.obs_size,):
        raise DelayRLError(f"the policy takes observations of size {policy.obs_size}; got shape {values.shape}")
    return values


def _action(policy: ControlPolicy, action: ArrayLike, name: str) -> Action:
    values = numbers(action, np.float32)
    if values.shape != (policy.action_size,) or not np.isfinite(values).all():
        raise DelayRLError(f"{name} must be {policy.action_size} finite numbers; got {values.tolist()}")
    return values
