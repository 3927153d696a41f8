"""Delay laws: how many environment steps each message travels.

A law is a frozen value. What it has to know between two messages is one integer, the law's state. The caller keeps it
and sets it to 0 at the start of an episode. `str` of a law is a text that `as_delay` reads.
"""

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np

from delayrl.errors import DelayRLError

LONGEST, MOST_STATES = 100_000, 1000
"""The longest delay in steps, and the largest number of states of a chain. More would fill the memory."""


def whole_steps(steps: Any) -> int:
    """Check a delay. Raises DelayRLError for anything but a whole number of 0 to `LONGEST` steps."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer):
        hint = f"; for a time write {steps}s" if isinstance(steps, float) and 0 < steps < LONGEST else ""
        raise DelayRLError(f"a delay counts whole environment steps; got {steps!r}{hint}")
    if steps < 0:
        raise DelayRLError(f"a delay cannot be negative; got {steps:g}")
    if steps > LONGEST:
        raise DelayRLError(f"a delay is at most {LONGEST} steps; got {float(steps):g}")
    return int(steps)


@runtime_checkable
class DelayLaw(Protocol):
    """How long messages travel, in environment steps."""

    @property
    def maximum(self) -> int:
        """The longest delay."""

    def draw(self, state: int, random: np.random.Generator, /) -> tuple[int, int]:
        """Draw the travel time of the next message.

        Args:
            state: the law's state; 0 at the start of an episode.
            random: the source of random numbers.

        Returns:
            The travel time in steps, and the state for the next message.
        """


@dataclass(frozen=True)
class Constant:
    """Every message travels exactly `steps` environment steps (VDPO, §2)."""

    steps: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", whole_steps(self.steps))

    @property
    def maximum(self) -> int:
        """The delay itself."""
        return self.steps

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Return `steps`."""
        return self.steps, state

    def __str__(self) -> str:
        return str(self.steps)


@dataclass(frozen=True)
class Choice:
    """Draw each delay independently from a finite distribution.

    Attributes:
        steps: the possible delays.
        probabilities: the probability of each delay; they sum to 1.
    """

    steps: Sequence[int]
    probabilities: Sequence[float]
    name: str = field(default="", compare=False)  # its text, if one of the functions below made it

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", _delays(self.steps))
        object.__setattr__(self, "probabilities", _distribution(self.probabilities))
        if len(self.steps) != len(self.probabilities):
            raise DelayRLError(f"{len(self.steps)} delays need as many probabilities; got {len(self.probabilities)}")

    @property
    def maximum(self) -> int:
        """The longest possible delay, even if its probability is 0."""
        return max(self.steps)

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Draw one of the delays; the state stays 0."""
        return self.steps[bisect_right(self._cumulative, random.random())], state

    @cached_property
    def _cumulative(self) -> list[float]:
        return _cumulated(self.probabilities)

    def __str__(self) -> str:
        pairs = zip(self.steps, self.probabilities, strict=True)
        return self.name or "choice:" + ",".join(f"{s}={_as_text(p)}" for s, p in pairs)


@dataclass(frozen=True)
class Markov:
    """A Markov chain with a delay for each of its states. It moves once per message.

    Attributes:
        steps: the delay of each state.
        transitions: row i holds the probabilities of the states that follow state i.
    """

    steps: Sequence[int]
    transitions: Sequence[Sequence[float]]
    name: str = field(default="", compare=False)  # its text, if one of the functions below made it

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", _delays(self.steps))
        size = len(self.steps)
        _check_states(size)
        object.__setattr__(self, "transitions", tuple(_distribution(row) for row in self.transitions))
        if len(self.transitions) != size or any(len(row) != size for row in self.transitions):
            raise DelayRLError(f"{size} states need a square table: {size} rows of {size} probabilities")

    @property
    def maximum(self) -> int:
        """The longest possible delay, even if its probability is 0."""
        return max(self.steps)

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Draw the next state of the chain; the first comes from the stationary distribution.

        The law's state is 1 plus the chain's, because 0 marks the start of an episode.
        """
        chain_state = bisect_right(self._cumulative[state], random.random())
        return self.steps[chain_state], chain_state + 1

    @cached_property
    def stationary(self) -> tuple[float, ...]:
        """The long-run share of messages in each state. A chain that falls apart has several; this is one of them."""
        chain = np.array(self.transitions)
        size = len(chain)
        balance = np.vstack([(chain.T - np.eye(size))[:-1], np.ones(size)])  # the last equation follows from the others
        try:
            shares = np.linalg.solve(balance, np.eye(size)[-1])
        except np.linalg.LinAlgError:
            shares = np.linalg.lstsq(balance, np.eye(size)[-1], rcond=None)[0]
        return _scaled(np.clip(shares, 0, None))

    @cached_property
    def _cumulative(self) -> list[list[float]]:
        return [_cumulated(row) for row in (self.stationary, *self.transitions)]

    def __str__(self) -> str:
        rows = "/".join(",".join(map(_as_text, row)) for row in self.transitions)
        return self.name or f"markov:{','.join(map(str, self.steps))}:{rows}"


