"""From rows to results: one pass over the rows, then a result for each cell, its anchors, tables and aggregates.

Everything that a report shows is computed here; `report` and `figures` only draw it.
"""

import csv
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from operator import itemgetter
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError
from delayrl.report import statistics
from delayrl.report.statistics import NAN, Floats

Delay = int | str
PAPER_ORDER = ("a-sac", "dcac", "dida", "bpql", "ad-sac", "vdpo")
"""Columns of the paper's tables."""
THRESHOLDS = np.round(np.linspace(-0.25, 2.5, 56), 2)
"""At which normalised returns a performance profile is taken."""
COLUMNS = ("agent", "env", "delay", "preset", "protocol", "seed", "step", "policy", "episode", "return")


@dataclass(frozen=True)
class Cell:
    """What is run, with which seeds, and how far it is.

    Attributes:
        id: by which rows name it (column "cell").
        agent, env, delay, preset, protocol, overrides: what is trained, on what.
        seeds: those that are to be run.
        status: "todo", "running", "done" or "failed".
        done, total: environment steps of each seed.
    """

    id: str
    agent: str
    env: str
    delay: Delay
    preset: str
    protocol: str
    seeds: tuple[int, ...]
    overrides: Mapping[str, Any]
    status: str
    done: int
    total: int


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


NOTHING = Curves(*statistics.common_steps([]))


class Anchor(NamedTuple):
    """A return that others are measured by: its value (NaN: there is none), how many runs, and where it is from.

    `inside`: it is of a reference inside another agent, for want of a delay-free SAC.
    """

    value: float = NAN
    runs: int = 0
    source: str = ""
    curves: Curves = NOTHING
    inside: bool = False


NO_ANCHOR = Anchor()


class Setting(NamedTuple):
    """What must agree before numbers stand in one table."""

    protocol: str
    preset: str


class Place(NamedTuple):
    """Where a number stands in the tables: row (env, delay), column (label)."""

    setting: Setting
    env: str
    delay: Delay
    label: str


@dataclass(frozen=True)
class Result:
    """One condition: all seeds of one agent on one task with one delay.

    Attributes:
        place: its row and column; the label is the agent, with what tells it from the agent's other cells.
        status, done, total: as a cell's; of several cells the worst, and the least done of those.
        seeds: how many are to be run. runs: how many of them `curves` holds.
        partial: no seed has reached its last step, so that the numbers are those of the steps so far.
        privileged: whether its behaviour reads the true state while it trains.
        curves: of the complete seeds; where there is none yet, of all.
        reference: the same of its delay-free reference, where it has one.
        random_anchor, reference_anchor: what its returns are normalised by.
    """

    place: Place
    agent: str
    overrides: Mapping[str, Any]
    status: str
    done: int
    total: int
    seeds: int
    partial: bool = True
    privileged: bool = False
    curves: Curves = NOTHING
    reference: Curves = NOTHING
    random_anchor: Anchor = NO_ANCHOR
    reference_anchor: Anchor = NO_ANCHOR

    @property
    def runs(self) -> int:
        """Seeds that the numbers are from."""
        return self.curves.returns.shape[0] if self.curves.steps.size else 0

    @property
    def is_anchor(self) -> bool:
        """Random and delay-free SAC stand beside the tables, not in them."""
        return self.agent == "random" or (self.agent == "sac" and self.place.delay == 0)

    def normalise(self, returns: Floats) -> Floats:
        """Ret_nor."""
        return statistics.normalised(returns, self.random_anchor.value, self.reference_anchor.value)

    @property
    def progress(self) -> list[str]:
        """A word on what is not finished."""
        if self.status == "failed" or (self.partial and self.runs):
            word = "failed at" if self.status == "failed" else "at"
            seen = self.curves.steps[-1:].tolist() if self.partial else []  # else those are of seeds that have ended
            return [f"{word} {max([self.done, *seen]):,} of {self.total:,} steps"]
        return [self.status] if self.status == "running" else []

    @property
    def steps_to_threshold(self) -> float:
        """When the mean over the seeds first reaches Ret_df; NaN where it has not, or there is no Ret_df."""
        if not self.runs:
            return NAN
        curve = self.curves
        return float(statistics.steps_to_threshold(curve.steps, curve.mean, self.reference_anchor.value))

    @property
    def seeds_at_threshold(self) -> int:
        """How many seeds reach Ret_df, each for itself."""
        if not self.runs or math.isnan(self.reference_anchor.value):
            return 0
        return int((self.curves.returns >= self.reference_anchor.value).any(-1).sum())


