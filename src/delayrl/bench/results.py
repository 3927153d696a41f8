"""Rows of a grid, from its run folders or from the table that is published.

The table is one SQLite file: Python reads and writes it without another library, so does most other software, it is
queried where it lies, and it keeps doubles and whole numbers exactly. What holds for a run stands once. The same
rows give the same bytes, so that a committed table changes only where results do.
"""

import contextlib
import json
import math
import os
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from delayrl.bench import folders
from delayrl.bench.folders import Progress, State
from delayrl.bench.grid import Cell, Grid
from delayrl.bench.status import progress
from delayrl.errors import DelayRLError
from delayrl.run.folder import Run

SCHEMA = 1
Row = dict[str, Any]
OWN = {"step": int, "policy": str, "episode": int, "reset_seed": int, "return": float, "length": int}
"""What differs between the rows of a run, and of which type it is; the rest stands once for each run."""
CELL: dict[str, Any] = {
    "agent": str,
    "env": str,
    "delay": int | str,
    "preset": str,
    "protocol": str,
    "seeds": list,
    "overrides": dict,
    "steps": int,
}
TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE cells (id TEXT PRIMARY KEY, number INTEGER, cell TEXT, state TEXT, step INTEGER, steps_per_second REAL);
CREATE TABLE runs (id INTEGER PRIMARY KEY, cell TEXT NOT NULL REFERENCES cells, seed INTEGER NOT NULL,
                   shared TEXT NOT NULL, config TEXT NOT NULL, versions TEXT NOT NULL);
CREATE TABLE rows (run INTEGER NOT NULL REFERENCES runs, step INTEGER, policy TEXT, episode INTEGER,
                   reset_seed INTEGER, return REAL, length INTEGER, more TEXT,
                   PRIMARY KEY (run, step, policy, episode)) WITHOUT ROWID;
CREATE VIEW results AS
    SELECT cell, json_extract(shared, '$.agent') AS agent, json_extract(shared, '$.env') AS env,
           json_extract(shared, '$.delay') AS delay, seed, step, policy, episode, reset_seed, return, length
    FROM rows JOIN runs ON rows.run = runs.id;
"""


def rows_of(cells: Sequence[Cell], runs: Path) -> Iterator[Row]:
    """Rows of the cells as the run folders hold them now, each with its cell's id."""
    for cell in cells:
        for path in folders.seed_folders(runs / cell.folder, cell.seeds):
            for row in _read(path):
                yield row | {"cell": cell.id}


def _read(path: Path) -> list[Row]:
    rows = Run(path).read("rows")
    for row in rows:
        whole = isinstance(row, dict) and all(type(row.get(name)) is kind for name, kind in OWN.items())
        if not whole or not math.isfinite(row["return"]):
            raise DelayRLError(f"{path} holds a damaged row: {str(row)[:200]}")
    return rows


def collect(grid: Grid, runs: Path, out: Path) -> int:
    """Write what a grid has now into a table; returns the number of rows.

    Raises:
        DelayRLError: no rows yet, a damaged run, a row that is there twice, `out` is the table of another grid.
    """
    if out.exists():
        with _reading(out) as table:
            name = table.execute("SELECT value FROM meta WHERE key = 'grid'").fetchone()[0]
        if name != grid.name:
            raise DelayRLError(f"{out} is the table of the grid {name!r}; give another --out")
    if next(rows_of(grid.cells, runs), None) is None:
        raise DelayRLError(f"{grid.name} has no rows below {runs} yet; `delayrl bench run {grid.name}` makes them")
    draft = out.with_name(f".{out.name}-{os.getpid()}.draft")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        draft.unlink(missing_ok=True)
        with contextlib.closing(sqlite3.connect(draft)) as table:
            count = _fill(table, grid, runs)
        draft.replace(out)
    except (OSError, sqlite3.OperationalError) as error:
        raise DelayRLError(f"cannot write {out}: {error}") from error
    finally:
        draft.unlink(missing_ok=True)
    return count