@dataclass(frozen=True)
class Recorded:
    """Replay measured delays in order. Each episode starts at a random one; after the last comes the first."""

    steps: Sequence[int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", _delays(self.steps))

    @property
    def maximum(self) -> int:
        """The longest delay that was recorded."""
        return max(self.steps)

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Return the next recorded delay; the state is 1 plus its index."""
        index = state % len(self.steps) if state else int(random.integers(len(self.steps)))
        return self.steps[index], index + 1

    def __str__(self) -> str:
        return f"recorded:{','.join(map(str, self.steps))},"


def uniform(low: int, high: int) -> Choice:
    """Make a law in which the delays low..high are equally likely."""
    if not whole_steps(low) <= whole_steps(high):
        raise DelayRLError(f"delays from LOW to HIGH, as in uniform:2:4, need LOW ≤ HIGH; got {low} and {high}")
    count = high - low + 1
    return Choice(tuple(range(low, high + 1)), (1 / count,) * count, name=f"uniform:{low}:{high}")


def poisson(mean: float, maximum: int) -> Choice:
    """Make a Poisson law that is cut at `maximum`: the probabilities of 0..maximum are scaled to sum to 1."""
    mean = _positive(mean, "the mean of a Poisson delay")
    steps = tuple(range(whole_steps(maximum) + 1))
    log_weights = np.array([k * math.log(mean) - math.lgamma(k + 1) for k in steps])
    weights = np.exp(log_weights - log_weights.max())
    return Choice(steps, _scaled(weights), name=f"poisson:{_as_text(mean)}:{maximum}")


def gamma(mean: float, deviation: float, maximum: int) -> Choice:
    """Make a gamma law of this mean and standard deviation in steps, rounded up to whole steps, cut at `maximum`."""
    mean = _positive(mean, "the mean of a gamma delay")
    deviation = _positive(deviation, "the standard deviation of a gamma delay")
    if not 1e-3 <= deviation / mean <= 1e3:
        raise DelayRLError(f"a gamma delay's deviation is between 1/1000 and 1000 means; got {deviation:g}, {mean:g}")
    shape, scale = (mean / deviation) ** 2, deviation * (deviation / mean)
    edges = [_gamma_below(shape, k / scale) for k in range(whole_steps(maximum) + 1)]
    weights = np.clip(np.diff(edges, prepend=0.0), 0, None)  # the series may be off by rounding errors
    if not weights.sum() > 0:
        raise DelayRLError(f"a gamma delay of mean {mean:g} and deviation {deviation:g} is never below {maximum}")
    name = f"gamma:{_as_text(mean)}:{_as_text(deviation)}:{maximum}"
    return Choice(tuple(range(maximum + 1)), _scaled(weights), name=name)


def gilbert_elliott(good: int, bad: int, worsen: float, recover: float) -> Markov:
    """Make a network whose delay is `good` or `bad`. It changes with probability `worsen` or `recover` per message."""
    rows = ((1 - worsen, worsen), (recover, 1 - recover))
    return Markov((good, bad), rows, name=f"gilbert:{good}:{bad}:{_as_text(worsen)}:{_as_text(recover)}")


def random_walk(maximum: int, move: float = 2 / 3) -> Markov:
    """Make a walk on 0..maximum that moves up or down, each with probability `move` / 2. It does not leave the ends."""
    size = whole_steps(maximum) + 1
    _check_states(size)
    if not 0 <= move <= 1:
        raise DelayRLError(f"a walk, as in walk:MAX:MOVE, moves with a probability from 0 to 1; got {move:g}")
    chain = np.eye(size) * (1 - move)
    for state in range(size):
        chain[state, max(state - 1, 0)] += move / 2
        chain[state, min(state + 1, maximum)] += move / 2
    name = f"walk:{maximum}" if move == 2 / 3 else f"walk:{maximum}:{_as_text(move)}"
    return Markov(tuple(range(size)), tuple(map(tuple, chain.tolist())), name=name)


def _check_states(count: int) -> None:
    if not 0 < count <= MOST_STATES:
        raise DelayRLError(f"a Markov chain of delays has 1 to {MOST_STATES} states; got {count}")


def _delays(steps: Sequence[int]) -> tuple[int, ...]:
    delays = tuple(whole_steps(delay) for delay in steps)
    if not delays:
        raise DelayRLError("a law of delays needs at least one delay; it has none")
    return delays


def _positive(number: float, what: str) -> float:
    if not (math.isfinite(number) and number > 0):
        raise DelayRLError(f"{what} must be positive; got {number:g}")
    return number


def _distribution(probabilities: Any) -> tuple[float, ...]:
    values = tuple(float(p) for p in probabilities)
    if not values or not all(math.isfinite(p) and p >= 0 for p in values):
        raise DelayRLError(f"probabilities must be numbers from 0 to 1; got {values}")
    if abs(sum(values) - 1) > 1e-6:
        raise DelayRLError(f"probabilities must sum to 1; {', '.join(f'{p:g}' for p in values)} sum to {sum(values):g}")
    return values


def _scaled(weights: Any) -> tuple[float, ...]:
    return tuple((np.asarray(weights) / np.sum(weights)).tolist())


def _cumulated(probabilities: Sequence[float]) -> list[float]:
    """Sum up probabilities for `bisect_right`. The last entry is exactly 1, above every random number."""
    return [*list(itertools.accumulate(probabilities))[:-1], 1.0]


def _gamma_below(shape: float, x: float) -> float:
    """P(X ≤ x) of a gamma distribution of scale 1, by the series of the lower incomplete gamma function."""
    if x <= 0:
        return 0.0
    if x > shape + 40 * math.sqrt(shape) + 100:  # nearly certain, and the series would overflow
        return 1.0
    term = total = 1 / shape
    n = 0
    while term > total * 1e-16:
        n += 1
        term *= x / (shape + n)
        total += term
    return min(1.0, total * math.exp(shape * math.log(x) - x - math.lgamma(shape)))


def _as_text(number: float) -> str:
    return repr(int(number) if float(number).is_integer() else float(number))
