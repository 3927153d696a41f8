"""What a controller reports of itself."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Statistics:
    """What happened since the controller was made, over all episodes.

    `age_*`, `delay_*` and `period_*` leave the cold start out: a decision counts from the first one of its episode on
    whose observation was made after the first command. Before, the age only shows how long the episode has run. Ages of
    decisions that `on_overrun="raise"` refused are not in; `overruns` counts these. They are NaN while nothing has been
    counted (`age_max`: 0); `delay_*` and `period_*` also with stamps in steps.

    Attributes:
        decisions: actions chosen by `act`.
        counted: those of them after the cold start.
        age_mean: the effective delay in steps, actions in flight included.
        age_std: its jitter.
        age_max: the longest.
        delay_mean: seconds from an observation's stamp to the decision.
        delay_std: its jitter.
        period_mean: seconds between two commands.
        period_std: its jitter.
        overruns: decisions whose age was above the policy's longest, refused ones and the cold start included.
        missed: steps without a command of their own.
        replaced: commands whose place was taken by one less than half a period later.
        overridden: commands of somebody else.
        new: observations that were used.
        late: observations older than one that had arrived before, or of an episode that is over.
        duplicate: observations with the stamp of the newest.
        invalid: observations with values or stamps that are not finite or beyond reach, or of steps below 0.
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
    """Mean, standard deviation and maximum of numbers that come one by one."""

    def __init__(self) -> None:
        self.count, self.largest = 0, -math.inf
        self._mean, self._squares = 0.0, 0.0

    def add(self, value: float) -> None:
        """Take in one more."""
        self.count += 1
        self.largest = max(self.largest, value)
        change = value - self._mean
        self._mean += change / self.count
        self._squares += change * (value - self._mean)

    @property
    def mean(self) -> float:
        """Of all so far; NaN of none."""
        return self._mean if self.count else math.nan

    @property
    def std(self) -> float:
        """Of all so far, divided by their number; NaN of none."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan
