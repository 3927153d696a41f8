"""A cell: the seeds of one condition that are trained together; and how far it is."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, Self

from delayrl.errors import DelayRLError
from delayrl.run.condition import Condition
from delayrl.run.stored import condition_of

CellState = Literal["todo", "begun", "running", "done", "failed"]
"""`begun`: something is stored, and nobody works on it."""


@dataclass(frozen=True)
class Cell:
    """One lockstep group of seeds of one condition. `id` is the hash of all of it."""

    condition: Condition
    seeds: tuple[int, ...]
    id: str

    @property
    def folder(self) -> str:
        """The name of its folder: readable, and unique."""
        condition = self.condition
        return re.sub(r"[^\w.-]+", "-", f"{condition.folder_name}-{condition.agent}-{self.id}")

    @property
    def json(self) -> dict[str, Any]:
        """What cell.json and the table of results store of it, without its id."""
        return asdict(self.condition) | {"seeds": list(self.seeds)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any], id: str) -> Self:
        """Make a cell of stored values. Raises DelayRLError if one is missing or of another type."""
        seeds = values.get("seeds")
        if not isinstance(seeds, list) or not seeds or any(type(seed) is not int for seed in seeds):
            raise DelayRLError("no good seeds")
        return cls(condition_of(values), tuple(seeds), id)

    def __str__(self) -> str:
        first, last = self.seeds[0], self.seeds[-1]
        seeds = f"seed {first}" if first == last else f"seeds {first}-{last}"
        return f"{self.condition}, {seeds}"


class Progress(NamedTuple):
    """How far a cell is.

    Attributes:
        state: in one word.
        step: environment steps that each seed has stored, or is known to have taken.
        speed: steps per second, where it is known.
        line: the first line of a failure; who works on a running cell.
    """

    state: CellState
    step: int
    speed: float | None = None
    line: str = ""


Standing = Sequence[tuple[Cell, Progress]]
"""Cells, and how far each is."""
