"""Rows of a grid, from its run folders or from the table that is published.

The table is one SQLite file. Python reads and writes it without another library, most other software reads it too, and
it keeps doubles and integers exactly. Columns that are constant within a run are stored once. The same rows give the
same bytes, so a committed table changes only where results do.
"""

import contextlib
import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args
from urllib.parse import quote

from delayrl.bench import folders
from delayrl.bench.grid import Grid
from delayrl.bench.status import is_damaged, progress
from delayrl.errors import DelayRLError, count
from delayrl.run.cell import Cell, CellState, Progress
from delayrl.run.cost import Cost
from delayrl.run.disk import draft, lock
from delayrl.run.folder import RunFolder, check_more, versions_in
from delayrl.run.rows import CONDITION, EPISODE, Row, check_row, name_configuration

SCHEMA = 1
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
    """Yield the rows of cells, each with its cell's id, from run folders. Raises DelayRLError for a damaged row."""
    for cell in cells:
        for path in folders.seed_paths(runs / cell.folder, cell.seeds):
            for row in _own_rows(cell, path):
                yield row | {"cell": cell.id}


def _own_rows(cell: Cell, path: Path) -> list[Row]:
    """Return the rows of a cell's run. Raises DelayRLError if it was trained further than the cell, or is damaged."""
    run = RunFolder(path)
    with folders.advised(path.parent):
        rows = name_configuration(run.read("rows"))
        if rows:
            folders.check_length(run, cell)
    return rows


class Held(NamedTuple):
    """What some place holds of a cell. The greatest is taken; run folders yield to more rows or an end alone.

    Their step may fall: a running cell's is ahead of the checkpoint from which it goes on once it has died.
    """

    rows: int = 0
    done: bool = False
    step: int = 0


def collect(grid: Grid, runs: Path, out: Path, others: Sequence[Path] = ()) -> int:
    """Write the rows and the standing of a grid into a table.

    Each cell is taken from where most of it is: its run folders, the table that is there already, or another one, of
    this grid from another machine or of a grid that shares the cell.

    Args:
        grid: the grid.
        runs: the folder of its cells.
        out: the table. It keeps cells whose run folders are gone.
        others: more tables.

    Returns:
        The number of rows.

    Raises:
        DelayRLError: no rows yet, a damaged run or table, a row that is there twice, a table without a cell of the
            grid, `out` is being written, is the table of another grid, or has rows of cells that the grid has no more.
    """
    if not others and not out.exists() and next(rows_of(grid.cells, runs), None) is None:
        made = f"`delayrl bench run {grid.name if grid.is_shipped else grid.source} --runs {runs}` makes them"
        raise DelayRLError(f"{grid.name} has no rows below {runs} yet; {made}")
    if out.is_dir():
        raise DelayRLError(f"{out} is a folder; give a file, such as {out / grid.name}.sqlite")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with lock(out.parent) as free:
            if not free:
                raise DelayRLError(f"another program is collecting into {out.parent}; try again when it has ended")
            elsewhere = _held_elsewhere(grid, out, others)
            with draft(out, shared=True) as file, contextlib.closing(sqlite3.connect(file)) as table:
                return _fill(table, grid, runs, elsewhere)
    except (OSError, sqlite3.OperationalError) as error:
        raise DelayRLError(f"cannot write {out}: {error}") from error


def _held_elsewhere(grid: Grid, out: Path, others: Sequence[Path]) -> dict[str, tuple[Held, Path]]:
    """Return which of the tables, the one that is there already and others, holds most of each cell of the grid."""
    ids, most = set(grid.ids), dict[str, tuple[Held, Path]]()
    for file in (*([out] if out.exists() else []), *others):
        with _open(file) as table:
            name = table.execute("SELECT value FROM meta WHERE key = 'grid'").fetchone()[0]
            cells = table.execute(
                "SELECT cells.id, COUNT(rows.run), cells.state = 'done', cells.step FROM cells "
                "LEFT JOIN runs ON runs.cell = cells.id LEFT JOIN rows ON rows.run = runs.id GROUP BY cells.id"
            )
            known = {id: Held(rows, bool(done), int(step)) for id, rows, done, step in cells}
        if file == out and name != grid.name:
            raise DelayRLError(f"{out} is the table of the grid {name!r}; give another --out")
        gone = sorted(id for id, of in known.items() if of.rows and id not in ids)
        if file == out and gone:
            words = f"{out} has rows of {count(len(gone), 'cell')} that {grid.name} has no more ({', '.join(gone[:3])}"
            words += ", …)" if gone[3:] else ")"
            kept = f", and --also {out} for the cells that it still has" if ids & known.keys() else ""
            raise DelayRLError(f"{words}; give another --out{kept}")
        if not ids & known.keys():
            whose = "an earlier version of it" if name == grid.name else f"{name!r}"
            raise DelayRLError(f"{file} has no cell of {grid.name}: it is the table of {whose}")
        for id in ids & known.keys():
            if id not in most or known[id] > most[id][0]:
                most[id] = known[id], file
    return most


