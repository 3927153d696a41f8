"""Rows: read from files, checked, and summed up by cell, policy, seed and step."""

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.run.condition import Condition
from delayrl.run.cost import Cost
from delayrl.run.rows import CONDITION, CONFIGURATION, Row, name_configuration, whole_evaluations
from delayrl.run.stored import condition_of

LIMIT = 2**53  # the page holds numbers as doubles, which are exact below
LARGEST = 1e150  # return; sums and squares stay finite


Key = tuple[Any, ...]
"""The columns of a condition, then the hash of its options, which is None in rows of version 0.1."""


Returns = dict[int, float]
"""The returns of one policy's evaluation at one step of a run, by episode."""


@dataclass
class RowGroup:
    """The rows that name the same cell, condition and configuration."""

    cell: str | None  # its id; None if the rows name no cell
    condition: Condition  # without overrides and steps, which rows do not name
    configuration: str | None  # the hash of its options; None if the rows name none
    privileged: bool  # whether the agent's behaviour reads the true state while it trains
    config: Mapping[str, Any] = field(default_factory=dict)  # of its runs, where it is known
    physics: set[tuple[str, str]] = field(default_factory=set)  # MuJoCo's version, and the model's fingerprint under it
    curves: dict[tuple[str, int], dict[int, Returns]] = field(
        default_factory=lambda: defaultdict(lambda: defaultdict(dict))
    )

    @property
    def key(self) -> Key:
        """What was trained, as the rows name it."""
        return *self.condition.columns.values(), self.configuration

    @property
    def cost(self) -> Cost | None:
        """What its learning costs, where that is known."""
        return Cost.from_json(self.config["cost"]) if "cost" in self.config else None

    @property
    def rows(self) -> int:
        """How many rows the group has."""
        return sum(len(returns) for curve in self.curves.values() for returns in curve.values())

    def runs(self, policy: str) -> dict[int, dict[int, float]]:
        """Return the mean return of a policy by seed and step, without evaluations that a crash cut off."""
        return {
            seed: {step: math.fsum(curve[step].values()) / len(curve[step]) for step in whole_evaluations(curve)}
            for (name, seed), curve in self.curves.items()
            if name == policy
        }


def group_rows(rows: Iterable[Mapping[str, Any]]) -> list[RowGroup]:
    """Check rows and sum them up, in one pass. Raises DelayRLError if one lacks a column, is damaged or there twice."""
    groups: dict[tuple[Any, ...], RowGroup] = {}
    columns = itemgetter(*CONDITION, "seed", "step", "policy", "episode", "return")
    for number, row in enumerate(rows, 1):
        try:
            *condition, seed, step, policy, episode, value = columns(row)
            key = (row.get("cell"), row.get(CONFIGURATION), *condition)
            if not (type(seed) is type(step) is type(episode) is int and 0 <= step < LIMIT and episode >= 0):
                raise TypeError
            if not abs(value) < LARGEST:
                raise ValueError
            if key not in groups:
                groups[key] = _group(row)
            returns = groups[key].curves[policy, seed][step]
        except KeyError as error:
            raise DelayRLError(f"row {number} of the results has no column {error}") from None
        except (TypeError, ValueError, OverflowError, AttributeError, DelayRLError):
            raise DelayRLError(f"row {number} of the results is damaged: {str(row)[:200]}") from None
        if episode in returns:
            place = f"{groups[key].condition}, seed {seed}, step {step}, episode {episode}"
            raise DelayRLError(f"row {number} of the results is there twice: {place}; give every file of rows once")
        if row.get("physics") is not None:
            groups[key].physics.add((str(row.get("mujoco")), str(row["physics"])))
        returns[episode] = value
    return list(groups.values())


def _group(row: Mapping[str, Any]) -> RowGroup:
    condition = condition_of({name: row[name] for name in CONDITION} | {"overrides": {}, "steps": 0})
    if isinstance(condition.delay, bool) or (isinstance(condition.delay, int) and abs(condition.delay) >= 2**31):
        raise ValueError
    cell, configuration = (None if row.get(name) is None else str(row[name]) for name in ("cell", CONFIGURATION))
    return RowGroup(cell, condition, configuration, row.get("privileged") is True)


def whole_lines(file: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield lines with their numbers, without a last one that a crash cut, or that is being written."""
    for number, line in enumerate(file, 1):
        if number > 1 and not line.endswith(b"\n"):
            try:
                json.loads(line)
            except ValueError:
                return
            except RecursionError:  # no program of ours wrote that; who reads it refuses it
                pass
        yield number, line


def read_rows(paths: Iterable[Path]) -> Iterator[Row]:
    """Yield the rows of rows.jsonl files, and of files that `benchmarks/collect.py` wrote.

    Raises DelayRLError if a file cannot be read, or a line is not a row.
    """
    for path in paths:
        configs: dict[Any, Row] = {}
        runs: dict[Any, list[Row]] = defaultdict(list)
        try:
            with open(path, "rb") as file:
                for number, line in whole_lines(file):
                    try:
                        row = json.loads(line)
                        if not isinstance(row, dict):
                            raise TypeError
                        if "config" in row:
                            names = [*CONDITION, "privileged", "seed", *({CONFIGURATION} & row["config"].keys())]
                            configs[row["run"]] = {name: row["config"][name] for name in names}
                        elif "step" in row:
                            runs[row.get("run")].append(configs.get(row.get("run"), {}) | row)
                        elif "run" not in row:  # of a run in such a file there may be more
                            raise KeyError
                    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
                        raise DelayRLError(f"{path}, line {number}: this is no row of results") from None
        except OSError as error:
            raise DelayRLError(f"{path} cannot be read: {error.strerror}") from error
        for rows in runs.values():
            yield from name_configuration(rows)
