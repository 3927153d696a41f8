"""Results: one for each condition, from the cells and rows of all its seeds, with the anchors of its task."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from delayrl.report import statistics
from delayrl.report.configurations import FROM
from delayrl.report.rows import RowGroup
from delayrl.report.statistics import NAN, Floats, Stratum
from delayrl.run.cell import Cell, CellState, Progress, Standing
from delayrl.run.condition import Condition
from delayrl.run.cost import Cost

PAPER_ORDER = ("a-sac", "dcac", "dida", "bpql", "ad-sac", "vdpo")
"""Columns of the paper's tables."""
MINOR = frozenset({"steps", "evaluate_every", "evaluation_episodes", "replay_capacity", "precision"})
"""Options that do not make another agent of a reference."""


class Curves(NamedTuple):
    """Mean return of each evaluation: steps [N], returns [runs, N]."""

    steps: NDArray[np.int64]
    returns: Floats

    @property
    def mean(self) -> Floats:
        """Over the runs, [N]."""
        return self.returns.mean(0)

    @property
    def final(self) -> Floats:
        """Of the last evaluation, [runs]."""
        return self.returns[:, -1] if self.steps.size else np.zeros(0)


NO_CURVES = Curves(np.zeros(0, np.int64), np.zeros((0, 0)))


class Anchor(NamedTuple):
    """What others are measured by; without any runs, there is no such anchor."""

    returns: Floats  # of each of its runs, [seeds]
    smoothed: Floats  # the same, of the reference's smoothed curves: the threshold that learners are to reach
    source: str = ""  # its agent
    steps: int = 0  # for which it has trained
    curves: Curves = NO_CURVES  # of the reference

    @property
    def value(self) -> float:
        """The mean over its runs; NaN without any."""
        return statistics.mean_std(self.returns)[0]


NO_ANCHOR = Anchor(np.zeros(0), np.zeros(0))


class Setting(NamedTuple):
    """What must agree before numbers stand in one table."""

    protocol: str
    preset: str


class Place(NamedTuple):
    """Where a number stands in the tables: row (env, delay), column (label)."""

    setting: Setting
    env: str
    delay: int | str
    label: str


