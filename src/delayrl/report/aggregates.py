"""Aggregates: interquartile means and performance profiles of each agent over tasks, with 95 % intervals."""

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from delayrl.report import statistics
from delayrl.report.results import Result, Setting, agent_order, delay_order
from delayrl.report.statistics import Floats

THRESHOLDS = np.round(np.linspace(-0.25, 2.5, 56), 2)
"""At which normalised returns a performance profile is taken."""


class Aggregate(NamedTuple):
    """One agent over all tasks of one delay.

    Attributes:
        setting, delay, label: of the results; a delay of None stands for all constant delays.
        iqm, low, high: interquartile mean of the normalised return and its interval.
        tasks: how many; over all constant delays each task counts with each delay.
        runs: how many.
        profile, profile_low, profile_high: fraction of the runs above each of THRESHOLDS, and its interval.
    """

    setting: Setting
    delay: int | str | None
    label: str
    iqm: float
    low: float
    high: float
    tasks: int
    runs: int
    profile: Floats
    profile_low: Floats
    profile_high: Floats


def make_aggregates(results: Iterable[Result]) -> list[Aggregate]:
    """Aggregate the results of learners whose seeds have ended and whose task has both anchors."""
    strata: dict[tuple[Setting, int | str | None, str], list[Floats]] = defaultdict(list)
    for result in results:
        place, scores = result.place, result.normalise(result.curves.final)
        if result.is_anchor or result.partial or not scores.size or np.isnan(scores).any():
            continue
        strata[place.setting, place.delay, place.label].append(scores)
        if isinstance(place.delay, int):
            strata[place.setting, None, place.label].append(scores)
    delays: dict[Setting, set[int]] = defaultdict(set)
    for setting, delay, _ in strata:
        if isinstance(delay, int):
            delays[setting].add(delay)
    chosen = [key for key in strata if key[1] is not None or len(delays[key[0]]) > 1]
    return sorted((_aggregate(*key, strata[key]) for key in chosen), key=_order)


def _aggregate(setting: Setting, delay: int | str | None, label: str, scores: list[Floats]) -> Aggregate:
    pooled = np.concatenate(scores)
    iqm = float(statistics.interquartile_mean(pooled))
    low, high = statistics.stratified_bootstrap(scores, statistics.interquartile_mean)
    profile = statistics.performance_profile(pooled, THRESHOLDS)
    band = statistics.stratified_bootstrap(scores, lambda x: statistics.performance_profile(x, THRESHOLDS), 500)
    return Aggregate(setting, delay, label, iqm, float(low), float(high), len(scores), pooled.size, profile, *band)


def _order(aggregate: Aggregate) -> tuple[Any, ...]:
    """Each delay, then all constant delays together."""
    delay = aggregate.delay
    return aggregate.setting, delay is None, delay_order(0 if delay is None else delay), agent_order(aggregate.label)
