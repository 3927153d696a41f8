"""A delay that was estimated from a log: in seconds, in steps of control, and as an argument for training."""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from delayrl.delays import PerEpisode, any_phase, uniform
from delayrl.errors import DelayRLError
from delayrl.measure import ages
from delayrl.measure.ages import TOLERANCE


@dataclass(frozen=True)
class Pair:
    """The largest correlation between the increments of a command and an observation, and its lag in seconds."""

    command: str
    observation: str
    lag: float
    r: float


@dataclass(frozen=True)
class Estimated:
    """A delay in seconds, and in steps of a control period.

    By correlation, `delay` is the dead time, from a command to the first row that reacts; `low` and `high` are the 95 %
    interval of a block bootstrap, widened by a row on each side. By stamps, they are the median, and the 2.5th and
    97.5th percentiles.
    """

    method: str  # "stamps" (exact, for each observation) or "correlation" (an estimate)
    path: str  # of the log
    delay: float
    low: float
    high: float
    row: float  # spacing of the rows in seconds, which is the resolution of a correlation
    period: float  # of control, in seconds
    rows: int  # how many were used
    warm_up: float  # seconds left out at the start
    steps: tuple[int, ...]  # of each window or observation as `step`, in order of time
    step: int  # `delay` without `wait` in steps
    span: tuple[float, float]  # the shortest and the longest delay to train for, in seconds; see `train_with`
    step_span: tuple[int, int]  # the same for a sensor in step with the loop, in steps; see `in_step`
    strength: float | None = None  # of the strongest lag; chance reaches 1 in one of a thousand logs
    peak: Pair | None = None  # largest correlation of increments; its lag includes the plant's own lag
    pairs: tuple[Pair, ...] = ()  # the strongest pairs
    renewed: float | None = None  # correlation only: seconds between two changes of the observation, the median
    wait: float = 0.0  # seconds of `delay` that a sensor may wait until it is read again, up to a period, less a row
    windows: tuple[tuple[float, float], ...] = ()  # (middle in seconds, dead time) of each part that shows one
    replay: tuple[tuple[int, int], ...] = ()  # stamps only: what `save` writes, see `ages.replay`
    echoes: tuple[str, ...] = ()  # correlation only: observations that repeat a command
    longest: float = 0.0  # the largest delay of a window or an observation, in seconds
    slowest_warm_up: float | None = None  # stamps only: the largest delay during the warm-up, in seconds
    drift: float | None = None  # stamps only: growth of the smallest delays, in parts per million: clocks run apart
    curve: tuple[tuple[float, float, float], ...] = ()  # (dead time, strength, r of the best pair's increments) by lag

    @property
    def train_with(self) -> str:
        """The argument for `delayrl train --delay`, for a sensor at any phase of the control loop.

        With stamps it covers the smallest delay to the 99th percentile of the ages that observations reach before the
        next one arrives, so lost ones count. By correlation it covers the dead time, which is known to a row and has up
        to `wait` in it, or the 10th to the 90th percentile of windows that differ, for a sensor with the period of the
        loop. The law is of each episode, or of each message if ages vary within one.
        """
        period = float(self.method != "stamps")  # theirs include it
        low, high = max(0.0, self.span[0] - self.wait) / self.period, self.span[1] / self.period
        return self._law(*any_phase(low, high, period), self._varies)

    @property
    def in_step(self) -> str:
        """The argument for a sensor in step with the control loop: the steps, or a law if they differ, as `train_with`.

        With stamps, LOW is the smallest delay, and HIGH the 99th percentile of the ages before the next observation
        arrives. With windows, they are the 10th and 90th, because a window is short and its estimate is rough.
        """
        return self._law(*self.step_span, self.method == "stamps" or self._varies)

    def _law(self, low: int, high: int, varies: bool) -> str:
        return str(high if low == high else uniform(low, high) if varies else PerEpisode(uniform(low, high)))

    @property
    def _varies(self) -> bool:
        """Whether ages vary within an episode: by more than a sensor's phase or an estimate's scatter explains."""
        # by correlation `span` has one row more, and the delay of a part is known to one row
        alike = min(self.row, self.period) if self.method == "stamps" else 2 * self.row
        return self.span[1] - self.span[0] > alike + TOLERANCE * self.period

    @property
    def counts(self) -> dict[int, int]:
        """How many windows or observations had each number of steps."""
        return dict(sorted(Counter(self.steps).items()))

    def save(self, path: str | Path) -> None:
        """Write a delay for each control step, one a line, for `--delay recorded:FILE`.

        Raises:
            DelayRLError: a delay by correlation, which is that of a part of the log and not of a step.
        """
        if not self.replay:
            hint = f"train with --delay {self.train_with}"
            raise DelayRLError(f"{self.path}: only stamps give a delay of each step to save, not a correlation; {hint}")
        Path(path).write_text("".join(f"{step}\n" for step in ages.of_each_step(self.replay)))

    def json(self) -> dict[str, Any]:
        """Return a dict for `json.dumps`."""
        fields = {"kind": "log", **asdict(self), "train_with": self.train_with, "in_step": self.in_step}
        del fields["replay"]
        return fields | {"steps": {str(step): count for step, count in self.counts.items()}}