@dataclass(frozen=True)
class Result:
    """All seeds of one condition."""

    place: Place  # the label is the agent, with what tells it from the agent's other cells
    condition: Condition  # its steps are those at which training ends
    progress: Progress  # of several cells the worst state, and the least step of the cells in that state
    seeds: int  # how many are to be run
    partial: bool  # no seed has reached its last step, so that the numbers are those of the steps so far
    privileged: bool  # whether its behaviour reads the true state while it trains
    curves: Curves  # of the complete seeds; where there is none yet, of all
    cost: Cost | None = None  # of learning, where its runs say so
    hours: float = NAN  # of its cells, at the speed since their last start; NaN where it is unknown
    options_known: bool = True  # whether a grid or the configurations of all its runs say its options
    random_anchor: Anchor = NO_ANCHOR  # its returns are normalised by this
    reference_anchor: Anchor = NO_ANCHOR  # and by this
    threshold_anchor: Anchor = NO_ANCHOR  # the same, or one that has trained for longer: what its curve is to reach

    @property
    def runs(self) -> int:
        """Seeds that the numbers are from."""
        return self.curves.returns.shape[0] if self.curves.steps.size else 0

    @property
    def is_anchor(self) -> bool:
        """Whether it stands beside the tables: the random policy, and delay-free SAC."""
        return self.condition.agent == "random" or (self.condition.agent == "sac" and self.place.delay == 0)

    def normalise(self, returns: Floats) -> Floats:
        """Return Ret_nor of raw returns of this task."""
        return statistics.normalised(returns, self.random_anchor.value, self.reference_anchor.value)

    @property
    def as_reference(self) -> str:
        """How it is named as a reference."""
        return f"{self.place.label}, no delay"

    @property
    def unfinished(self) -> str:
        """How far it is, if it has not ended; else empty."""
        state = self.progress.state
        if state == "failed" or (self.partial and self.runs):
            word = "failed at" if state == "failed" else "at"
            seen = self.curves.steps[-1:].tolist() if self.partial else []  # else those are of seeds that have ended
            return f"{word} {max([self.progress.step, *seen]):,} of {self.condition.steps:,} steps"
        return state if state in ("begun", "running") else ""

    @property
    def final(self) -> Floats:
        """Normalised final returns, [runs]."""
        return self.normalise(self.curves.final)

    @cached_property
    def final_interval(self) -> tuple[float, float]:
        """95 % interval of their mean, with the anchors' uncertainty; NaN where it is unknown, and of an anchor."""
        normalises = self.condition.agent == "random" or self.reference_anchor.source == self.as_reference
        if not self.runs or np.isnan(self.final).any() or normalises:
            return NAN, NAN
        low, high = statistics.stratified_bootstrap([self.stratum], lambda scores: scores.mean(-1))
        return float(low), float(high)

    @property
    def stratum(self) -> Stratum:
        """Its final returns with those of its anchors."""
        return Stratum(self.random_anchor.returns, self.reference_anchor.returns, [self.curves.final])

    @property
    def area(self) -> Floats:
        """Normalised area under the curve of each run, [runs]: its mean return over training."""
        return self.normalise(statistics.area(*self.curves)) if self.runs else np.zeros(0)

    @cached_property
    def smoothed(self) -> Floats:
        """Smoothed curves, [runs, N]."""
        return statistics.smoothed(self.curves.returns)

    @property
    def steps_to_threshold(self) -> float:
        """The step at which the smoothed mean over the seeds first reaches the reference's; NaN if it does not."""
        if not self.runs or self.is_anchor:
            return NAN
        return float(statistics.steps_to_threshold(self.curves.steps, self.smoothed.mean(0), self.threshold))

    @property
    def threshold(self) -> float:
        """The reference's smoothed return after its last step; NaN without anchors, or if `random` is as good."""
        reference, random = self.threshold_anchor, self.random_anchor.value
        smoothed = statistics.mean_std(reference.smoothed)[0] if reference.value > random else NAN
        return smoothed if smoothed > random else NAN

    @property
    def longer_reference(self) -> Anchor:
        """The threshold's, if it has trained for longer than this; else none."""
        return self.threshold_anchor if self.threshold_anchor.steps > self.condition.steps else NO_ANCHOR

    @property
    def missed(self) -> bool:
        """Whether training has ended, and the threshold was not reached."""
        ended = self.runs > 0 and not self.partial and not self.is_anchor and not math.isnan(self.threshold)
        return ended and math.isnan(self.steps_to_threshold)

    @cached_property
    def steps_interval(self) -> tuple[float, float]:
        """95 % interval of it, infinite where the threshold is not reached; NaN where it is unknown."""
        if not self.runs or self.is_anchor or math.isnan(self.threshold):
            return NAN, NAN
        low, high = statistics.bootstrap_steps(self.curves.steps, self.smoothed, self.threshold_anchor.smoothed)
        return (NAN, NAN) if self.partial and math.isinf(high) else (low, high)  # it may yet get there

    @property
    def seeds_at_threshold(self) -> int:
        """How many smoothed curves of single seeds reach it."""
        return int((self.smoothed >= self.threshold).any(-1).sum()) if self.runs else 0


def agent_order(label: str) -> tuple[int, str]:
    """Sort labels: the paper's columns in the paper's order, then others, the anchors last."""
    agent = label.split(" ")[0]
    known = [*PAPER_ORDER, None, "sac-memoryless", "sac", "random"]
    return known.index(agent) if agent in known else known.index(None), label


def delay_order(delay: int | str | None) -> tuple[bool, bool, int, str]:
    """Sort delays: constant ones by length, then the others by name, last None, which stands for all constant ones."""
    return delay is None, isinstance(delay, str), delay if isinstance(delay, int) else 0, str(delay)


def make_results(
    standing: Standing, group_of: Mapping[str, RowGroup], labels: Mapping[str, str], *, inferred: bool
) -> dict[Place, Result]:
    """Make a result with its anchors of all cells that differ in nothing but their seeds.

    Of cells that are inferred from rows, only configurations say the options; a grid's cells name their own.
    """
    members: dict[Place, list[tuple[Cell, Progress]]] = defaultdict(list)
    for cell, progress in sorted(standing, key=lambda item: item[0].id):
        condition = cell.condition
        setting = Setting(condition.protocol, condition.preset)
        place = Place(setting, condition.env, condition.short_delay, labels[cell.id])
        if any(set(other.seeds) & set(cell.seeds) for other, _ in members[place]):  # the same seeds again
            place = place._replace(label=f"{place.label} #{cell.id[:8]}")
        members[place].append((cell, progress))
    results = [_result(place, cells, group_of, inferred=inferred) for place, cells in members.items()]
    return {result.place: _anchored(result, results) for result in sorted(results, key=_order)}


def ended_by_delay(results: Iterable[Result]) -> dict[tuple[Setting, int | str | None], list[Result]]:
    """Group learners whose seeds have ended by setting and delay, in order; under None, those of all constant ones.

    Those of which a cell has failed are left out: the seeds that did not fail may be the better ones.
    """
    groups: dict[tuple[Setting, int | str | None], list[Result]] = defaultdict(list)
    for result in results:
        if result.is_anchor or result.partial or not result.runs or result.progress.state == "failed":
            continue
        setting, delay = result.place.setting, result.place.delay
        groups[setting, delay].append(result)
        if isinstance(delay, int):
            groups[setting, None].append(result)
    return {key: groups[key] for key in sorted(groups, key=lambda key: (key[0], delay_order(key[1])))}


