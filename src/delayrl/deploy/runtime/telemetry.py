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

    `age_*`, `delay_*` and `period_*` leave out the cold start of an episode: they begin with the first decision whose
    observation was made after the first command. Before, the age only shows how long the episode has run. Decisions
    that `on_overrun="raise"` refuses appear in `overruns` only. The means and deviations are NaN while nothing has been
    counted (`age_max` is 0), and `delay_*` and `period_*` are NaN with stamps in steps.
    """

    decisions: int  # actions chosen by `act`
    counted: int  # decisions after the cold start
    age_mean: float  # steps, with actions in flight: the effective delay
    age_std: float  # steps: the jitter
    age_max: int
    delay_mean: float  # seconds from an observation's stamp to the decision
    delay_std: float
    period_mean: float  # seconds between two commands
    period_std: float
    overruns: int  # decisions with an age above the policy's longest, with refused ones and the cold start
    missed: int  # steps without a command of their own
    replaced: int  # commands that another one replaced less than half a period later
    overridden: int  # commands that somebody else gave
    new: int  # observations that were used, each the newest when it arrived
    late: int  # observations older than the newest, or of another episode
    duplicate: int  # observations with the stamp of the newest
    invalid: int  # observations not finite in single precision, or with a stamp beyond ±1e15 or a step below 0
    future: int  # observations stamped more than half a period after they arrived


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
