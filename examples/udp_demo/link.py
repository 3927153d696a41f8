"""A bad network between a sensor and a controller: delay, jitter, loss and doubles, repeatable from a seed."""

import heapq
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Link:
    """What happens to observations on their way.

    `low` and `high` bound the travel time in steps: whole steps in lockstep, any time between in real time; each
    observation draws its own, so they overtake each other. `loss` and `double` are probabilities; so is `missed`, that
    a command gets lost on its way back (in lockstep; the plant then goes on with the one before). The first observation
    is never lost and travels for `first` steps.
    """

    low: float = 0
    high: float = 0
    loss: float = 0.0
    double: float = 0.0
    missed: float = 0.0
    first: int = 0


class Travelling:
    """Observations of one episode on their way.

    Args:
        link: the network.
        seed: of everything that is random in it.
        whole: draw travel times in whole steps.
    """

    def __init__(self, link: Link, seed: list[int], whole: bool = True) -> None:
        self._link, self._random, self._whole = link, np.random.default_rng(seed), whole
        self._commands = np.random.default_rng([*seed, 1])
        self._queue: list[tuple[float, int]] = []  # (arrival, step)

    def send(self, step: int) -> None:
        """An observation sets out at time `step`."""
        link, random = self._link, self._random
        lost, doubled = random.random(2) < (link.loss, link.double)
        travels = (
            random.integers(link.low, link.high, 2, endpoint=True)
            if self._whole
            else random.uniform(link.low, link.high, 2)
        )
        if step == 0:
            lost, travels[0] = False, self._link.first
        for travel in travels[: 0 if lost else 1 + int(doubled)]:
            heapq.heappush(self._queue, (step + float(travel), step))

    def missed(self) -> bool:
        """Whether the command that is on its way is lost."""
        return bool(self._commands.random() < self._link.missed)

    def due(self, now: float) -> list[int]:
        """Steps of the observations that arrive by `now`, in the order of their arrival."""
        arrived = []
        while self._queue and self._queue[0][0] <= now:
            arrived.append(heapq.heappop(self._queue)[1])
        return arrived

    def next(self) -> float:
        """When the next one arrives; infinity if none is on its way."""
        return self._queue[0][0] if self._queue else float("inf")
