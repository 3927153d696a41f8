"""All that a report shows, computed from rows and cells. Cells are inferred where no grid names them."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from delayrl.errors import DelayRLError
from delayrl.report import statistics
from delayrl.report.results import Place, Result, Setting, agent_order, delay_order, make_results
from delayrl.report.rows import RowGroup, group_rows
from delayrl.report.statistics import Floats
from delayrl.report.tables import Table, make_tables
from delayrl.run.cell import Cell, Progress, Standing

THRESHOLDS = np.round(np.linspace(-0.25, 2.5, 56), 2)
"""At which normalised returns a performance profile is taken."""


class Aggregate(NamedTuple):
    """One agent over all tasks of one delay."""

    setting: Setting
    delay: int | str | None  # None stands for all constant delays
    label: str
    iqm: float  # interquartile mean of the normalised return; low and high are its 95 % interval
    low: float
    high: float
    tasks: int  # over all constant delays each task counts with each delay
    runs: int
    profile: Floats  # fraction of the runs above each of THRESHOLDS; the next two are its interval
    profile_low: Floats
    profile_high: Floats


@dataclass(frozen=True)
class Summary:
    """Results, tables and aggregates."""

    results: dict[Place, Result]  # in the order of their places
    shared: dict[str, Mapping[str, Any]]  # overrides that all cells of an agent have, by agent
    tables: list[Table]
    aggregates: list[Aggregate]
    unplaced: int  # how many rows belong to no cell

    @property
    def settings(self) -> list[Setting]:
        """Settings of the results, sorted."""
        return sorted({place.setting for place in self.results})

    @property
    def labels(self) -> list[str]:
        """Labels of the results, in the paper's order."""
        return sorted({place.label for place in self.results}, key=agent_order)

    def name(self, label: str) -> str:
        """Return the label, marked if the agent's behaviour reads the true state while it trains."""
        marked = any(r.privileged for place, r in self.results.items() if place.label == label)
        return f"{label} †" if marked else label


def summarise(rows: Iterable[Mapping[str, Any]], standing: Standing = ()) -> Summary:
    """Compute results, tables and aggregates.

    Args:
        rows: as in a run's rows.jsonl, in any order, read once. Column "cell" names the cell.
        standing: the cells of a grid, run or not, and how far they are. If empty, the cells are inferred from the rows.

    Raises:
        DelayRLError: a row lacks a column, holds a value of another type, or is there twice; the rows of a cell are
            of several conditions.
    """
    groups = group_rows(rows)
    standing = standing or _infer_cells(groups)
    cells = [cell for cell, _ in standing]
    group_of, unplaced = _assign_groups(groups, cells)
    labels, shared = _label_cells(cells)
    results = make_results(standing, group_of, labels)
    return Summary(results, shared, make_tables(results), _make_aggregates(results.values()), unplaced)


def _infer_cells(groups: Iterable[RowGroup]) -> Standing:
    """Make a cell of each group of rows. Its last step is taken for the step at which training ends."""
    standing = []
    for group in groups:
        runs = group.runs("agent")
        if runs:
            steps = [max(run) for run in runs.values()]
            id = repr((None, *group.condition.columns.values())) if group.cell is None else group.cell
            cell = Cell(replace(group.condition, steps=max(steps)), tuple(sorted(runs)), id)
            standing.append((cell, Progress("done" if min(steps) == max(steps) else "running", min(steps))))
    return standing


def _assign_groups(groups: Iterable[RowGroup], cells: Iterable[Cell]) -> tuple[dict[str, RowGroup], int]:
    """Find the rows of each cell that has some, by its id, and how many rows belong to no cell."""
    group_of: dict[str, RowGroup] = {}
    ids_of: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for cell in cells:
        ids_of[tuple(cell.condition.columns.values())].append(cell.id)
    known, unplaced = {id for ids in ids_of.values() for id in ids}, 0
    for group in groups:
        columns = tuple(group.condition.columns.values())
        ids = ids_of[columns] if group.cell is None else [group.cell]
        if len(ids) != 1 or ids[0] not in known:
            unplaced += group.rows
        elif group_of.setdefault(ids[0], group) is not group:
            first = tuple(group_of[ids[0]].condition.columns.values())
            raise DelayRLError(f"the rows of cell {ids[0]} are of different things: {first} and {columns}")
    return group_of, unplaced


def _label_cells(cells: Iterable[Cell]) -> tuple[dict[str, str], dict[str, Mapping[str, Any]]]:
    """Label each cell with its agent and the overrides that not all its cells share; return the shared ones too."""
    cells_of: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        cells_of[cell.condition.agent].append(cell)
    labels: dict[str, str] = {}
    shared: dict[str, Mapping[str, Any]] = {}
    for agent, group in cells_of.items():
        overrides = [cell.condition.overrides for cell in group]
        same = {k: v for k, v in overrides[0].items() if all(k in other and other[k] == v for other in overrides)}
        if same:
            shared[agent] = same
        for cell in group:
            own = [f"{k}={v}" for k, v in sorted(cell.condition.overrides.items()) if k not in same]
            labels[cell.id] = " ".join([agent, *own])
    return labels, shared


def _make_aggregates(results: Iterable[Result]) -> list[Aggregate]:
    """Aggregate the results of learners whose seeds have ended and whose task has both anchors."""
    strata: dict[tuple[Setting, int | str | None, str], list[Floats]] = defaultdict(list)
    for result in results:
        place, scores = result.place, result.normalise(result.curves.final)
        if result.is_anchor or result.partial or not scores.size or np.isnan(scores).any():
            continue
        strata[place.setting, place.delay, place.label].append(scores)
        if isinstance(place.delay, int):
            strata[place.setting, None, place.label].append(scores)
    delays = Counter(setting for setting, delay in {key[:2] for key in strata} if isinstance(delay, int))
    chosen = [key for key in strata if key[1] is not None or delays[key[0]] > 1]
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