def _order(result: Result) -> tuple[Any, ...]:
    place = result.place
    return place.setting, place.env, delay_order(place.delay), agent_order(place.label)


def _result(place: Place, standing: Standing, group_of: Mapping[str, RowGroup], *, inferred: bool) -> Result:
    """Complete seeds count; until there is one, all of them count as partial."""
    groups = [group_of[cell.id] for cell, _ in standing if cell.id in group_of]
    runs = {seed: run for group in groups for seed, run in group.runs("agent").items()}
    steps = max(cell.condition.steps for cell, _ in standing) or max((max(run) for run in runs.values()), default=0)
    complete = {seed for seed, run in runs.items() if max(run) >= steps}
    kept = complete or set(runs)
    progress = [progress for _, progress in standing]
    state = _state({p.state for p in progress}, bool(runs))
    return Result(
        place,
        replace(standing[0][0].condition, steps=steps),
        Progress(state, min([p.step for p in progress if p.state == state] or [p.step for p in progress])),
        len({seed for cell, _ in standing for seed in cell.seeds} | set(runs)),
        not complete,
        any(group.privileged for group in groups),
        Curves(*statistics.common_steps([runs[seed] for seed in sorted(kept)])),
        next((group.cost for group in groups if group.cost), None),
        _hours(progress),
        not inferred or all(group.config for group in groups),
    )


def make_strata(results: Iterable[Result]) -> list[Stratum]:
    """Put results that share their anchors into one stratum: those of one task and length."""
    strata: dict[tuple[str, int], list[Stratum]] = defaultdict(list)
    for result in results:
        strata[result.place.env, result.condition.steps].append(result.stratum)
    return [Stratum(*some[0][:2], [x for one in some for x in one.returns]) for some in strata.values()]


def _hours(progress: Sequence[Progress]) -> float:
    """Add up the time of cells, each at the speed that it has reported."""
    begun = [p for p in progress if p.step]
    return sum(p.step / p.speed if p.speed else NAN for p in begun) / 3600 if begun else NAN


def _state(states: set[CellState], has_rows: bool) -> CellState:
    """The worst of several cells' states. Some seeds done and others not is begun."""
    if "failed" in states:
        return "failed"
    if states == {"done"}:
        return "done"
    if "running" in states:
        return "running"
    return "begun" if "begun" in states or has_rows else "todo"


def _anchored(result: Result, others: Sequence[Result]) -> Result:
    """With the anchors of its task: same protocol and preset; delay-free SAC has trained for as many steps.

    Where none has, the threshold alone is that of one that has trained for longer.
    """
    setting, env = result.place.setting, result.place.env
    near = [o for o in others if o.place.setting.protocol == setting.protocol and o.place.env == env and o.runs]
    randoms = [o for o in near if o.condition.agent == "random"]  # it has no hyperparameters: any preset
    whole = [o for o in near if not o.partial and o.progress.state != "failed"]
    ended = [o for o in whole if o.place.setting == setting and FROM not in o.condition.overrides]
    plain = [o for o in ended if o.condition.agent == "sac" and o.place.delay == 0]
    same = [o for o in plain if o.condition.steps == result.condition.steps]
    longer = [o for o in plain if o.condition.steps > result.condition.steps]
    random = reference = threshold = NO_ANCHOR
    if randoms:  # it does not learn, so that all its evaluations are alike
        best = min(randoms, key=lambda o: (o.partial, -o.runs, o.place.setting != setting, _fewest_overrides(o)))
        random = Anchor(best.curves.returns.mean(1), best.smoothed[:, -1], "random")
    if same:
        reference = threshold = _reference(min(same, key=_fewest_overrides))
    elif longer:  # the plainest, and of those the longest
        threshold = _reference(min(longer, key=lambda o: (_changed(o), -o.condition.steps, _fewest_overrides(o))))
    return replace(result, random_anchor=random, reference_anchor=reference, threshold_anchor=threshold)


def _reference(result: Result) -> Anchor:
    smoothed = result.smoothed[:, -1]
    return Anchor(result.curves.final, smoothed, result.as_reference, result.condition.steps, result.curves)


def _fewest_overrides(result: Result) -> tuple[Any, ...]:
    return _changed(result), len(result.condition.overrides), -result.runs, _order(result)


def _changed(result: Result) -> int:
    """Count the options that make it another agent than the preset's."""
    return len(result.condition.overrides.keys() - MINOR)