@dataclass(frozen=True)
class Table:
    """A table in the paper's layout: which rows and columns; the numbers are looked up by `Place`."""

    kind: Literal["normalised", "steps", "ablation", "stochastic"]
    title: str
    setting: Setting
    rows: list[tuple[str, Delay]]
    columns: list[str]


class Aggregate(NamedTuple):
    """An agent over all tasks of one delay (None: of all constant delays; `tasks` then counts each with each delay)."""

    setting: Setting
    delay: Delay | None
    label: str
    iqm: float
    low: float
    high: float
    tasks: int
    runs: int
    profile: Floats
    profile_low: Floats
    profile_high: Floats


class Figure(NamedTuple):
    """A published figure; `value` is NaN where the paper says that the threshold was not reached."""

    table: str
    value: float
    std: float


class Entry(NamedTuple):
    """One place of a table: ours, the raw return beside it, and the paper's; NaN or "" where there is none.

    `value` is a normalised return or a number of steps, `note` says what else must be known of it. `missed`: training
    is over and the threshold was not reached. `partial`: no seed has reached its last step.
    """

    value: float
    std: float
    raw: float
    raw_std: float
    missed: bool
    partial: bool
    note: str
    published: Figure | None


@dataclass(frozen=True)
class Summary:
    """All that a report shows."""

    results: dict[Place, Result]
    labels: dict[str, tuple[str, str]]
    shared: dict[str, Mapping[str, Any]]
    tables: list[Table]
    aggregates: list[Aggregate]
    unplaced: int

    @property
    def settings(self) -> list[Setting]:
        """Sorted."""
        return sorted({place.setting for place in self.results})

    def name(self, label: str) -> str:
        """The label, marked where the agent's behaviour reads the true state while it trains."""
        marked = any(r.privileged for place, r in self.results.items() if place.label == label)
        return f"{label} †" if marked else label

    def entry(self, table: Table, row: tuple[str, Delay], column: str) -> Entry:
        """What stands in a row and a column of a table."""
        published = self._published(table.kind, *row, column)
        result = self.results.get(Place(table.setting, *row, column))
        if result is None or (result.status == "todo" and not result.runs):
            return Entry(NAN, NAN, NAN, NAN, False, False, "", published)
        raw, raw_std = statistics.mean_std(result.curves.final)
        notes = [] if result.runs in (0, result.seeds) else [f"{result.runs} of {result.seeds} seeds"]
        missed = False
        if table.kind == "steps":
            value, std = result.steps_to_threshold, NAN
            if not math.isnan(result.reference_anchor.value) and result.runs:
                missed = math.isnan(value) and not result.partial
                notes += [f"{n}/{result.runs} seeds"] if (n := result.seeds_at_threshold) else []
        else:
            value, std = statistics.mean_std(result.normalise(result.curves.final))
        if result.reference_anchor.inside and result.runs:
            notes.append(f"Ret_df: {result.reference_anchor.source}")
        note = " · ".join([*notes, *result.progress])
        return Entry(value, std, raw, raw_std, missed, result.partial, note, published)

    def _published(self, kind: str, env: str, delay: Delay, label: str) -> Figure | None:
        agent, representation = self.labels.get(label, (label, "transformer"))
        measure = "steps" if kind == "steps" else "normalised"
        key = (measure, env.removeprefix("delayrl/"), str(delay), agent)
        own = paper().get((*key, representation))  # Table 3; its last column is VDPO itself, in Table 2 again
        return own if kind == "ablation" or representation != "transformer" else paper().get((*key, ""))


@cache
def paper() -> dict[tuple[str, ...], Figure]:
    """Published figures by (measure, task, delay, agent, representation); the last is "" outside the ablation."""
    text = resources.files("delayrl.report").joinpath("paper.csv").read_text("utf-8")
    number = lambda word: float(word) if word else NAN  # noqa: E731
    return {
        (row["measure"], row["task"], row["delay"], row["agent"], row["representation"]): Figure(
            row["table"], number(row["value"]), number(row["std"])
        )
        for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    }


