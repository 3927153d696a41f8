"""What a controller reports about itself."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from delayrl.deploy.runtime.clock import Stamps

Arrival = Literal["new", "late", "duplicate", "invalid", "future"]
"""What became of an observation; see `Statistics`. Only new ones are used."""


@dataclass(frozen=True)
class Statistics:
    """Totals over all episodes since the controller was made.

    `age_*`, `delay_*` and `period_*` leave out the cold start: they count the decisions of an episode from the first
    observation on that was made after the first command. Before that, the age only shows how long the episode has run.
    Decisions that `on_overrun="raise"` refuses appear in `overruns` only. The means and deviations are NaN while
    nothing has been counted (`age_max` is 0), and `delay_*` and `period_*` are NaN with stamps in steps.

    Attributes:
        decisions: actions chosen by `act`.
        counted: decisions after the cold start.
        age_mean: mean age in steps, with actions in flight: the effective delay.
        age_std: its standard deviation, the jitter.
        age_max: the largest age.
        delay_mean: mean seconds from an observation's stamp to the decision.
        delay_std: its standard deviation.
        period_mean: mean seconds between two commands.
        period_std: its standard deviation.
        overruns: decisions with an age above the policy's longest, including refused ones and the cold start.
        missed: steps without a command of their own.
        replaced: commands that another one replaced less than half a period later.
        overridden: commands that somebody else gave.
        new: observations that were used: each the newest when it arrived.
        late: observations older than the newest, or of another episode.
        duplicate: observations with the stamp of the newest.
        invalid: observations that are not finite in single precision, or have a stamp beyond ±1e15 or a step below 0.
        future: observations stamped more than half a period after they arrived.
    """

    decisions: int
    counted: int
    age_mean: float
    age_std: float
    age_max: int
    delay_mean: float
    delay_std: float
    period_mean: float
    period_std: float
    overruns: int
    missed: int
    replaced: int
    overridden: int
    new: int
    late: int
    duplicate: int
    invalid: int
    future: int


class Moments:
    """The mean, standard deviation and maximum of a stream of numbers."""

    def __init__(self) -> None:
        self.count, self.largest = 0, -math.inf
        self._mean, self._squares = 0.0, 0.0

    def add(self, value: float) -> None:
        """Update the moments with one more number."""
        self.count += 1
        self.largest = max(self.largest, value)
        change = value - self._mean
        self._mean += change / self.count
        self._squares += change * (value - self._mean)

    @property
    def mean(self) -> float:
        """The mean so far; NaN if there are no numbers."""
        return self._mean if self.count else math.nan

    @property
    def std(self) -> float:
        """The population standard deviation so far; NaN if there are no numbers."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan


class Telemetry:
    """Collect the numbers of `Statistics` while a controller runs; `counts` are its plain counters."""

    def __init__(self, stamps: Stamps) -> None:
        self._stamps = stamps
        names = ("decisions", "overruns", "missed", "replaced", "overridden", *get_args(Arrival))
        self.counts = dict.fromkeys(names, 0)
        self._ages, self._delays, self._periods = Moments(), Moments(), Moments()

    def add(self, age: int, delay: float, period: float) -> None:
        """Add a decision: the age in steps, the time since its observation was made and since the last command."""
        self._ages.add(age)
        if self._stamps == "seconds":
            self._delays.add(delay)
            self._periods.add(period)

    def snapshot(self) -> Statistics:
        """Return all numbers so far."""
        return Statistics(
            **self.counts,
            counted=self._ages.count,
            age_mean=self._ages.mean,
            age_std=self._ages.std,
            age_max=int(self._ages.largest) if self._ages.count else 0,
            delay_mean=self._delays.mean,
            delay_std=self._delays.std,
            period_mean=self._periods.mean,
            period_std=self._periods.std,
        )
