"""What a controller reports about itself."""

import math
from dataclasses import dataclass
from typing import Any, get_args

from delayrl.deploy.runtime.episode import Arrival, Shown, Stamps


@dataclass(frozen=True)
class Statistics:
    """Totals over all episodes since the controller was made.

    `age_*` and `delay_*` are those of the newest observation that had arrived at a decision, held back or not. Like
    `period_*` they leave out the cold start of an episode: they begin with the first decision whose newest observation
    was made after the first command. Before, the age only shows how long the episode has run. Decisions that
    `on_overrun="raise"` refuses are among `overruns`, `age_*` and `delay_*`, and not among `decisions`. The means and
    deviations are NaN while nothing has been counted (`age_min` and `age_max` are 0), and `delay_*` and `period_*` are
    NaN with stamps in steps.
    """

    decisions: int  # actions chosen by `act`
    counted: int  # decisions after the cold start, with refused ones
    age_mean: float  # steps, with actions in flight: the effective delay
    age_std: float  # steps: the jitter
    age_min: int
    age_max: int
    delay_mean: float  # seconds from an observation's stamp to the decision
    delay_std: float
    period_mean: float  # seconds between two commands
    period_std: float
    held: int  # decisions on an older observation than the newest, which `min_age` holds back
    overruns: int  # decisions with an age above the policy's longest, with refused ones and the cold start
    missed: int  # steps without a command of their own
    replaced: int  # commands that another one replaced less than half a period later
    overridden: int  # commands that somebody else gave
    new: int  # observations that were the newest when they arrived, or held back
    late: int  # observations older than the newest, or, with `min_age`, than the last shown; or of another episode
    duplicate: int  # observations with the stamp of the newest, or of one held back
    invalid: int  # observations not finite in single precision, or with a stamp beyond ±1e15 or a step below 0
    future: int  # observations stamped more than half a period after they arrived


class Moments:
    """The mean and the population standard deviation of a stream of numbers."""

    def __init__(self) -> None:
        self.count, self._mean, self._squares = 0, 0.0, 0.0

    def add(self, value: float) -> None:
        """Update the moments with one more number."""
        self.count += 1
        change = value - self._mean
        self._mean += change / self.count
        self._squares += change * (value - self._mean)

    def named(self, name: str) -> dict[str, Any]:
        """Return both under the names of `Statistics`; NaN if there are no numbers."""
        mean, std = (self._mean, math.sqrt(self._squares / self.count)) if self.count else (math.nan, math.nan)
        return {f"{name}_mean": mean, f"{name}_std": std}


class Telemetry:
    """Collect the numbers of `Statistics` while a controller runs; `counts` are its plain counters."""

    def __init__(self, stamps: Stamps) -> None:
        self._stamps = stamps
        names = ("decisions", "held", "overruns", "missed", "replaced", "overridden", *get_args(Arrival))
        self.counts = dict.fromkeys(names, 0)
        self._ages, self._delays, self._periods = Moments(), Moments(), Moments()
        self._age_min = self._age_max = 0

    def asked(self, shown: Shown) -> None:
        """Count the age and the delay of the newest observation at a decision, which may be refused."""
        if not shown.warm:
            return
        self._age_min = min(self._age_min, shown.newest_age) if self._ages.count else shown.newest_age
        self._age_max = max(self._age_max, shown.newest_age)
        self._ages.add(shown.newest_age)
        if self._stamps == "seconds":
            self._delays.add(shown.newest_delay)

    def decided(self, shown: Shown, period: float) -> None:
        """Count a decision on what was shown, `period` after the last command."""
        self.counts["decisions"] += 1
        self.counts["held"] += shown.age > shown.newest_age
        self.asked(shown)
        if shown.warm and self._stamps == "seconds":
            self._periods.add(period)

    def snapshot(self) -> Statistics:
        """Return all numbers so far."""
        moments = self._ages.named("age") | self._delays.named("delay") | self._periods.named("period")
        ages = {"counted": self._ages.count, "age_min": self._age_min, "age_max": self._age_max}
        return Statistics(**self.counts, **moments, **ages)


def served(min_age: int, max_age: int, action_delay: int, dt: float | None) -> str:
    """Say which delays of the observations a policy serves.

    Ages are rounded to steps, so a sensor at any phase of the control loop takes half a step of them
    (`delayrl.delays.any_phase`).

    Args:
        min_age: the age that observations are held back for, in steps.
        max_age: the longest age.
        action_delay: the part of it that commands take to act.
        dt: seconds a step; None if unknown.
    """
    steps = max_age - action_delay

    def late(steps: float) -> str:
        return f"{steps:g} step{'s' * (steps != 1)}" if dt is None else f"{1000 * steps * dt:.4g} ms"

    phases = f"up to {late(steps - 0.5)} at any phase" if steps else "none at another phase"
    held = f"; held back until {late(min_age - action_delay)} late" if min_age > action_delay else ""
    return f"a sensor up to {late(steps)} late in step with the control loop, {phases}{held}"
