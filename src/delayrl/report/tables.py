"""Tables in the paper's layout: which rows and columns, and what stands in them."""

import csv
import math
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import product
from typing import Any, Literal, NamedTuple

from delayrl.report import statistics
from delayrl.report.results import PAPER_ORDER, Result, Setting, agent_order, delay_order
from delayrl.report.statistics import NAN

Kind = Literal["normalised", "steps", "ablation", "stochastic"]
PAPER_STEPS = 1_000_000
SAME_RUN = {"representation", "steps", "evaluate_every", "evaluation_episodes", "precision"}
"""Overrides of runs that the paper's values may stand beside."""


class PublishedValue(NamedTuple):
    """A number of the paper, and its table; `value` is NaN where the paper says the threshold was not reached."""

    table: str
    value: float
    std: float


@cache
def published_values() -> dict[tuple[str, ...], PublishedValue]:
    """Read the paper's values by (measure, task, delay, agent, representation); the last is "" outside the ablation."""
    lines = resources.files("delayrl.report").joinpath("paper.csv").read_text("utf-8").splitlines()
    columns = ("measure", "task", "delay", "agent", "representation")
    return {
        tuple(row[column] for column in columns): PublishedValue(
            row["table"], float(row["value"] or "nan"), float(row["std"] or "nan")
        )
        for row in csv.DictReader(line for line in lines if not line.startswith("#"))
    }


class TableEntry(NamedTuple):
    """What stands in a row and a column. Numbers are NaN where there are none."""

    value: float = NAN  # a normalised return, or a number of steps
    std: float = NAN
    interval: tuple[float, float] = (NAN, NAN)  # of the value, 95 %; infinite where the threshold is not reached
    area: float = NAN  # the normalised mean return over training
    area_std: float = NAN
    raw: float = NAN  # the raw return beside it
    raw_std: float = NAN
    missed: bool = False  # training has ended and the threshold was not reached
    partial: bool = False  # no seed has reached its last step
    note: str = ""  # what else must be known of the value
    published: PublishedValue | None = None


@dataclass(frozen=True)
class Table:
    """A table: rows of (env, delay), columns of labels, neither without a number, and an entry for each place.

    An ablation's rows have a variant's number.
    """

    kind: Kind
    title: str
    setting: Setting
    rows: list[tuple[str, int | str]]
    columns: list[str]
    entries: dict[tuple[str, int | str, str], TableEntry]


def make_tables(results: Collection[Result]) -> list[Table]:
    """Make the paper's tables, as far as the results reach."""
    tables = []
    for setting in sorted({r.place.setting for r in results}):
        learners = [r for r in results if r.place.setting == setting and not r.is_anchor]
        labels: dict[str, set[str]] = defaultdict(set)
        for result in learners:
            labels[result.condition.agent].add(result.place.label)
        varied = sorted(agent for agent, names in labels.items() if len(names) > 1)
        main = [r for r in learners if r.condition.agent not in varied or r.place.label == r.condition.agent]
        constant = [r for r in main if not isinstance(r.place.delay, str)]
        tables.append(_table("normalised", "Normalised return, constant delays", setting, constant))
        tables.append(_table("steps", "Steps to the delay-free return", setting, constant))
        for agent in varied:
            variants = [r for r in learners if r.condition.agent == agent]
            compared = {(r.place.env, r.place.delay) for r in variants if r.place.label != agent}
            ablation = [r for r in variants if (r.place.env, r.place.delay) in compared]
            tables.append(_table("ablation", f"Ablation of {agent}", setting, ablation))
        stochastic = [r for r in main if isinstance(r.place.delay, str)]
        tables.append(_table("stochastic", "Normalised return, other delays", setting, stochastic))
    return [table for table in tables if table.rows]