def summarise(rows: Iterable[Mapping[str, Any]], cells: Sequence[Cell] = ()) -> Summary:
    """Results, tables and aggregates.

    Args:
        rows: as in a run's rows.jsonl, in any order, read once; column "cell" names their cell. Others are ignored.
        cells: of the grid, run or not. Without any they are inferred from the rows, and each cell's last step is taken
            for the step at which it ends.

    Raises:
        DelayRLError: a row that lacks a column, holds no number where one belongs, or is there twice.
    """
    points = _collect(rows)
    given: list[Cell] = list(cells) or list(_infer(points))
    homes, unplaced = _homes(points, given)
    names, shared = _labels(given)
    merged: dict[Place, list[Cell]] = defaultdict(list)
    for cell in sorted(given, key=lambda c: c.id):
        place = Place(Setting(cell.protocol, cell.preset), cell.env, cell.delay, names[cell.id])
        if {seed for other in merged[place] for seed in other.seeds} & set(cell.seeds):  # not a part of it: another one
            place = place._replace(label=f"{place.label} #{cell.id[:8]}")
        merged[place].append(cell)
    found = {
        place: _result(place, group, [points[h] for c in group for h in homes[c.id]]) for place, group in merged.items()
    }
    results = {place: _anchored(found[place], list(found.values())) for place in sorted(found, key=_order)}
    labels = {
        place.label: (result.agent, str(result.overrides.get("representation", "transformer")))
        for place, result in sorted(results.items(), key=lambda item: agent_order(item[0].label))
    }
    return Summary(results, labels, shared, _tables(results), _aggregates(results), unplaced)


# Rows

Home = tuple[Any, ...]  # (cell or None, agent, env, delay, preset, protocol)


class _Point(NamedTuple):
    total: float
    episodes: int  # bit e is set if episode e is there


@dataclass
class _Points:
    """Returns of what was found of one cell: (policy, seed) -> step -> sum and episodes."""

    privileged: bool
    curves: dict[tuple[str, int], dict[int, _Point]]

    def runs(self, policy: str) -> dict[int, tuple[list[int], list[float]]]:
        return {
            seed: (sorted(curve), [curve[s].total / curve[s].episodes.bit_count() for s in sorted(curve)])
            for (of, seed), curve in self.curves.items()
            if of == policy
        }


def _collect(rows: Iterable[Mapping[str, Any]]) -> dict[Home, _Points]:
    found: dict[Home, _Points] = {}
    columns = itemgetter(*COLUMNS)
    for number, row in enumerate(rows, 1):
        try:
            *what, seed, step, policy, episode, value = columns(row)
            if not (type(seed) is type(step) is type(episode) is int and 0 <= step < 2**53 and 0 <= episode < 10_000):
                raise TypeError
            if not math.isfinite(value):
                raise ValueError
            home = (row.get("cell"), *what)
            if home not in found:
                if not all(
                    isinstance(x, str) or (i == 2 and type(x) is int and abs(x) < 2**31) for i, x in enumerate(what)
                ):
                    raise TypeError
                found[home] = _Points(row.get("privileged") is True, defaultdict(dict))
            curve = found[home].curves[policy, seed]
        except KeyError as error:
            raise DelayRLError(f"row {number} of the results has no column {error}") from None
        except (TypeError, ValueError, AttributeError):
            raise DelayRLError(f"row {number} of the results is damaged: {str(row)[:200]}") from None
        total, episodes = curve.get(step, (0.0, 0))
        if episodes >> episode & 1:
            raise DelayRLError(
                f"row {number} of the results is there twice: {what[0]} on {what[1]}, delay {what[2]}, seed {seed}, "
                f"step {step}, episode {episode}; give every file of rows once"
            )
        curve[step] = _Point(total + value, episodes | 1 << episode)
    return found


def _infer(points: Mapping[Home, _Points]) -> Iterable[Cell]:
    """The cells that the rows are of."""
    for home, of in points.items():
        last = [max(curve) for (policy, _), curve in of.curves.items() if policy == "agent"]
        if last:
            seeds = tuple(sorted({seed for policy, seed in of.curves if policy == "agent"}))
            status = "done" if min(last) == max(last) else "running"
            cell, agent, env, delay, preset, protocol = home
            name = str(cell) if cell is not None else repr(home)
            yield Cell(name, agent, env, delay, preset, protocol, seeds, {}, status, min(last), max(last))


