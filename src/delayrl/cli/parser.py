"""argparse with errors in one line."""

import argparse
import difflib
from collections.abc import Sequence
from typing import NoReturn

from delayrl.errors import DelayRLError


class Parser(argparse.ArgumentParser):
    """Parse a command's words. Every error is a DelayRLError."""

    def read(self, words: Sequence[str]) -> argparse.Namespace:
        """Return the values of the options.

        Raises:
            DelayRLError: a bad value or a missing one, or an unknown option, with the nearest names.
        """
        given, rest = self.parse_known_args(words)
        if rest:
            unknown = next((word for word in rest if word.startswith("--")), "").split("=")[0]
            near = difflib.get_close_matches(unknown, self._option_string_actions, n=3, cutoff=0.4)
            hint = f"; did you mean {', '.join(near)}?" if near else ""
            self.error(f"unexpected {' '.join(rest)!r}{hint}")
        return given

    def error(self, message: str) -> NoReturn:
        """Raise DelayRLError instead of printing the usage."""
        raise DelayRLError(f"{message.replace('argument ', '')} (see `{self.prog} --help`)")