def _fill(table: sqlite3.Connection, grid: Grid, runs: Path, elsewhere: Mapping[str, tuple[Held, Path]]) -> int:
    """Write the tables. `elsewhere` says which other table holds most of each cell. Returns the number of rows."""
    table.executescript("PRAGMA page_size = 4096; PRAGMA journal_mode = OFF;" + TABLES)
    meta = {"schema": str(SCHEMA), "grid": grid.name, "description": grid.description}
    table.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
    total = 0
    for number, cell in enumerate(grid.cells):
        p = progress(cell, runs)  # before the rows, which may be more
        paths = zip(folders.seed_paths(runs / cell.folder, cell.seeds), cell.seeds, strict=True)
        found = [(path, seed, _own_rows(cell, path)) for path, seed in paths]
        here = Held(sum(len(rows) for *_, rows in found), p.state == "done", p.step)
        there, file = elsewhere.get(cell.id, (Held(), None))
        begun = (runs / cell.folder).is_dir()
        if file and (there[:2] > here[:2] or (there > here and not begun)):
            total += _copy_cell(table, file, cell, number)
            continue
        if is_damaged(cell, runs, p):
            raise DelayRLError(p.line)
        _insert_cell(table, cell, number, p)
        total += sum(_insert_run(table, cell, path, seed, rows) for path, seed, rows in found if rows)
    table.commit()
    table.execute("VACUUM")
    return total


def cells_done(file: Path) -> int:
    """Return how many cells of a table are done."""
    with _open(file) as table:
        return int(table.execute("SELECT COUNT(*) FROM cells WHERE state = 'done'").fetchone()[0])


def _insert_cell(table: sqlite3.Connection, cell: Cell, number: int, p: Progress) -> None:
    values = (cell.id, number, _json(cell.json), p.state, p.step, p.speed)
    table.execute("INSERT INTO cells VALUES (?, ?, ?, ?, ?, ?)", values)


def _copy_cell(table: sqlite3.Connection, file: Path, cell: Cell, number: int) -> int:
    """Copy a cell with its runs and rows out of another table. Returns the number of rows."""
    with _open(file) as other:
        held = _read(other, cell.id)  # what cannot be read must not replace what can
        for config in held.configs:
            if "cost" in config:
                Cost.from_json(config["cost"])
        for row in held.rows:
            check_row(row, f"cell {cell.id}")
            if not all(isinstance(row.get(name), kind) for name, kind in CONDITION.items()):
                raise ValueError(f"rows of cell {cell.id} do not name their condition")
        query = "SELECT id, cell, seed, shared, config, versions FROM runs WHERE cell = ? ORDER BY id"
        runs = other.execute(query, (cell.id,)).fetchall()
        query = f"SELECT {', '.join(EPISODE)}, more FROM rows WHERE run = ?"
        rows = [other.execute(query, (run,)).fetchall() for run, *_ in runs]
    _insert_cell(table, cell, number, held.standing[0][1])
    for (_, *described), own in zip(runs, rows, strict=True):
        run = table.execute("INSERT INTO runs VALUES (NULL, ?, ?, ?, ?, ?)", described).lastrowid
        table.executemany("INSERT INTO rows VALUES (?, ?, ?, ?, ?, ?, ?, ?)", [(run, *row) for row in own])
    return sum(map(len, rows))


def _insert_run(table: sqlite3.Connection, cell: Cell, path: Path, seed: int, rows: list[Row]) -> int:
    """Insert a run and its rows. Returns their number."""
    config = RunFolder(path).config
    versions = versions_in(config)
    config = {name: value for name, value in config.items() if name not in ("versions", "later_versions")}
    shared = {k: v for k, v in rows[0].items() if k not in EPISODE and all(row.get(k) == v for row in rows)}
    described = (cell.id, seed, _json(shared), _json(config), _json(versions))
    run = table.execute("INSERT INTO runs VALUES (NULL, ?, ?, ?, ?, ?)", described).lastrowid
    for row in rows:
        more = {k: v for k, v in row.items() if k not in EPISODE and k not in shared}
        values = (run, *(row[name] for name in EPISODE), _json(more) if more else None)
        table.execute("INSERT INTO rows VALUES (?, ?, ?, ?, ?, ?, ?, ?)", values)
    return len(rows)


