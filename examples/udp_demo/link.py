"""Simulate a bad network between sensor and controller: delay, jitter, loss and duplicates, repeatable from a seed."""

import heapq
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Link:
    """What happens to observations on their way.

    Attributes:
        low, high: bounds of the travel time, in steps. Each observation has its own, so they overtake each other.
        loss: probability that an observation is lost. The first one never is.
        double: probability that an observation arrives twice.
        missed: probability that a command is lost on its way back (in lockstep only). The plant then goes on with the
            command before.
        first: travel time of the first observation, in steps.
    """

    low: float = 0
    high: float = 0
    loss: float = 0.0
    double: float = 0.0
    missed: float = 0.0
    first: int = 0


class Travelling:
    """The observations of one episode that are on their way.

    Args:
        link: the network.
        seed: of all its random numbers.
        whole_steps: sample travel times in whole steps.
    """

    def __init__(self, link: Link, seed: list[int], whole_steps: bool = True) -> None:
        self._link, self._random, self._whole_steps = link, np.random.default_rng(seed), whole_steps
        self._commands = np.random.default_rng([*seed, 1])
        self._queue: list[tuple[float, int]] = []  # (arrival, step)

    def send(self, step: int) -> None:
        """Send the observation of a step."""
        link, random = self._link, self._random
        lost, doubled = random.random(2) < (link.loss, link.double)
        travels = (
            random.integers(link.low, link.high, 2, endpoint=True)
            if self._whole_steps
            else random.uniform(link.low, link.high, 2)
        )
        if step == 0:
            lost, travels[0] = False, self._link.first
        for travel in travels[: 0 if lost else 1 + int(doubled)]:
            heapq.heappush(self._queue, (step + float(travel), step))

    def missed(self) -> bool:
        """Sample whether the next command is lost."""
        return bool(self._commands.random() < self._link.missed)

    def due(self, now: float) -> list[int]:
        """Return the steps of the observations that arrive by `now`, in order of arrival."""
        arrived = []
        while self._queue and self._queue[0][0] <= now:
            arrived.append(heapq.heappop(self._queue)[1])
        return arrived

    def next(self) -> float:
        """Return when the next observation arrives; infinity if none is on its way."""
        return self._queue[0][0] if self._queue else float("inf")
