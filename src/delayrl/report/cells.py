"""Cells: inferred where no grid names them, their rows, and their labels."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.report.rows import RowGroup
from delayrl.run.cell import Cell, Progress

Standing = Sequence[tuple[Cell, Progress]]


def infer_cells(groups: Iterable[RowGroup]) -> Standing:
    """Make a cell of each group of rows. Its last step is taken for the step at which training ends."""
    standing = []
    for group in groups:
        runs = group.runs("agent")
        if runs:
            steps = [max(run) for run in runs.values()]
            unnamed = repr((None, *group.condition.columns.values()))
            id = unnamed if group.cell is None else group.cell
            cell = Cell(replace(group.condition, steps=max(steps)), tuple(sorted(runs)), id)
            standing.append((cell, Progress("done" if min(steps) == max(steps) else "running", min(steps))))
    return standing


def assign_groups(groups: Iterable[RowGroup], cells: Iterable[Cell]) -> tuple[dict[str, list[RowGroup]], int]:
    """Find the rows of each cell: by the id that they name, else by their condition.

    Returns:
        Groups by the cell's id, none or one each, and how many rows belong to no cell.

    Raises:
        DelayRLError: the rows of a cell are of several conditions.
    """
    groups_of: dict[str, list[RowGroup]] = {}
    ids_of: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for cell in cells:
        groups_of[cell.id] = []
        ids_of[tuple(cell.condition.columns.values())].append(cell.id)
    unplaced = 0
    for group in groups:
        ids = [group.cell] if group.cell is not None else ids_of[tuple(group.condition.columns.values())]
        if len(ids) == 1 and ids[0] in groups_of:
            groups_of[ids[0]].append(group)
        else:
            unplaced += group.rows
    for id, several in groups_of.items():
        if len(several) > 1:
            first, second = (tuple(group.condition.columns.values()) for group in several[:2])
            raise DelayRLError(f"the rows of cell {id} are of different things: {first} and {second}")
    return groups_of, unplaced


def label_cells(cells: Iterable[Cell]) -> tuple[dict[str, str], dict[str, Mapping[str, Any]]]:
    """Label each cell with its agent, and with the overrides that not all cells of the agent share.

    Returns:
        Labels by the cell's id, and the shared overrides by agent.
    """
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
