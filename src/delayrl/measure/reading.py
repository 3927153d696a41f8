"""Read and check logs in CSV and Parquet files. Every error names the row or column that is wrong."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.errors import DelayRLError, first_line, one_line
from delayrl.measure.correlate import Array

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
PREFIXES = {"commands": ("command", "cmd", "action"), "observations": ("observation", "obs")}
GAP = 20  # rows that may be missing within one recording
FEWEST, MOST = 0.1, 1000  # rows in a period of control, beyond which one of the two units is doubtful
WARM_UP = 0.05  # of the log, the part that is left out at its start by default
SLOW = 2.0  # seconds between rows, beyond which the unit is doubtful


@dataclass(frozen=True)
class Log:
    """Signals of N rows; `episode` numbers the recordings.

    A row holds what was known when its command was sent: the newest observation at that time, and the command.
    """

    time: Array  # [N], seconds from the first row
    commands: Array  # [N, U]
    observations: Array  # [N, Y]
    episode: Array  # [N]
    command_names: tuple[str, ...]
    observation_names: tuple[str, ...]


def read_signals(
    table: "Table",
    time: str | None = None,
    commands: Sequence[str] | None = None,
    observations: Sequence[str] | None = None,
    episode: str | None = None,
    unit: str = "s",
) -> Log:
    """Read the time stamps, commands and observations of a log; for the arguments see `from_log`.

    CSV files need a header, and separate columns with commas, semicolons or tabs.
    """
    stamps = table.find(time, ("time", "timestamp", "t"), "time stamps", "--time", needed=True)
    both = {"commands": commands, "observations": observations}
    given = {what: [one] if isinstance(one, str) else one or () for what, one in both.items()}
    others = [name for name in table.names if name != stamps]
    named = {word.lower() for own in given.values() for word in own} & {name.lower() for name in others}
    groups = {what: _columns(others, own, PREFIXES[what], named) for what, own in given.items()}
    for what, names in groups.items():
        if not names:
            hint = f"none begins with {' or '.join(given[what] or PREFIXES[what])}; name them with --{what}. It has "
            raise DelayRLError(f"{table.path} has no column for {what}: {hint}{_few(table.names)}")
    if twice := set(groups["commands"]) & set(groups["observations"]):
        line = f"{table.path}: {_few(sorted(twice))} would be both a command and an observation"
        raise DelayRLError(f"{line}; use --commands")
    seconds, episodes = table.column(stamps) * UNITS[unit], table.recordings(episode)
    _check_times(table.path, stamps, seconds, episodes)
    us, u_names = table.join(groups["commands"])
    ys, y_names = table.join(groups["observations"])
    return Log(seconds - seconds[0], us, ys, episodes, u_names, y_names)


def _columns(names: list[str], given: Sequence[str], usual: Sequence[str], whole: set[str]) -> list[str]:
    """Return the columns that are named as `given`, or begin so; a `whole` name is no beginning of other columns."""
    words = {word.lower() for word in given or usual}
    own = {word.lower() for word in given} & whole
    beginnings = tuple(words - own)
    return [n for n in names if n.lower() in own or (n.lower() not in whole and n.lower().startswith(beginnings))]


def read_stamps(
    table: "Table", stamp: str | None, received: str | None, episode: str | None, unit: str
) -> tuple[Array, Array, Array] | None:
    """Return when observations were made, when they arrived, in seconds, and which recordings they are in, [N] each.

    None without both columns of times.
    """
    made = table.find(stamp, ("stamp",), "send times", "--stamp")
    arrived = table.find(received, ("received",), "arrival times", "--received")
    if not made or not arrived:
        if stamp or received:
            other = "--received, when observations arrived" if made else "--stamp, when observations were made"
            raise DelayRLError(f"{table.path}: stamps need both times; it has no column for {other}")
        return None
    return table.column(made) * UNITS[unit], table.column(arrived) * UNITS[unit], table.recordings(episode)


def doubt(row: float, period: float, unit: str | None, method: str) -> str:
    """Return why the unit of time stamps, or that of the period, is in doubt, if it is; else an empty text.

    Rows lie so many seconds apart that nobody gave a unit for them, or far too many or few for a period of control. By
    stamps a row is an observation, and a sensor may be slow.
    """
    if unit is None and row > SLOW:
        likely = next((name for name in ("ms", "us") if row * UNITS[name] <= SLOW), "ns")
        return f"its rows lie {row:.3g} s apart: if its time stamps are not in seconds, say so (--unit {likely})"
    if (method == "correlation" and period < FEWEST * row) or period > MOST * row:
        return f"its rows lie {row:.3g} s apart, and the period is {period:.3g} s: check --unit, and that of --period"
    return ""


def resample(log: Log) -> tuple[Log, float]:
    """Put a log on a uniform grid.

    Each grid point takes the newest row before it. Interpolation would use values before they were there. Rows that are
    nearly uniform stay as they are.

    Returns:
        The new log, and the spacing of its rows in seconds: the median of the old one.
    """
    gaps = np.diff(log.time)
    inside = log.episode[1:] == log.episode[:-1]
    step = float(np.median(gaps[inside]))
    breaks = ~inside | (gaps > GAP * step)
    pieces = np.concatenate([[0], np.cumsum(breaks)])
    if (np.abs(gaps[~breaks] / step - 1) < 0.1).all():
        taken = np.arange(len(log.time))
    else:
        rows = []
        for own in np.split(np.arange(len(log.time)), np.flatnonzero(breaks) + 1):
            grid = np.arange(log.time[own[0]] + step / 2, log.time[own[-1]] + step, step)
            rows.append(own[np.searchsorted(log.time[own], grid, "right") - 1])
        taken = np.concatenate(rows)
    time, episode = np.arange(len(taken), dtype=float) * step, pieces[taken].astype(float)
    observations = log.observations[taken]
    return replace(log, time=time, commands=log.commands[taken], observations=observations, episode=episode), step


class Table:
    """The columns of a file, as text or numbers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise DelayRLError(f"{path}: no such file")
        with path.open("rb") as file:
            head = file.read(4)
        if not head:
            raise DelayRLError(f"{path} is empty")
        self._columns: dict[str, Any] = _parquet(path) if head == b"PAR1" else _csv(path)
        self.names = list(self._columns)
        if not self.names or not len(self._columns[self.names[0]]):
            raise DelayRLError(f"{path} has no rows")

    def find(self, given: str | None, usual: tuple[str, ...], what: str, option: str, needed: bool = False) -> str:
        """Return the name of a column: the given one or else a usual one, or "" if there is none and none is needed."""
        wanted = (given,) if given else usual
        for name in wanted:
            if alike := [known for known in self.names if known.lower() == name.lower()]:
                return name if name in alike else alike[0]
        if needed or given is not None:
            hint = f"name it with {option}. It has {_few(self.names)}"
            raise DelayRLError(f"{self.path}: no column {' or '.join(map(str, wanted))} for the {what}; {hint}")
        return ""

    def column(self, name: str) -> Array:
        """Return a column of numbers, [N]."""
        values = self.matrix(name)
        if values.shape[1] != 1:
            raise DelayRLError(f"{self.path}: column {name} holds vectors; it must hold one number a row")
        return values[:, 0]

    def recordings(self, given: str | None) -> Array:
        """Return the column that changes where a new recording begins, [N]; zeros if there is none."""
        name = self.find(given, ("episode", "episode_index"), "episodes", "--episode")
        numbers = self.column(name) if name else np.zeros(len(self._columns[self.names[0]]))
        if len(numbers) > 1 and np.diff(numbers).all():
            raise DelayRLError(f"{self.path}: column {name} changes in every row, and not only between recordings")
        return numbers

    def matrix(self, name: str) -> Array:
        """Return a column of numbers as [N, 1], or one of vectors as [N, size]."""
        cells = self._columns[name]
        try:
            values = np.array(cells, float)
        except (TypeError, ValueError):
            sizes = [np.size(cell) for cell in cells]
            if row := next((i for i, size in enumerate(sizes) if size != sizes[0]), 0):
                counts = f"{sizes[row]} numbers, in the row before {sizes[row - 1]}"
                raise DelayRLError(f"{self.path}, row {row + 1}: column {name} has {counts}; drop such rows") from None
            row = next((i for i, cell in enumerate(cells) if not _number(cell)), 0)
            shown = "an empty cell" if cells[row] in ("", None) else f"{cells[row]!r}, which is not a number"
            where = f"{self.path}, row {row + 1}"
            raise DelayRLError(f"{where}: column {name} has {shown}; {_instead(cells[row])}") from None
        values = values.reshape(len(values), -1)
        invalid = ~np.isfinite(values).all(1)
        if invalid.any():
            row = int(np.argmax(invalid))
            where = f"{self.path}, row {row + 1}"
            raise DelayRLError(f"{where}: column {name} has {cells[row]}; drop such rows or fill them")
        return values

    def join(self, names: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
        """Return several columns side by side, and a label for each number in a row."""
        blocks = {name: self.matrix(name) for name in names}
        labels: list[str] = []
        for name, block in blocks.items():
            labels += [name] if block.shape[1] == 1 else [f"{name}[{i}]" for i in range(block.shape[1])]
        return np.concatenate(list(blocks.values()), 1), tuple(labels)


def _csv(path: Path) -> dict[str, list[str]]:
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise DelayRLError(f"{path} is neither CSV text nor a Parquet file") from None
    header = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=header.count)
    try:
        rows = [row for row in csv.reader(text.splitlines(), delimiter=delimiter) if row]
    except csv.Error as error:
        raise DelayRLError(f"{path} is neither CSV text nor a Parquet file: {error}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    if len(names) < 2 or all(map(_number, names)):
        form = "a CSV file begins with the names of its columns, separated by commas, semicolons or tabs"
        raise DelayRLError(f"{path} has no header of column names in its first line ({header!r:.60}): {form}")
    if len(set(names)) < len(names):
        twice = sorted(name for name in names if names.count(name) > 1)
        raise DelayRLError(f"{path} has two columns of the same name: {_few(twice)}")
    for i, row in enumerate(rows[1:]):
        if len(row) != len(names):
            raise DelayRLError(f"{path}, row {i + 1}: {len(row)} cells under {len(names)} column names")
    return {name: list(cells) for name, cells in zip(names, zip(*rows[1:], strict=True), strict=len(rows) > 1)}


def _parquet(path: Path) -> dict[str, Any]:
    with one_line(f"{path} is a Parquet file, which cannot be read here"):
        import pyarrow
        from pyarrow import parquet
    try:
        table = parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise DelayRLError(f"{path} is a damaged Parquet file: {first_line(error)}") from None
    return {name: table.column(name).to_pylist() for name in table.column_names}


def _check_times(path: Path, name: str, seconds: Array, episodes: Array) -> None:
    if len(seconds) < 2:
        raise DelayRLError(f"{path} has one row: too short for a delay")
    gaps = np.where(episodes[1:] == episodes[:-1], np.diff(seconds), 1.0)
    if (gaps <= 0).any():
        row = int(np.argmax(gaps <= 0)) + 1
        what = "repeats" if gaps[row - 1] == 0 else "goes back"
        hint = "drop duplicates, or name a column with --episode that changes where a new recording begins"
        raise DelayRLError(f"{path}, row {row + 1}: {name} {what}; time stamps must increase. Sort the rows, {hint}")


def _number(cell: Any) -> bool:
    try:
        return cell is not None and math.isfinite(float(cell))
    except (TypeError, ValueError):
        return False


def _instead(cell: Any) -> str:
    """Write what to do about a cell that is no number: a decimal comma, a date, or one that is missing."""
    text = str(cell)
    if _number(text.replace(",", ".", 1)):
        return "write numbers with decimal points"
    if ":" in text or text.count("-") > 1:
        return "write times as numbers, such as seconds from the first row"
    return "drop such rows or fill them"


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
