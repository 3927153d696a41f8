"""Files of rows in blocks: a line with versions and settings, then the rows that were measured with them."""

import json
from pathlib import Path
from typing import Any

Row = dict[str, Any]
Block = tuple[Row, list[Row]]


def read(path: Path) -> list[Block]:
    """Return the blocks of a file, none if it is not there."""
    blocks: list[Block] = []
    for line in path.read_text().splitlines() if path.exists() else ():
        row = json.loads(line)
        if "versions" in row:
            blocks.append((row, []))
        else:
            blocks[-1][1].append(row)
    return blocks


def replace(path: Path, about: Row, rows: list[Row], names: tuple[str, ...]) -> None:
    """Add a block, and drop all rows that measured the same before: those with the same values under `names`."""
    measured = {tuple(row[name] for name in names) for row in rows}
    kept = [
        (head, [row for row in own if tuple(row[name] for name in names) not in measured]) for head, own in read(path)
    ]
    lines = [line for head, own in [*kept, (about, rows)] if own for line in (head, *own)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
