"""Logs from CSV and Parquet files, checked: every way in which a log can be wrong is one line that names the place."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError

Array = NDArray[np.float64]

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
PREFIXES = {"commands": ("command", "cmd", "action"), "observations": ("observation", "obs")}
TIMES = ("time", "timestamp", "t")
EPISODES = ("episode", "episode_index")
GAP = 20  # rows that may be missing before what follows counts as another recording


@dataclass(frozen=True)
class Log:
    """Signals of N rows; times in seconds from the first. `episode` numbers stretches without a break.

    A row is what was known when its command was sent: the newest observation then, and the command.
    """

    time: Array
    commands: Array  # [N, U]
    observations: Array  # [N, Y]
    episode: Array
    command_names: tuple[str, ...]
    observation_names: tuple[str, ...]


def read_signals(
    path: Path,
    time: str | None = None,
    commands: Sequence[str] | None = None,
    observations: Sequence[str] | None = None,
    episode: str | None = None,
    unit: str = "s",
) -> Log:
    """Time stamps, commands and observations of a log.

    Args:
        path: a CSV file with a header (commas, semicolons or tabs), or Parquet.
        time: column of the time stamps; by default `time`, `timestamp` or `t`.
        commands: columns, or beginnings of their names; by default `command`, `cmd`, `action`.
        observations: the same; by default `observation`, `obs`.
        episode: column that changes where a new recording begins; by default `episode` or `episode_index`, if any.
        unit: of the time stamps: s, ms, us or ns.

    Raises:
        DelayRLError: for anything that is wrong with the file.
    """
    table = _Table(path)
    stamps = table.find(time, TIMES, "time stamps", "--time")
    groups = {}
    for what, given in (("commands", commands), ("observations", observations)):
        starts = tuple(given or PREFIXES[what])
        names = [n for n in table.names if n != stamps and n.lower().startswith(tuple(s.lower() for s in starts))]
        if not names:
            raise DelayRLError(
                f"{path}: no column for {what}: none begins with {' or '.join(starts)}; name them with --{what}. "
                f"It has {_few(table.names)}"
            )
        groups[what] = names
    both = set(groups["commands"]) & set(groups["observations"])
    if both:
        raise DelayRLError(
            f"{path}: {_few(sorted(both))} would be a command and an observation; name them with --commands"
        )
    number = table.find(episode, EPISODES, "episodes", "--episode", needed=episode is not None)
    seconds = table.column(stamps) * UNITS[unit]
    episodes = table.column(number) if number else np.zeros(len(seconds))
    _check_times(path, stamps, seconds, episodes)
    columns: list[Array] = []
    labels: list[tuple[str, ...]] = []
    for what in ("commands", "observations"):
        found = [table.matrix(name) for name in groups[what]]
        columns.append(np.concatenate(found, 1))
        labels.append(tuple(
            name if block.shape[1] == 1 else f"{name}[{i}]"
            for name, block in zip(groups[what], found, strict=True)
            for i in range(block.shape[1])
        ))  # fmt: skip
    for values, what in zip(columns, ("command", "observation"), strict=True):
        if (values == values[0]).all():
            raise DelayRLError(f"{path}: every {what} is constant: nothing can be learned of a delay from it")
    return Log(seconds - seconds[0], columns[0], columns[1], episodes, labels[0], labels[1])


def read_stamps(path: Path, stamp: str | None, received: str | None, unit: str) -> tuple[Array, Array] | None:
    """When observations were made and when they arrived, in seconds; None if the log does not say both."""
    table = _Table(path)
    made = table.find(stamp, ("stamp",), "send times", "--stamp", needed=stamp is not None)
    arrived = table.find(received, ("received",), "arrival times", "--received", needed=received is not None)
    if not made or not arrived:
        return None
    return table.column(made) * UNITS[unit], table.column(arrived) * UNITS[unit]


def resample(log: Log) -> tuple[Log, float]:
    """The log on a uniform grid of its median row spacing, which is returned too, in seconds.

    Each grid point, half a row after a row, takes the newest row: holding never brings a value in before it was there,
    as interpolation would. Rows that are as good as uniform are taken as they are.
    """
    gaps = np.diff(log.time)
    inside = log.episode[1:] == log.episode[:-1]
    step = float(np.median(gaps[inside]))
    breaks = ~inside | (gaps > GAP * step)
    pieces = np.concatenate([[0], np.cumsum(breaks)])
    if (np.abs(gaps[~breaks] / step - 1) < 0.1).all():
        taken, numbers = np.arange(len(log.time)), pieces
    else:
        rows, counts = [], []
        for piece in range(int(pieces[-1]) + 1):
            own = np.flatnonzero(pieces == piece)
            grid = np.arange(log.time[own[0]] + step / 2, log.time[own[-1]] + step, step)
            rows.append(own[np.searchsorted(log.time[own], grid, "right") - 1])
            counts.append(np.full(len(grid), piece))
        taken, numbers = np.concatenate(rows), np.concatenate(counts)
    return (
        Log(
            np.arange(len(taken), dtype=float) * step,
            log.commands[taken],
            log.observations[taken],
            numbers.astype(float),
            log.command_names,
            log.observation_names,
        ),
        step,
    )


class _Table:
    """Columns of a file, as text or numbers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        head = path.read_bytes()[:4] if path.is_file() else None
        if head is None:
            raise DelayRLError(f"{path}: no such file")
        if not head:
            raise DelayRLError(f"{path} is empty")
        self._columns: dict[str, Any] = _parquet(path) if head == b"PAR1" else _csv(path)
        self.names = list(self._columns)
        if not self.names or not len(self._columns[self.names[0]]):
            raise DelayRLError(f"{path} has no rows")

    def find(self, given: str | None, usual: tuple[str, ...], what: str, option: str, needed: bool = True) -> str:
        """Name of the column, or "" if there is none and none is needed."""
        wanted = (given,) if given else usual
        for name in wanted:
            if name in self._columns:
                return name
        if needed:
            raise DelayRLError(
                f"{self.path}: no column {' or '.join(map(str, wanted))} for the {what}; name it with {option}. "
                f"It has {_few(self.names)}"
            )
        return ""

    def column(self, name: str) -> Array:
        """One number a row."""
        values = self.matrix(name)
        if values.shape[1] != 1:
            raise DelayRLError(f"{self.path}: column {name} holds vectors; it must hold one number a row")
        return values[:, 0]

    def matrix(self, name: str) -> Array:
        """Numbers, [N, 1] or, for a column of vectors, [N, size]."""
        cells = self._columns[name]
        try:
            values = np.array(cells, float)
        except (TypeError, ValueError):
            row = next((i for i, cell in enumerate(cells) if not _number(cell)), 0)
            shown = "an empty cell" if cells[row] in ("", None) else f"{cells[row]!r}, which is no number"
            raise DelayRLError(f"{self.path}, row {row + 1}: column {name} has {shown}") from None
        values = values.reshape(len(values), -1)
        wrong = ~np.isfinite(values).all(1)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DelayRLError(
                f"{self.path}, row {row + 1}: column {name} has {cells[row]}; drop such rows or fill them"
            )
        return values


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
        raise DelayRLError(f"{path} has no header of column names in its first line; or it is neither CSV nor Parquet")
    if len(set(names)) < len(names):
        raise DelayRLError(
            f"{path} has two columns of the same name: {_few(sorted(n for n in names if names.count(n) > 1))}"
        )
    for i, row in enumerate(rows[1:]):
        if len(row) != len(names):
            raise DelayRLError(f"{path}, row {i + 1}: {len(row)} cells under {len(names)} column names")
    return {name: list(cells) for name, cells in zip(names, zip(*rows[1:], strict=True), strict=len(rows) > 1)}


def _parquet(path: Path) -> dict[str, Any]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise DelayRLError(f"{path} is a Parquet file: pip install 'delayrl[parquet]' to read it") from None
    try:
        table = parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise DelayRLError(f"{path} is a damaged Parquet file: {str(error).splitlines()[0]}") from None
    return {name: table.column(name).to_pylist() for name in table.column_names}


def _check_times(path: Path, name: str, seconds: Array, episodes: Array) -> None:
    if len(seconds) < 2:
        raise DelayRLError(f"{path} has one row: too short for a delay")
    gaps = np.where(episodes[1:] == episodes[:-1], np.diff(seconds), 1.0)
    if (gaps <= 0).any():
        row = int(np.argmax(gaps <= 0)) + 1
        what = "repeats" if gaps[row - 1] == 0 else "goes back"
        raise DelayRLError(
            f"{path}, row {row + 1}: {name} {what}; time stamps must increase (sort the rows, drop duplicates; a "
            "column named with --episode says where a new recording begins)"
        )


def _number(cell: Any) -> bool:
    try:
        return cell is not None and not math.isnan(float(cell) * 0 + 1)
    except (TypeError, ValueError):
        return False


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