class Collected(NamedTuple):
    """What a table holds."""

    rows: list[Row]  # as `rows_of` yields them
    standing: list[tuple[Cell, Progress]]  # its cells, and how far each was
    configs: list[dict[str, Any]]  # the configuration of each run, with its cell's id
    description: str  # of the grid


def configs_of(cells: Sequence[Cell], runs: Path) -> list[dict[str, Any]]:
    """Return the configurations of the runs that have begun, each with its cell's id."""
    configs = []
    for cell in cells:
        begun = filter(lambda run: run.exists, map(RunFolder, folders.seed_paths(runs / cell.folder, cell.seeds)))
        with folders.advised(runs / cell.folder):
            configs += [run.config | {"cell": cell.id} for run in begun]
    return configs


def read_table(file: str | Path) -> Collected:
    """Return the rows, the cells with their progress, the configurations and the description of a collected table.

    Raises DelayRLError if it is none of ours, damaged, or has another schema version.
    """
    with _open(Path(file)) as table:
        return _read(table)


def _read(table: sqlite3.Connection, id: str | None = None) -> Collected:
    """Read a table, or one of its cells. Raises ValueError or TypeError if a text or number is of another type."""
    only, given = ("", ()) if id is None else ("WHERE {} = ?", (id,))
    query = f"SELECT id, cell, state, step, steps_per_second FROM cells {only.format('id')} ORDER BY number"
    cells = [_stored_cell(*values) for values in table.execute(query, given)]
    query = f"SELECT id, cell, shared, config, versions FROM runs {only.format('cell')} ORDER BY id"
    runs = table.execute(query, given).fetchall()
    shared = {run: _loaded(text, dict) | {"cell": cell} for run, cell, text, *_ in runs}
    query = f"SELECT run, more, {', '.join(EPISODE)} FROM rows"
    if id is not None:
        query += " WHERE run IN (SELECT id FROM runs WHERE cell = ?)"
    rows = [
        shared[run] | dict(zip(EPISODE, values, strict=True)) | _loaded(more or "{}", dict)
        for run, more, *values in table.execute(query, given)
    ]
    configs = []
    for _, cell, _, text, used in runs:
        first, *later = _loaded(used, list) or [{}]
        made = {"versions": first, "later_versions": later} if later else {"versions": first}
        configs.append(_loaded(text, dict) | made | {"cell": cell})
        check_more(configs[-1], "a configuration")
    description = table.execute("SELECT value FROM meta WHERE key = 'description'").fetchone() or [""]
    return Collected(rows, cells, configs, str(description[0]))


def _loaded(text: str, kind: type) -> Any:
    value = json.loads(text)
    if not isinstance(value, kind):
        raise ValueError(f"it holds {text[:60]!r} in the place of a {kind.__name__}")
    return value


def _stored_cell(id: str, text: str, state: CellState, step: int, speed: float | None) -> tuple[Cell, Progress]:
    if state not in get_args(CellState) or type(step) is not int or not isinstance(speed, float | None):
        raise ValueError(f"cell {id} has an invalid state, step or speed")
    return Cell.from_json(_loaded(text, dict), id), Progress(state, step, speed)


@contextlib.contextmanager
def _open(file: Path) -> Iterator[sqlite3.Connection]:
    """Open a table to read it. Errors in the block that come from a damaged table become one DelayRLError."""
    if not file.is_file():
        raise DelayRLError(f"there is no table {file}; `delayrl bench collect GRID` makes one")
    try:
        with contextlib.closing(sqlite3.connect(f"file:{quote(str(file.resolve()))}?mode=ro", uri=True)) as table:
            version = table.execute("SELECT value FROM meta WHERE key = 'schema'").fetchone()
            if version == (str(SCHEMA),):
                yield table
                return
    except (sqlite3.Error, ValueError, KeyError, TypeError, OverflowError, RecursionError, DelayRLError) as error:
        raise DelayRLError(f"{file} is no table of results, or damaged: {error}") from error
    other = version[0] if version else "none"
    raise DelayRLError(f"{file} has schema version {other}, this program reads {SCHEMA}: collect into another file")


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