def _homes(points: Mapping[Home, _Points], cells: Sequence[Cell]) -> tuple[dict[str, list[Home]], int]:
    """Which rows belong to which cell, and how many to none: by the cell's id, else by what was run."""
    of: dict[str, list[Home]] = {cell.id: [] for cell in cells}
    alike: dict[Home, list[str]] = defaultdict(list)
    for cell in cells:
        alike[cell.agent, cell.env, cell.delay, cell.preset, cell.protocol].append(cell.id)
    unplaced = 0
    for home, found in points.items():
        named, ids = home[0], alike[home[1:]]
        if named is not None and str(named) in of:
            of[str(named)].append(home)
        elif named is None and len(ids) == 1:
            of[ids[0]].append(home)
        else:
            unplaced += sum(p.episodes.bit_count() for curve in found.curves.values() for p in curve.values())
    for name, several in of.items():
        if len(several) > 1:
            raise DelayRLError(
                f"the rows of cell {name} are of different things: {several[0][1:]} and {several[1][1:]}"
            )
    return of, unplaced


# Results


def _labels(cells: Sequence[Cell]) -> tuple[dict[str, str], dict[str, Mapping[str, Any]]]:
    """A name for each cell: its agent, and the overrides that not all cells of the agent share; those that they do."""
    of: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        of[cell.agent].append(cell)
    names: dict[str, str] = {}
    shared: dict[str, Mapping[str, Any]] = {}
    for agent, group in of.items():
        first = group[0].overrides
        same = {k: v for k, v in first.items() if all(k in c.overrides and c.overrides[k] == v for c in group)}
        if same:
            shared[agent] = same
        for cell in group:
            own = [f"{k}={v}" for k, v in sorted(cell.overrides.items()) if k not in same]
            names[cell.id] = " ".join([agent, *own])
    return names, shared


def _result(place: Place, cells: Sequence[Cell], points: Sequence[_Points]) -> Result:
    """Complete seeds count; until there is one, all of them count as partial."""
    runs = {seed: run for found in points for seed, run in found.runs("agent").items()}
    total = max((cell.total for cell in cells), default=0) or max((run[0][-1] for run in runs.values()), default=0)
    complete = {seed for seed, run in runs.items() if run[0][-1] >= total}
    kept = complete or set(runs)
    reference = {seed: run for found in points for seed, run in found.runs("reference").items() if seed in kept}
    states = [cell.status for cell in cells]
    status = next((s for s in ("failed", "running") if s in states), "done" if set(states) == {"done"} else "todo")
    status = "running" if status == "todo" and runs else status
    return Result(
        place,
        cells[0].agent,
        cells[0].overrides,
        status,
        min([cell.done for cell in cells if cell.status == status] or [cell.done for cell in cells]),
        total,
        len({seed for cell in cells for seed in cell.seeds} | set(runs)),
        not complete,
        any(found.privileged for found in points),
        Curves(*statistics.common_steps([runs[seed] for seed in sorted(kept)])),
        Curves(*statistics.common_steps([reference[seed] for seed in sorted(reference)])),
    )


def _anchored(result: Result, others: Sequence[Result]) -> Result:
    """With the anchors of its task: same protocol and preset; the reference has trained for as many steps."""
    setting, env = result.place.setting, result.place.env
    near = [o for o in others if o.place.setting.protocol == setting.protocol and o.place.env == env and o.runs]
    random = [o for o in near if o.agent == "random"]  # it has no hyperparameters: any preset
    trained = [o for o in near if o.place.setting == setting and not o.partial and o.total == result.total]
    plain = [o for o in trained if o.agent == "sac" and o.place.delay == 0]
    inside = [o for o in trained if o.reference.steps.size]
    low = high = NO_ANCHOR
    if random:  # it does not learn, so that all its evaluations are alike
        best = min(random, key=lambda o: (len(o.overrides), _order(o.place)))
        low = Anchor(float(best.curves.returns.mean()), best.runs, "random", best.curves)
    if plain:
        best = min(plain, key=lambda o: (len(o.overrides), _order(o.place)))
        high = Anchor(float(best.curves.final.mean()), best.runs, f"{best.place.label}, no delay", best.curves)
    elif inside:
        best = min(inside, key=lambda o: (o.agent != "vdpo", o.agent != "lifting", len(o.overrides), _order(o.place)))
        name = f"the reference inside {best.place.label}, Δ={best.place.delay}"
        high = Anchor(float(best.reference.final.mean()), best.reference.returns.shape[0], name, best.reference, True)
    return replace(result, random_anchor=low, reference_anchor=high)


