"""Delay laws: how many environment steps an observation travels before the agent sees it.

A law is a frozen dataclass with a `maximum` and a `draw`. `draw` is asked once for each observation that the
environment generates; the law's memory (none for `Constant`) is one integer that the wrapper keeps, 0 at the start
of an episode, so that a law is a value and an episode can be replayed from its seed.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from delayrl.errors import DelayRLError


@runtime_checkable
class DelayLaw(Protocol):
    """How long observations travel, in environment steps."""

    @property
    def maximum(self) -> int:
        """The longest delay: the length of the action history that the agent is given."""
        ...

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """Travel time of the next observation, and the law's memory after it."""
        ...


@dataclass(frozen=True)
class Constant:
    """Every observation travels exactly `steps` environment steps (VDPO, §2)."""

    steps: int

    def __post_init__(self) -> None:
        if isinstance(self.steps, bool) or not isinstance(self.steps, int | np.integer):
            raise DelayRLError(f"a delay counts whole environment steps; got {self.steps!r}")
        if self.steps < 0:
            raise DelayRLError(f"a delay cannot be negative; got {self.steps}")

    @property
    def maximum(self) -> int:
        """The delay itself."""
        return int(self.steps)

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """Always `steps`."""
        return int(self.steps), memory


def as_law(delay: float | DelayLaw) -> DelayLaw:
    """A law as it is; a number as the constant delay of so many steps.

    Raises:
        DelayRLError: for a negative or fractional number, or anything that is no law.
    """
    if isinstance(delay, DelayLaw):
        return delay
    if isinstance(delay, float) and delay.is_integer():
        delay = int(delay)
    return Constant(delay)  # type: ignore[arg-type]