def _fill(table: sqlite3.Connection, grid: Grid, runs: Path) -> int:
    count = 0
    table.executescript("PRAGMA page_size = 4096; PRAGMA journal_mode = OFF;" + TABLES)
    meta = {"schema": str(SCHEMA), "grid": grid.name, "description": grid.description}
    table.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
    for number, cell in enumerate(grid.cells):
        p = progress(cell, runs)
        text = _json({key: value for key, value in vars(cell).items() if key != "id"})
        table.execute("INSERT INTO cells VALUES (?, ?, ?, ?, ?, ?)", (cell.id, number, text, p.state, p.step, p.speed))
        used = _versions(runs / cell.folder)
        for path, seed in zip(folders.seed_folders(runs / cell.folder, cell.seeds), cell.seeds, strict=True):
            rows = _read(path)
            if not rows:
                continue
            config = dict(Run(path).config)
            first = config.pop("versions", None)
            distinct = _distinct(([first] if first else []) + used)
            shared = {k: v for k, v in rows[0].items() if k not in OWN and all(row.get(k) == v for row in rows)}
            values = (cell.id, seed, _json(shared), _json(config), _json(distinct))
            run = table.execute("INSERT INTO runs VALUES (NULL, ?, ?, ?, ?, ?)", values).lastrowid
            for row in rows:
                more = {k: v for k, v in row.items() if k not in OWN and k not in shared}
                line = (run, *(row[name] for name in OWN), _json(more) if more else None)
                try:
                    table.execute("INSERT INTO rows VALUES (?, ?, ?, ?, ?, ?, ?, ?)", line)
                except sqlite3.IntegrityError as error:
                    raise DelayRLError(f"{path} holds an episode twice: step {row['step']}, {row['policy']}") from error
                count += 1
    table.commit()
    table.execute("VACUUM")
    return count


def versions_of(cells: Sequence[Cell], runs: Path) -> list[dict[str, Any]]:
    """With what the cells were worked on: versions of libraries, commit, hardware; each once."""
    paths = [path for cell in cells for path in folders.seed_folders(runs / cell.folder, cell.seeds)]
    first = [Run(path).config.get("versions") for path in paths if (path / "config.json").exists()]
    return _distinct([v for v in first if v] + [v for cell in cells for v in _versions(runs / cell.folder)])


def _distinct(values: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [value for i, value in enumerate(values) if value not in values[:i]]


def _versions(folder: Path) -> list[dict[str, Any]]:
    """With what a cell was worked on: more than one where it went on elsewhere, or after an update."""
    return [event["versions"] for event in folders.journal(folder) if "versions" in event]


def read_table(file: Path) -> tuple[list[Row], list[tuple[Cell, Progress]], list[dict[str, Any]]]:
    """Rows of a collected table, its cells with how far they were, and with what they were worked on.

    Raises:
        DelayRLError: no table of ours, or of another schema version.
    """
    with _reading(file) as table:
        cells = []
        columns = "id, cell, state, step, steps_per_second"
        for key, text, state, step, speed in table.execute(f"SELECT {columns} FROM cells ORDER BY number"):
            values = json.loads(text)
            wrong = [name for name, kind in CELL.items() if not isinstance(values[name], kind)]
            if wrong or state not in get_args(State) or type(step) is not int:
                raise ValueError(f"cell {key} has no good {', '.join(wrong) or 'state'}")
            cell = Cell(**(values | {"seeds": tuple(values["seeds"]), "id": key}))
            cells.append((cell, Progress(state, step, speed, "")))
        shared = {
            run: json.loads(text) | {"cell": cell}
            for run, cell, text in table.execute("SELECT id, cell, shared FROM runs")
        }
        columns = ", ".join(OWN)
        rows = [
            shared[run] | dict(zip(OWN, values, strict=True)) | (json.loads(more) if more else {})
            for run, more, *values in table.execute(f"SELECT run, more, {columns} FROM rows")
        ]
        used = [dict(one) for (text,) in table.execute("SELECT versions FROM runs") for one in json.loads(text)]
    return rows, cells, _distinct(used)


@contextlib.contextmanager
def _reading(file: Path) -> Iterator[sqlite3.Connection]:
    if not file.is_file():
        raise DelayRLError(f"there is no table {file}; `delayrl bench collect GRID` makes one")
    try:
        with contextlib.closing(sqlite3.connect(f"file:{_quoted(file)}?mode=ro", uri=True)) as table:
            version = table.execute("SELECT value FROM meta WHERE key = 'schema'").fetchone()
            if version is None or version[0] != str(SCHEMA):
                have = version[0] if version else "none"
                raise DelayRLError(
                    f"{file} has schema version {have}, this program reads {SCHEMA}: collect it again with this version"
                )
            yield table
    except (sqlite3.Error, ValueError, KeyError, TypeError) as error:
        raise DelayRLError(f"{file} is no table of results, or damaged: {error}") from error


def _quoted(file: Path) -> str:
    from urllib.parse import quote

    return quote(os.fspath(file.resolve()))


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
