"""Which of two agents is better: on the tasks of one delay, or of all constant ones, that both have ended on."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple, Self

import numpy as np

from delayrl.report import statistics
from delayrl.report.results import Result, Setting, agent_order, ended_by_delay, make_strata
from delayrl.report.statistics import NAN


class Estimate(NamedTuple):
    """A number with its 95 % interval; NaN where it is unknown."""

    value: float
    low: float = NAN
    high: float = NAN


class Comparison(NamedTuple):
    """Two agents, by label."""

    setting: Setting
    delay: int | str | None  # None stands for all constant delays
    one: str
    other: str
    probability: Estimate  # that a run of `one` ends above one of `other` on the same task: mean over tasks
    difference: Estimate  # of their mean normalised final returns, NaN without anchors
    tasks: int  # that both have ended on; over all constant delays each counts with each delay
    runs: tuple[int, int]  # of either

    @property
    def clear(self) -> bool:
        """Whether the interval of the probability excludes a half."""
        return self.probability.low > 0.5 or self.probability.high < 0.5

    def turned(self) -> Self:
        """Return the same from the other's side."""
        p, d, (one, other) = self.probability, self.difference, self.runs
        chance, apart = Estimate(1 - p.value, 1 - p.high, 1 - p.low), Estimate(-d.value, -d.high, -d.low)
        return self._replace(one=self.other, other=self.one, probability=chance, difference=apart, runs=(other, one))


def make_comparisons(results: Iterable[Result]) -> list[Comparison]:
    """Compare each two learners, by their seeds that have ended, in the order of their labels."""
    comparisons = []
    for (setting, delay), ended in ended_by_delay(results).items():
        at: dict[str, dict[object, Result]] = defaultdict(dict)
        for result in ended:
            at[result.place.label][result.place.env, result.place.delay, result.condition.steps] = result
        for one, other in combinations(sorted(at, key=agent_order), 2):
            pairs = [(result, at[other][key]) for key, result in at[one].items() if key in at[other]]
            if len({pair[0].place.delay for pair in pairs}) >= (2 if delay is None else 1):
                runs = sum(pair[0].runs for pair in pairs), sum(pair[1].runs for pair in pairs)
                estimates = _probability(pairs), _difference(pairs)
                comparisons.append(Comparison(setting, delay, one, other, *estimates, len(pairs), runs))
    return comparisons


def _probability(pairs: Sequence[tuple[Result, Result]]) -> Estimate:
    finals = [(one.curves.final, other.curves.final) for one, other in pairs]
    value = np.mean([statistics.probability_of_improvement(*pair) for pair in finals])
    return Estimate(float(value), *statistics.improvement_interval(finals))


def _difference(pairs: Sequence[tuple[Result, Result]]) -> Estimate:
    value = float(np.mean([one.final.mean() - other.final.mean() for one, other in pairs]))
    if np.isnan(value) or min(result.runs for pair in pairs for result in pair) < statistics.FEWEST:
        return Estimate(value)
    # one pair after the other, those of one task and length together, as their strata are
    pairs = sorted(pairs, key=lambda pair: (pair[0].place.env, pair[0].condition.steps))
    weights = [
        np.full(r.runs, sign / r.runs / len(pairs)) for pair in pairs for r, sign in zip(pair, (1, -1), strict=True)
    ]
    weight, strata = np.concatenate(weights), make_strata(result for pair in pairs for result in pair)
    low, high = statistics.stratified_bootstrap(strata, lambda scores: scores @ weight)
    return Estimate(value, float(low), float(high))