# Tables


def agent_order(label: str) -> tuple[int, str]:
    """The paper's columns in the paper's order, then others, the anchors last."""
    agent = label.split(" ")[0]
    known = [*PAPER_ORDER, None, "sac-memoryless", "sac", "random"]
    return known.index(agent) if agent in known else known.index(None), label


def delay_order(delay: Delay) -> tuple[bool, int, str]:
    """Constant delays by length, then the others by name."""
    return (True, 0, delay) if isinstance(delay, str) else (False, delay, "")


def _order(place: Place) -> tuple[Any, ...]:
    return place.setting, place.env, delay_order(place.delay), agent_order(place.label)


def _tables(results: Mapping[Place, Result]) -> list[Table]:
    """The paper's tables, as far as the cells reach; a paper's column is there wherever the paper has its figure."""
    tables = []
    known = {(task, delay) for _, task, delay, *_ in paper()}
    for setting in sorted({place.setting for place in results}):
        mine = [r for r in results.values() if r.place.setting == setting and not r.is_anchor]
        labels: dict[str, set[str]] = defaultdict(set)
        for result in mine:
            labels[result.agent].add(result.place.label)
        varied = {agent: names for agent, names in labels.items() if len(names) > 1}
        main = {n for agent, names in labels.items() for n in names if agent not in varied or n == agent}

        def table(kind: Any, title: str, chosen: list[Result], setting: Setting = setting) -> None:
            rows = sorted({(r.place.env, r.place.delay) for r in chosen}, key=lambda x: (x[0], delay_order(x[1])))
            columns = {r.place.label for r in chosen}
            if kind != "ablation" and any((e.removeprefix("delayrl/"), str(d)) in known for e, d in rows):
                columns |= {a for a in PAPER_ORDER if not any(c.split(" ")[0] == a for c in columns)}
            if rows:
                tables.append(Table(kind, title, setting, rows, sorted(columns, key=agent_order)))

        constant = [r for r in mine if r.place.label in main and not isinstance(r.place.delay, str)]
        table("normalised", "Normalised return, constant delays", constant)
        table("steps", "Steps to the delay-free return", constant)
        for agent, names in sorted(varied.items()):
            variants = [r for r in mine if r.place.label in names]
            compared = {(r.place.env, r.place.delay) for r in variants if r.place.label != agent}
            ablation = [r for r in variants if (r.place.env, r.place.delay) in compared]
            table("ablation", f"Ablation of {agent}", ablation)
        stochastic = [r for r in mine if r.place.label in main and isinstance(r.place.delay, str)]
        table("stochastic", "Normalised return, stochastic delays", stochastic)
    return tables


def _aggregates(results: Mapping[Place, Result]) -> list[Aggregate]:
    """IQM and performance profile of each agent over the tasks of each delay, with 95 % intervals."""
    strata: dict[tuple[Setting, Delay | None, str], list[Floats]] = defaultdict(list)
    for place, result in results.items():
        scores = result.normalise(result.curves.final)
        if result.is_anchor or result.partial or not scores.size or np.isnan(scores).any():
            continue
        for delay in (place.delay, *([] if isinstance(place.delay, str) else [None])):
            strata[place.setting, delay, place.label].append(scores)
    several = {s for s, _, _ in strata if len({d for t, d, _ in strata if t == s and isinstance(d, int)}) > 1}
    made = []
    for (setting, delay, label), of in strata.items():
        if delay is None and setting not in several:
            continue
        pooled = np.concatenate(of)
        low, high = statistics.stratified_bootstrap(of, statistics.interquartile_mean)
        profile = statistics.performance_profile(pooled, THRESHOLDS)
        band = statistics.stratified_bootstrap(of, lambda x: statistics.performance_profile(x, THRESHOLDS), 500)
        iqm = float(statistics.interquartile_mean(pooled))
        counts = len(of), pooled.size
        made.append(Aggregate(setting, delay, label, iqm, float(low), float(high), *counts, profile, *band))
    return sorted(
        made,
        key=lambda a: (
            a.setting,
            a.delay is None,
            delay_order(a.delay if a.delay is not None else 0),
            agent_order(a.label),
        ),
    )
