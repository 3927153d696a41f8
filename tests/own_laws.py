"""Laws of delays such as users bring."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Burst:
    """One step, but `steps` for `length` messages in a row; a burst begins with probability `rate` at each message."""

    rate: float = 0.1
    steps: int = 3
    length: int = 2

    @property
    def maximum(self) -> int:
        return max(self.steps, 1)

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        left = state - 1 if state > 1 else self.length * int(random.random() < self.rate)
        return (self.steps if left else 1), left


@dataclass(frozen=True)
class Cycle:
    """These travel times in turn."""

    times: tuple[Any, ...] = (2,)
    maximum: int = 2

    def draw(self, state: int, random: np.random.Generator) -> tuple[Any, int]:
        return self.times[state % len(self.times)], state + 1


class Plain:
    """Not a dataclass, so that nobody knows its arguments."""

    maximum = 2

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        return 2, state


@dataclass(frozen=True)
class Endless:
    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        return 2, state
