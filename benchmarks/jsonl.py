"""Files of rows, one JSON object a line.

Some are in blocks: a line with versions and settings, then the rows that were measured with them.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

Row = dict[str, Any]
Block = tuple[Row, list[Row]]


def read(path: Path) -> list[Row]:
    """Return the rows of a file."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def write(path: Path, rows: Iterable[Row]) -> None:
    """Write rows in place of what a file held."""
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def blocks(path: Path) -> list[Block]:
    """Return the blocks of a file, none if it is not there."""
    found: list[Block] = []
    for row in read(path) if path.exists() else ():
        if "versions" in row:
            found.append((row, []))
        else:
            found[-1][1].append(row)
    return found


def replace(path: Path, about: Row, rows: list[Row], names: tuple[str, ...]) -> None:
    """Add a block, and drop all rows that measured the same before: those with the same values under `names`."""
    measured = {tuple(row[name] for name in names) for row in rows}
    kept = [
        (head, [row for row in own if tuple(row[name] for name in names) not in measured]) for head, own in blocks(path)
    ]
    write(path, (line for head, own in [*kept, (about, rows)] if own for line in (head, *own)))
