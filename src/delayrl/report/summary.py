"""All that a report shows, computed from rows and cells."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from delayrl.report.aggregates import Aggregate, make_aggregates
from delayrl.report.cells import Standing, assign_groups, infer_cells, label_cells
from delayrl.report.results import Place, Result, Setting, agent_order, make_results
from delayrl.report.rows import group_rows
from delayrl.report.tables import Table, make_tables


@dataclass(frozen=True)
class Summary:
    """Results, tables and aggregates.

    Attributes:
        results: in the order of their places.
        shared: overrides that all cells of an agent have, by agent.
        tables, aggregates: of the results.
        unplaced: how many rows belong to no cell.
    """

    results: dict[Place, Result]
    shared: dict[str, Mapping[str, Any]]
    tables: list[Table]
    aggregates: list[Aggregate]
    unplaced: int

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
        rows: as in a run's rows.jsonl, in any order, read once. Column "cell" names the cell; other columns that the
            report does not need are ignored.
        standing: the cells of a grid, run or not, and how far they are. If empty, the cells are inferred from the
            rows, and each cell's last step is taken for the step at which training ends.

    Raises:
        DelayRLError: a row lacks a column, holds a value of another type, or is there twice; the rows of a cell are
            of several conditions.
    """
    groups = group_rows(rows)
    standing = standing or infer_cells(groups)
    cells = [cell for cell, _ in standing]
    groups_of, unplaced = assign_groups(groups, cells)
    labels, shared = label_cells(cells)
    results = make_results(standing, groups_of, labels)
    return Summary(results, shared, make_tables(results), make_aggregates(results.values()), unplaced)
