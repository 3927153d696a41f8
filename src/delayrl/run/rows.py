"""Rows: one for each evaluation episode, as a run folder's rows.jsonl holds them."""

import math
from collections.abc import Mapping, Sequence, Sized
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError, count

Row = dict[str, Any]
CONDITION: dict[str, Any] = {"agent": str, "env": str, "delay": int | str, "preset": str, "protocol": str}
"""The columns that describe a row's condition, with their types."""
CONFIGURATION = "configuration"
"""The column with the hash of a run's options. Rows of version 0.1 have none."""
EPISODE = {"step": int, "policy": str, "episode": int, "reset_seed": int, "return": float, "length": int}
"""The columns that differ between the rows of a run, with their types."""


def check_row(row: Row, where: object) -> None:
    """Raise DelayRLError, naming `where`, if a row of a run folder is damaged."""
    typed = all(type(row.get(name)) is kind for name, kind in EPISODE.items())
    if not typed or not math.isfinite(row["return"]):
        raise DelayRLError(f"{where} holds a damaged row: {str(row)[:200]}")


def check_rows(rows: list[Row], where: object) -> None:
    """Raise DelayRLError if a row of a run folder is damaged, or an episode there twice."""
    known = set()
    for row in rows:
        check_row(row, where)
        if (episode := (row["policy"], row["step"], row["episode"])) in known:
            raise DelayRLError(f"{where} holds an episode twice: step {row['step']}, {row['policy']}")
        known.add(episode)


def whole_evaluations(episodes: Mapping[int, Sized]) -> list[int]:
    """Return the steps of a policy's evaluations, in order, but not of one that a crash cut: it has fewer episodes."""
    most = max(map(len, episodes.values()), default=0)
    return sorted(step for step, played in episodes.items() if len(played) == most)


def deviation(returns: Sequence[float] | NDArray[np.float64]) -> float | None:
    """Return the standard deviation of episodes' returns, with n - 1 in the denominator; None for one episode."""
    return float(np.std(returns, ddof=1)) if np.size(returns) > 1 else None


def number_in_words(value: float, like: float | None = None, *, least: int = 1, comma: str = ",") -> str:
    """Write a number with at least this many decimals; from 0.000001 to 1 with as many as show three digits.

    `like` is another number whose decimals it gets, as a deviation gets those of its mean. A rounded 0 has no sign.
    """
    size = abs(value if like is None else like)
    decimals = max(least, 2 - math.floor(math.log10(size))) if 1e-6 <= size < 1 else least
    return unsigned_zero(f"{value:{comma}.{decimals}f}")


def shown_like(mean: float, *others: float) -> float:
    """Return the number whose decimals a mean and its deviation or bounds get: the largest, if the mean is below 1."""
    return mean if abs(mean) >= 1 else max((mean, *others), key=lambda value: -1 if math.isnan(value) else abs(value))


def unsigned_zero(text: str) -> str:
    """Return a number's text, without its sign if it is 0."""
    return text.removeprefix("-") if not text.strip("-0.") else text


def return_in_words(returns: Sequence[float] | NDArray[np.float64]) -> str:
    """Write the mean of episodes' returns, ± their standard deviation, and of how many episodes it is."""
    mean, spread = float(np.mean(returns)), deviation(returns)
    like = mean if spread is None else shown_like(mean, spread)
    words = "" if spread is None else f" ± {number_in_words(spread, like, comma='')}"
    return f"{number_in_words(mean, like, comma='')}{words} over {count(np.size(returns), 'episode')}"


def name_configuration(rows: Sequence[Row]) -> list[Row]:
    """Give all rows of a run the configuration that its last row names: an older version may have begun the run."""
    newest = rows[-1].get(CONFIGURATION) if rows else None
    return [row if newest is None else {CONFIGURATION: newest} | row for row in rows]


def plain_text(text: str) -> str:
    """Return a text of a row as pictures can draw it: no formula between two $, no lone surrogates."""
    return text.encode("utf-8", "replace").decode().replace("$", r"\$")
