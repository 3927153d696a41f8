"""Tables and a status line for people who read a terminal or a log."""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows below a head, in columns that are as wide as their widest cell."""
    cells = [list(head), *[[str(cell) for cell in row] for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    for row in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


class StatusLine:
    """A line on stderr: rewritten every second on a terminal, repeated every 30 seconds in a log.

    Args:
        text: returns the line, from the seconds since the start.
    """

    def __init__(self, text: Callable[[float], str]):
        self._text = text
        self._terminal = sys.stderr.isatty()
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
        self._next = now + (1 if self._terminal else 30)
        text = self._text(now - self._start)
        self.clear()
        print(text, end="" if self._terminal else "\n", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Erase the status from a terminal."""
        if self._terminal:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
