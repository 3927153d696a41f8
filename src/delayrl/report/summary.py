"""All that a report shows, computed from rows and cells. Cells are inferred where no grid names them."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from delayrl.errors import DelayRLError
from delayrl.report import statistics
from delayrl.report.comparisons import Comparison, make_comparisons
from delayrl.report.configurations import by_key, distinct_overrides
from delayrl.report.results import Place, Result, Setting, agent_order, ended_by_delay, make_results, make_strata
from delayrl.report.rows import RowGroup, group_rows
from delayrl.report.statistics import Floats
from delayrl.report.tables import Table, make_tables
from delayrl.run.cell import Cell, Progress, Standing
from delayrl.run.folder import versions_in

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
    """Results, tables, aggregates and comparisons."""

    results: dict[Place, Result]  # in the order of their places
    shared: dict[tuple[str, str], Mapping[str, Any]]  # overrides of all cells of an agent, or of those of one task
    tables: list[Table]
    aggregates: list[Aggregate]
    comparisons: list[Comparison]
    unplaced: int  # how many rows belong to no cell
    changed: list[str]  # tasks whose physics are not the same in all rows of one MuJoCo version
    recoded: list[str]  # agents of whose code the runs had several versions
    versions: list[Mapping[str, Any]]  # libraries, commits and hardware that the runs were trained with

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


def summarise(
    rows: Iterable[Mapping[str, Any]], standing: Standing = (), configs: Iterable[Mapping[str, Any]] = ()
) -> Summary:
    """Compute results, tables, aggregates and comparisons.

    Args:
        rows: as in a run's rows.jsonl, in any order, read once. Column "cell" names the cell.
        standing: the cells of a grid, run or not, and how far they are. If empty, the cells are inferred from the rows.
        configs: the configurations of runs, as config.json holds them. They say what a learner costs, and what tells
            inferred cells apart.

    Raises:
        DelayRLError: a row lacks a column, holds a value of another type, or is there twice; the rows of a cell are
            of several conditions.
    """
    configs = list(configs)
    groups, known = group_rows(rows), by_key(configs)
    for group in groups:
        group.config = known.get(group.key, {})
    inferred = not standing
    if standing:
        unplaced, placed = _place_groups(groups, [cell for cell, _ in standing])
    else:
        unplaced, (standing, placed) = 0, _infer_cells([group for group in groups if group.runs("agent")])
    group_of: dict[str, RowGroup] = {}
    for id, group in placed:
        if group_of.setdefault(id, group) is not group:
            raise DelayRLError(f"the rows of cell {id} are of different things: {group_of[id].key} and {group.key}")
    labels, shared = _label_cells([cell for cell, _ in standing])
    results = make_results(standing, group_of, labels, inferred=inferred)
    every, changed = results.values(), _changed_tasks([group for _, group in placed])
    made = make_tables(every), _make_aggregates(every), make_comparisons(every)
    used: list[Mapping[str, Any]] = [versions for config in configs for versions in versions_in(config)]
    return Summary(results, shared, *made, unplaced, changed, _recoded(configs), used)


def _changed_tasks(groups: Iterable[RowGroup]) -> list[str]:
    """Return the tasks of which one MuJoCo version has simulated several models: their results are of other tasks."""
    found: dict[str, set[tuple[str, str]]] = defaultdict(set)
    for group in groups:
        found[group.condition.env] |= group.physics
    return sorted(env for env, models in found.items() if len(models) > len({version for version, _ in models}))


def _recoded(configs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return agents of whose modules the runs had several versions: their results are of other agents."""
    found: dict[str, set[str]] = defaultdict(set)
    for config in configs:
        found[str(config.get("agent"))] |= {str(used.get("agent_code", "")) for used in versions_in(config)} - {""}
    return sorted(agent for agent, codes in found.items() if len(codes) > 1)


Placed = list[tuple[str, RowGroup]]
"""The id of a cell, with rows of it."""


def _infer_cells(groups: Sequence[RowGroup]) -> tuple[Standing, Placed]:
    """Make a cell of each group of rows. It ends at the last of its steps, or at a later one that its runs name."""
    standing, placed = [], []
    for group, overrides in zip(groups, distinct_overrides(groups), strict=True):
        runs = group.runs("agent")
        steps = [max(run) for run in runs.values()]
        end = max(*steps, group.config["schedule"]["steps"] if group.config else 0)
        id = repr((None, *group.key)) if group.cell is None else group.cell
        cell = Cell(replace(group.condition, steps=end, overrides=overrides), tuple(sorted(runs)), id)
        standing.append((cell, Progress("done" if min(steps) == end else "begun", min(steps))))
        placed.append((id, group))
    return standing, placed


