"""Times as numbers of environment steps, and files of measured delays."""

import math
import re
from numbers import Real
from pathlib import Path

import numpy as np

from delayrl.delays.laws import Recorded, whole_steps
from delayrl.errors import DelayRLError, first_line

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"


def recorded(path: str | Path, step_seconds: float | None = None, unit: str = "") -> Recorded:
    """Read measured delays from a file.

    Args:
        path: a .npy file, or a text file with one number per line. A text file may start with a header. Of several
            columns the last one counts; those of a text file need a header, because 54,3 may be one number.
        step_seconds: the length of an environment step, needed if `unit` is a time.
        unit: "" for whole steps; "s" or "ms" for times, which are rounded up to whole steps.

    Raises:
        DelayRLError: a missing or empty file, several columns without a header, or a value that is not a finite number
            of at least 0.
    """
    if unit not in ("", "s", "ms"):
        raise DelayRLError(f"recorded delays are in steps (no unit), s or ms; got {unit!r}")
    try:
        path = Path(path).expanduser()
        cells = _cells(path)
    except OSError as error:
        raise DelayRLError(f"cannot read the recorded delays {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, RuntimeError) as error:  # the last for ~name of nobody
        raise DelayRLError(f"{path} cannot be read as recorded delays: {first_line(error)}") from error
    if not cells:
        raise DelayRLError(f"{path} holds no delays: it is empty")
    steps = []
    for place, cell in cells:
        if not is_number(cell):
            raise DelayRLError(f"{path}, {place}: recorded delays must be numbers; got {cell[:40]!r}")
        value = float(cell)
        if not (math.isfinite(value) and value >= 0):
            raise DelayRLError(f"{path}, {place}: recorded delays must be finite and not negative; got {value:g}")
        if not unit and not value.is_integer():
            raise DelayRLError(
                f"{path}, {place}: recorded delays must be whole numbers of steps; got {value:g}. "
                f"For times write recorded:{path}:ms or :s"
            )
        steps.append(rounded_up(in_steps(value, unit, step_seconds)))
    return Recorded(tuple(steps))


def _cells(path: Path) -> list[tuple[str, str]]:
    """Read the values of a file as text, each with its place in the file."""
    if path.suffix == ".npy":
        # memory-mapped, because a header may promise more values than the file holds
        array = np.load(path, allow_pickle=False, mmap_mode="r")
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf" or array.ndim > 2:
            raise ValueError("not an array of numbers with one or two axes")
        column = array if array.ndim < 2 else array[:, -1]
        return [(f"entry {i}", repr(value)) for i, value in enumerate(np.atleast_1d(column).astype(float).tolist())]
    lines = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
    rows = [(f"line {i}", line.split(",")) for i, line in lines if line.strip()]
    cells = [(place, row[-1].strip().strip('"')) for place, row in rows]
    has_header = bool(cells) and not is_number(cells[0][1])
    columns = len(rows[0][1]) if has_header else 1
    for place, row in rows:
        if len(row) < columns:
            line = f"{path}, {place}: {len(row)} of {columns} columns"
            raise DelayRLError(f"{line}; the delay is in the last: complete the line, or remove it")
        if len(row) > columns:
            line = f"{path}, {place}: several columns and no header, or decimal commas"
            raise DelayRLError(f"{line}; write one number a line, such as 54.3, or name the columns in the first line")
    return cells[1:] if has_header else cells


def in_steps(number: float, unit: str, step_seconds: float | None) -> float:
    """Convert a number with a unit ("" for steps, "s" or "ms") to environment steps, without rounding.

    Raises:
        DelayRLError: a time, although the length of a step is unknown; a length that is none.
    """
    if not unit:
        return number
    if step_seconds is not None and (not isinstance(step_seconds, Real) or not 0 < step_seconds < math.inf):
        raise DelayRLError(f"step_seconds is the seconds of a step, a number above 0; got {step_seconds!r}")
    if step_seconds is None:
        hint = (
            "give steps, or the task an attribute `dt` in seconds; in Python, give step_seconds to `make` or a wrapper"
        )
        raise DelayRLError(f"the task does not say how long a step is (no `dt`): {hint}")
    return number * {"s": 1.0, "ms": 1e-3}[unit] / step_seconds


def next_whole(steps: float) -> int:
    """Round up to a whole number. Less than a millionth part above one is the rounding error of a step's length."""
    return math.ceil(steps - 1e-6 * max(1.0, steps))


def rounded_up(steps: float) -> int:
    """Round a delay up to whole steps: a message that arrives between two steps is seen at the later one."""
    if not math.isfinite(steps):
        raise DelayRLError(f"a delay must be finite; got {steps:g} steps")
    return whole_steps(next_whole(steps) if steps > 0 else math.floor(steps))


def is_number(text: str) -> bool:
    """Tell whether a text is a number, nan or infinity. Callers refuse the last two with messages of their own."""
    return bool(re.fullmatch(rf"{NUMBER}|[+-]?(nan|inf|infinity)", text.strip(), re.IGNORECASE))
