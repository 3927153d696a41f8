"""Laws of users: classes of their own, named `module:Class(argument=value)` or by an entry point.

A law of one's own is a frozen dataclass with `maximum` and `draw`. `OwnLaw` checks its travel times and writes the text
that a run keeps.
"""

import re
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.delays.laws import DelayLaw, whole_steps
from delayrl.errors import DelayRLError, one_line
from delayrl.lookup import (
    entry_points,
    find_object,
    is_unsafe,
    name_of_object,
    parse_arguments,
    public_name,
    with_arguments,
)

GROUP = "delayrl.delays"
PAGE = "docs/delays.md shows one"


@dataclass(frozen=True)
class OwnLaw:
    """A law of a user.

    Attributes:
        law: draws; None where a run has no name for it.
        text: names it: `module:Class(argument=value)`, or `<Class:maximum>` if it cannot be imported.
        maximum: the longest delay.
    """

    law: DelayLaw | None
    text: str
    maximum: int

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Draw from the user's law. Raises DelayRLError for a travel time that is not in 0..maximum, or no law."""
        if self.law is None:
            raise DelayRLError(f"{self.text} has no name that it could be imported by: give it again, as delay")
        drawn: Any = self.law.draw(state, random)
        try:
            travel, state = drawn
        except (TypeError, ValueError) as error:
            line = f"{self.text} drew {drawn!r:.80}, not a travel time and the next state: {PAGE}"
            raise DelayRLError(line) from error
        whole = isinstance(travel, int | np.integer) and not isinstance(travel, bool)
        if not whole or not 0 <= travel <= self.maximum:
            allowed = f"a travel time is a whole number of steps from 0 to its maximum, {self.maximum}"
            raise DelayRLError(f"{self.text} drew {travel!s:.80}: {allowed}")
        return int(travel), state

    def __str__(self) -> str:
        return self.text


def own_law(law: Any) -> OwnLaw:
    """Return the law that a user gave, with its text. Raises DelayRLError if it is a class, or has no good maximum."""
    kind = type(law)
    if isinstance(law, type):
        raise DelayRLError(f"a law is an instance: give {law.__name__}(…) for the class {law.__name__}")
    if not hasattr(law, "maximum"):
        raise DelayRLError(f"{kind.__name__} is no law of delays, because it lacks maximum: {PAGE}")
    maximum, name = whole_steps(law.maximum), name_of_object(kind)
    unnamed = OwnLaw(law, f"<{kind.__name__}:{maximum}>", maximum)
    if name.startswith("<") or not is_dataclass(kind):
        return unnamed
    kwargs = {field.name: getattr(law, field.name) for field in fields(law) if field.init}
    try:
        text = with_arguments(public_name(name, GROUP), kwargs)
        return OwnLaw(law, text, maximum) if _made(name, kind, text) == law else unnamed
    except (TypeError, DelayRLError):  # arguments that JSON cannot hold, or that do not make it again
        return unnamed


def find_law(text: str, stored: Path | None) -> OwnLaw | None:
    """Return the law that a text names, or None if the text is not one of a user's law.

    Args:
        text: `module:Class`, or the name of an entry point, with arguments in brackets; or `<Class:maximum>`.
        stored: the run folder that says so, if one does. It may name classes of laws, and no code that came with it.

    Raises:
        DelayRLError: the law cannot be imported or made, or the folder may not name it.
    """
    if unnamed := re.fullmatch(r"<[^<>:]+:(\d{1,6})>", text):
        return OwnLaw(None, text, whole_steps(int(unnamed[1])))
    match = re.fullmatch(r"([^\W\d][\w.-]*(?::[^\W\d][\w.]*)?)\s*(\(.*)?", text)
    source = match and (match[1] if ":" in match[1] else entry_points(GROUP).get(match[1]))
    if not match or not source:
        return None
    if stored is not None and is_unsafe(source, stored):
        line = f"{stored} came with a law of delays that could run any code, {source}"
        raise DelayRLError(f"{line}: if you mean it, move its module out of that folder")
    kind = find_object(source)
    if not (isinstance(kind, type) and is_dataclass(kind) and hasattr(kind, "draw")):
        raise DelayRLError(f"{source} is no law of delays, because it is no dataclass with draw: {PAGE}")
    return own_law(_made(source, kind, text))


def _made(name: str, kind: Any, text: str) -> Any:
    """Return the law of this class with the arguments in brackets of the text; lists are given as tuples."""
    try:
        kwargs, rest = parse_arguments(text.partition("(")[2] or ")")
    except ValueError:
        rest = text
    if rest:
        raise DelayRLError(f"cannot read the law {text!r}; write e.g. {name}(rate=0.1), with values as JSON")
    with one_line(f"the law {text!r} cannot be made"):
        return kind(**{key: _as_tuples(value) for key, value in kwargs.items()})


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value