def _place_groups(groups: Iterable[RowGroup], cells: Iterable[Cell]) -> tuple[int, Placed]:
    """Find the rows of each cell, by its id or its condition; return first how many rows belong to no cell."""
    ids_of: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for cell in cells:
        ids_of[tuple(cell.condition.columns.values())].append(cell.id)
    known, unplaced, placed = {id for ids in ids_of.values() for id in ids}, 0, []
    for group in groups:
        ids = ids_of[tuple(group.condition.columns.values())] if group.cell is None else [group.cell]
        if len(ids) == 1 and ids[0] in known:
            placed.append((ids[0], group))
        else:
            unplaced += group.rows
    return unplaced, placed


def _label_cells(cells: Iterable[Cell]) -> tuple[dict[str, str], dict[tuple[str, str], Mapping[str, Any]]]:
    """Label each cell with its agent and the overrides that tell apart the agent's cells of one task.

    Returns the other overrides too: of all cells of an agent, by (agent, ""), and of those of a task, by (agent, task).
    """
    cells_of: dict[str, dict[str, list[Cell]]] = defaultdict(lambda: defaultdict(list))
    for cell in cells:
        cells_of[cell.condition.agent][cell.condition.env].append(cell)
    labels: dict[str, str] = {}
    shared: dict[tuple[str, str], Mapping[str, Any]] = {}
    for agent, of_task in cells_of.items():
        group = [cell for some in of_task.values() for cell in some]
        telling = {name for some in of_task.values() for name in _differing(some)}
        for env, some in {"": group, **of_task}.items():
            known = shared.get((agent, ""), {}).keys() | telling | (set() if env else _differing(group))
            if own := {k: v for k, v in some[0].condition.overrides.items() if k not in known}:
                shared[agent, env] = own
        for cell in group:
            words = [f"{k}={v}" for k, v in sorted(cell.condition.overrides.items()) if k in telling]
            labels[cell.id] = " ".join([agent, *words])
    return labels, shared


def _differing(cells: Sequence[Cell]) -> set[str]:
    """Return the overrides that not all cells have alike."""
    first, *others = (cell.condition.overrides for cell in cells)
    return {k for other in others for k in {*first, *other} if (k in first, first.get(k)) != (k in other, other.get(k))}


def _make_aggregates(results: Iterable[Result]) -> list[Aggregate]:
    """Aggregate the results of learners whose seeds have ended and whose task has both anchors.

    Only agents with the same tasks can be compared: an agent that lacks a task of another's is left out, and one that
    is then alone too.
    """
    normalised = [result for result in results if not np.isnan(result.final).any()]
    aggregates = []
    for (setting, delay), ended in ended_by_delay(normalised).items():
        results_of: dict[str, list[Result]] = defaultdict(list)
        for result in ended:
            results_of[result.place.label].append(result)
        tasks_of = {
            label: {(r.place.env, r.place.delay, r.condition.steps) for r in own} for label, own in results_of.items()
        }
        every = set().union(*tasks_of.values())
        if delay is None and len({constant for _, constant, _ in every}) == 1:
            continue  # the same as at this delay
        whole = sorted((label for label, tasks in tasks_of.items() if tasks == every), key=agent_order)
        if len(whole) > 1 or len(results_of) == 1:
            aggregates += [_aggregate(setting, delay, label, results_of[label]) for label in whole]
    return aggregates


def _aggregate(setting: Setting, delay: int | str | None, label: str, results: list[Result]) -> Aggregate:
    """Aggregate as many seeds of each task as the one with fewest has: else tasks with more would count for more."""
    fewest = min(result.runs for result in results)
    results = [replace(r, curves=r.curves._replace(returns=r.curves.returns[:fewest])) for r in results]
    pooled = np.concatenate([result.final for result in results])
    strata = make_strata(results)
    iqm = float(statistics.interquartile_mean(pooled))
    low, high = statistics.stratified_bootstrap(strata, statistics.interquartile_mean)
    profile = statistics.performance_profile(pooled, THRESHOLDS)
    band = statistics.stratified_bootstrap(strata, lambda x: statistics.performance_profile(x, THRESHOLDS))
    return Aggregate(setting, delay, label, iqm, float(low), float(high), len(results), pooled.size, profile, *band)
