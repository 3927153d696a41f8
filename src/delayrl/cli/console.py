"""What commands share: a parser with errors in one line, tables, and a status line for a terminal or a log."""

import argparse
import ast
import json
import re
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from delayrl.errors import DelayRLError, did_you_mean, near_names


class Parser(argparse.ArgumentParser):
    """Parse a command's words. Every error is a DelayRLError."""

    def __init__(self, *values: Any, **options: Any) -> None:
        super().__init__(*values, **options)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # argparse takes -20,2 and -1e3 for options

    def read(self, words: Sequence[str]) -> argparse.Namespace:
        """Return the values of the options, whose names may have underscores for hyphens.

        The error for an unknown one names the nearest.
        """
        given, rest = self.parse_known_args([hyphenated(word) for word in words])
        if rest:
            unknown = next((word for word in rest if word.startswith("--")), "").split("=")[0]
            groups = (action for action in self._actions if isinstance(action, argparse._SubParsersAction))
            inner = next((group.choices.get(getattr(given, group.dest), self) for group in groups), self)
            options = [name for name in inner._option_string_actions if name not in ("-h", "--help")]
            inner.error(f"unexpected {' '.join(rest)!r}{did_you_mean(near_names(unknown, options))}")
        return given

    def error(self, message: str) -> NoReturn:
        """Raise DelayRLError instead of printing the usage."""
        raise DelayRLError(f"{message.replace('argument ', '')} (see `{self.prog} --help`)")


def add_env_kwargs(parser: argparse._ActionsContainer) -> None:
    """Add `--env-kwargs`, which gives pairs of a name and a value."""
    words = "keyword arguments of the environment; values as in JSON or Python, else text"
    parser.add_argument(
        "--env-kwargs", nargs="+", action="extend", type=name_and_value, default=[], metavar="NAME=V", help=words
    )


def add_wrappers(parser: argparse._ActionsContainer) -> None:
    """Add `--wrapper` and `--flatten`."""
    words = "put this wrapper around the environment; may be repeated, innermost first"
    parser.add_argument("--wrapper", action="append", dest="wrappers", default=[], metavar="MODULE:CLASS", help=words)
    parser.add_argument("--flatten", action="store_true", help="join nested observations to one vector")


def add_stored(parser: argparse.ArgumentParser) -> None:
    """Add `--env` and `--agent`, for runs whose folder does not say enough to make these, or may not."""
    words = "what makes the environment (default: what the run names)"
    parser.add_argument("--env", metavar="MODULE:NAME", help=words)
    parser.add_argument("--agent", metavar="MODULE:NAME", help="the agent (default: what the run names)")


DEEPEST = 500
"""Opening brackets in the value of a keyword argument, which may all lie in one another."""


def name_and_value(word: str) -> tuple[str, Any]:
    """Return name and value of a word such as `gain=2`. Raises DelayRLError if it is none.

    A value is what JSON or Python reads (`true`, `True`, `.5`), else text: a text "False" would be true.
    """
    name, equals, text = word.partition("=")
    if not name.isidentifier() or not equals:
        raise DelayRLError(f"keyword arguments are written NAME=VALUE, e.g. gain=2; got {word!r}")
    if sum(map(text.count, "[{(")) > DEEPEST:  # Python's readers differ in what they do then
        raise DelayRLError(f"the value of {name} is nested too deeply")
    for read in (json.loads, ast.literal_eval):
        with suppress(ValueError, SyntaxError, TypeError):
            return name, read(text)
    return name, text


def hyphenated(word: str) -> str:
    """Replace the underscores in the name of an option; return any other word, and an option's value, as it is."""
    name, separator, value = word.partition("=")
    return name.replace("_", "-") + separator + value if word.startswith("--") else word


def whole(text: str) -> int:
    """Read a whole number, which may be written as 100_000 or 1e5."""
    with suppress(ValueError):
        return int(text)
    with suppress(ValueError):
        if (number := float(text)).is_integer():
            return int(number)
    raise argparse.ArgumentTypeError(f"must be a whole number; got {text!r}")


def positive(text: str) -> int:
    """Read a whole number that is at least 1."""
    if (number := whole(text)) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1; got {text}")
    return number


def seconds(text: str) -> float:
    """Read a time such as 20ms, 0.02s or 50Hz."""
    from delayrl.measure.reading import UNITS

    match = re.fullmatch(rf"(\d+\.?\d*(?:e[-+]?\d+)?|\.\d+)\s*({'|'.join(UNITS)}|hz)", text.strip().lower())
    value = float(match[1]) if match else 0.0
    if match is None or (match[2] == "hz" and not value):
        raise argparse.ArgumentTypeError(f"must be a time such as 20ms, 0.02s or 50Hz; got {text!r}")
    return 1 / value if match[2] == "hz" else value * UNITS[match[2]]


class Numbers(argparse.Action):
    """Collect numbers that are separated by spaces, by commas, or by both: `32 32` and `32,32`."""

    @staticmethod
    def of(kind: Callable[[str], Any]) -> dict[str, Any]:
        """Return the settings of an option that takes several numbers of one kind."""

        def numbers(text: str) -> list[Any]:
            return [kind(part) for part in text.split(",")]

        return {"action": Numbers, "nargs": "+", "type": numbers}

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        """Store the numbers of all words in one list."""
        setattr(namespace, self.dest, [number for word in values for number in word])


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows below a head, in columns that are as wide as their widest cell."""
    cells = [list(head), *[[str(cell) for cell in row] for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    for row in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


class StatusLine:
    """Show what `text` makes of the seconds since the start: every 5 seconds on a terminal, every 30 in a log."""

    def __init__(self, text: Callable[[float], str]):
        self._text, self._terminal = text, sys.stderr.isatty()
        self._next, self._start = 0.0, time.monotonic()

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self.clear()
        print(text, file=sys.stderr, flush=True)
        if self._terminal:
            self._next = 0.0

    def update(self) -> None:
        """Show the status, if it is time."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (5 if self._terminal else 30)  # it reads every cell
        text = self._text(now - self._start)
        self.clear()
        print(text, end="" if self._terminal else "\n", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Erase the status from a terminal."""
        if self._terminal:
            print("\r\033[K", end="", file=sys.stderr, flush=True)


def say_unfinished(run: Path, step: int | None = None) -> None:
    """Tell of an unfinished run after how many steps this is its policy; None for those of its newest checkpoint."""
    from delayrl.run.folder import RunFolder

    folder = RunFolder(run)
    steps, step = folder.config["schedule"]["steps"], folder.latest().step if step is None else step
    if step < steps:
        print(f"delayrl: {run} is not finished: this is its policy after {step:,} of {steps:,} steps", file=sys.stderr)


def quoted(path: Path) -> str:
    """Return a path as a shell takes it."""
    return shlex.quote(str(path))