def _table(kind: Kind, title: str, setting: Setting, chosen: list[Result]) -> Table:
    """Lay out the chosen results. The paper's columns are there only if all are comparable."""
    rows = sorted({(r.place.env, r.place.delay) for r in chosen}, key=lambda row: (row[0], delay_order(row[1])))
    columns = {r.place.label for r in chosen}
    values = published_values() if all(_comparable(kind, r) for r in chosen) else {}
    in_paper = {(task, delay) for _, task, delay, *_ in values}
    if kind != "ablation" and any((env.removeprefix("delayrl/"), str(delay)) in in_paper for env, delay in rows):
        agents = {column.split(" ")[0] for column in columns}
        columns |= {agent for agent in PAPER_ORDER if agent not in agents}
    at = {(r.place.env, r.place.delay, r.place.label): r for r in chosen}
    conditions = {r.place.label: r.condition for r in chosen}
    lengths = defaultdict(set)
    for r in chosen:
        lengths[r.place.env, r.place.delay].add(r.condition.steps)
    entries = {}
    for (env, delay), label in product(rows, columns):
        result = at.get((env, delay, label))
        published = None
        if result is None or _is_whole(result):
            condition = result.condition if result else conditions.get(label)
            overrides, agent = (condition.overrides, condition.agent) if condition else ({}, label)
            if overrides.keys() <= SAME_RUN:  # the paper ran no other variants
                published = values.get(_published_key(kind, env, delay, agent, overrides))
        entries[env, delay, label] = _entry(kind, result, published, len(lengths[env, delay]) > 1)
    shown = {place for place, entry in entries.items() if entry != TableEntry()}  # all results are in another table
    plain = {label for label in columns if " " not in label} if kind == "ablation" else set()  # not worth a row there
    rows = [row for row in rows if any((*row, label) in shown for label in columns - plain)]
    columns = {label for label in columns if any((*row, label) in shown for row in rows)}
    return Table(kind, title, setting, rows, sorted(columns, key=agent_order), entries)


def _comparable(kind: Kind, result: Result) -> bool:
    """Whether a result has the paper's preset and budget. For steps to the threshold, that of the reference counts."""
    budget = (kind == "steps" and result.threshold_anchor.steps) or result.condition.steps
    return result.place.setting.preset == "paper" and budget == PAPER_STEPS


def _published_key(kind: Kind, env: str, delay: int | str, agent: str, overrides: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what `published_values` has the paper's value under."""
    representation = str(overrides.get("representation", "transformer"))
    if kind != "ablation" and representation == "transformer":
        representation = ""  # only values of the ablation name one
    measure = "steps" if kind == "steps" else "normalised"
    return measure, env.removeprefix("delayrl/"), str(delay), agent, representation


def _is_whole(result: Result) -> bool:
    """Whether the paper's value may stand beside it: no run yet, or runs to the end with options that are known."""
    return not result.runs or (result.options_known and not result.partial)


def _entry(kind: Kind, result: Result | None, published: PublishedValue | None, several_lengths: bool) -> TableEntry:
    if result is None or (result.progress.state == "todo" and not result.runs):
        return TableEntry(published=published)
    raw, raw_std = statistics.mean_std(result.curves.final)
    longer = result.longer_reference.steps if kind == "steps" else 0
    notes = [f"{result.condition.steps:,} steps"] if several_lengths or longer else []
    notes += [] if result.runs in (0, result.seeds) else [f"{result.runs} of {result.seeds} seeds"]
    area = area_std = NAN
    if kind == "steps":
        value, std, interval = result.steps_to_threshold, NAN, result.steps_interval
        if result.seeds_at_threshold:
            notes.append(f"{result.seeds_at_threshold}/{result.runs} seeds")
        if longer and result.runs and not math.isnan(result.threshold):
            notes.append(f"reference of {longer:,} steps")
    else:
        value, std = statistics.mean_std(result.final)
        interval, (area, area_std) = result.final_interval, statistics.mean_std(result.area)
    if result.unfinished:
        notes.append(result.unfinished)
    note = " · ".join(notes)
    missed = kind == "steps" and result.missed
    return TableEntry(value, std, interval, area, area_std, raw, raw_std, missed, result.partial, note, published)
