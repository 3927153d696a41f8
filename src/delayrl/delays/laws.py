"""Delay laws: how many environment steps each message travels.

A law is a frozen value; what it must remember between two draws is one integer that its user keeps, 0 at the start of
an episode. `str` of a law is text that `as_delay` reads.
"""

import itertools
import math
import re
from bisect import bisect_right
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from delayrl.errors import DelayRLError

LONGEST = 100_000
"""Steps; what is longer is a mistake, and would fill the memory."""


def whole(steps: Any) -> int:
    """The number as a delay. Raises DelayRLError for what is not a whole number of 0..LONGEST steps."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer):
        raise DelayRLError(f"a delay counts whole environment steps; got {steps!r}")
    if steps < 0:
        raise DelayRLError(f"a delay cannot be negative; got {steps:g}")
    if steps > LONGEST:
        raise DelayRLError(f"a delay of {float(steps):g} steps is longer than we can hold ({LONGEST})")
    return int(steps)


@runtime_checkable
class DelayLaw(Protocol):
    """How long messages travel, in environment steps."""

    @property
    def maximum(self) -> int:
        """The longest delay."""
        ...

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """Travel time of the next message, and the law's memory after it. `memory` is 0 at an episode's start."""
        ...

    def shifted(self, steps: int) -> "DelayLaw":
        """The law of travel times that are longer by `steps`."""
        ...


@dataclass(frozen=True)
class Constant:
    """Every message travels exactly `steps` environment steps (VDPO, §2)."""

    steps: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", whole(self.steps))

    @property
    def maximum(self) -> int:
        """The delay itself."""
        return self.steps

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """Always `steps`."""
        return self.steps, memory

    def shifted(self, steps: int) -> Self:
        """Longer by `steps`."""
        return replace(self, steps=self.steps + steps)

    def __str__(self) -> str:
        return str(self.steps)


@dataclass(frozen=True)
class Choice:
    """Independent draws from a finite distribution.

    Attributes:
        steps: the possible delays.
        probabilities: of each; they sum to 1.
        name: as text, where it was made by one of the functions below.
    """

    steps: tuple[int, ...]
    probabilities: tuple[float, ...]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", tuple(whole(steps) for steps in self.steps))
        object.__setattr__(self, "probabilities", _distribution(self.probabilities))
        if len(self.steps) != len(self.probabilities):
            raise DelayRLError(f"{len(self.steps)} delays need as many probabilities; got {len(self.probabilities)}")

    @property
    def maximum(self) -> int:
        """The longest of them, whatever its probability."""
        return max(self.steps)

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """One of the steps."""
        return self.steps[bisect_right(self._cumulative, random.random())], memory

    def shifted(self, steps: int) -> Self:
        """Longer by `steps`."""
        return replace(self, steps=tuple(s + steps for s in self.steps), name="")

    @cached_property
    def _cumulative(self) -> list[float]:
        return _cumulated(self.probabilities)

    def __str__(self) -> str:
        pairs = zip(self.steps, self.probabilities, strict=True)
        return self.name or "choice:" + ",".join(f"{s}={_text(p)}" for s, p in pairs)


@dataclass(frozen=True)
class Markov:
    """A Markov chain whose states have delays; it moves once for each message.

    Attributes:
        steps: the delay of each state.
        transitions: row i holds the probabilities of the states after state i.
        name: as text, where it was made by one of the functions below.
    """

    steps: tuple[int, ...]
    transitions: tuple[tuple[float, ...], ...]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", tuple(whole(steps) for steps in self.steps))
        _check_states(len(self.steps))
        object.__setattr__(self, "transitions", tuple(_distribution(row) for row in self.transitions))
        if {len(self.transitions), *map(len, self.transitions)} != {len(self.steps)}:
            raise DelayRLError(f"{len(self.steps)} states need a square table of {len(self.steps)} transitions each")

    @property
    def maximum(self) -> int:
        """The longest delay of a state."""
        return max(self.steps)

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """The delay of the next state; the first is drawn from the chain's stationary distribution."""
        state = bisect_right(self._rows[memory], random.random())
        return self.steps[state], state + 1

    def shifted(self, steps: int) -> Self:
        """Longer by `steps`."""
        return replace(self, steps=tuple(s + steps for s in self.steps), name="")

    @cached_property
    def stationary(self) -> tuple[float, ...]:
        """The share of messages in each state in the long run."""
        chain = np.array(self.transitions)
        size = len(chain)
        balance = np.vstack([(chain.T - np.eye(size))[:-1], np.ones(size)])  # the last equation follows from the others
        try:
            start = np.linalg.solve(balance, np.eye(size)[-1])
        except np.linalg.LinAlgError:  # a chain that falls apart has more than one: any of them
            start = np.linalg.lstsq(balance, np.eye(size)[-1], rcond=None)[0]
        return tuple((np.clip(start, 0, None) / np.clip(start, 0, None).sum()).tolist())

    @cached_property
    def _rows(self) -> list[list[float]]:
        return [_cumulated(row) for row in (self.stationary, *self.transitions)]

    def __str__(self) -> str:
        rows = "/".join(",".join(map(_text, row)) for row in self.transitions)
        return self.name or f"markov:{','.join(map(str, self.steps))}:{rows}"


@dataclass(frozen=True)
class Recorded:
    """Measured delays, played from a random place on in each episode, and from the start again after the last."""

    steps: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.steps:
            raise DelayRLError("a recorded delay needs at least one value; it is empty")
        object.__setattr__(self, "steps", tuple(whole(steps) for steps in self.steps))

    @property
    def maximum(self) -> int:
        """The longest that was recorded."""
        return max(self.steps)

    def draw(self, memory: int, random: np.random.Generator) -> tuple[int, int]:
        """The next of them."""
        place = memory % len(self.steps) if memory else int(random.integers(len(self.steps)))
        return self.steps[place], place + 1

    def shifted(self, steps: int) -> Self:
        """Longer by `steps`."""
        return replace(self, steps=tuple(s + steps for s in self.steps))

    def __str__(self) -> str:
        return f"recorded:{','.join(map(str, self.steps))},"


def uniform(low: int, high: int) -> Choice:
    """Each of low..high is equally likely."""
    if not whole(low) <= whole(high):
        raise DelayRLError(f"uniform:LOW:HIGH needs LOW ≤ HIGH; got {low} and {high}")
    count = high - low + 1
    return Choice(tuple(range(low, high + 1)), (1 / count,) * count, name=f"uniform:{low}:{high}")


def poisson(mean: float, maximum: int) -> Choice:
    """Poisson, cut at `maximum`: the probabilities of 0..maximum, scaled to sum to 1."""
    mean = _positive(mean, "the mean of a Poisson delay")
    steps = tuple(range(whole(maximum) + 1))
    log_weights = np.array([k * math.log(mean) - math.lgamma(k + 1) for k in steps])
    return Choice(steps, _scaled(np.exp(log_weights - log_weights.max())), name=f"poisson:{_text(mean)}:{maximum}")


def gamma(mean: float, deviation: float, maximum: int) -> Choice:
    """Gamma of this mean and standard deviation (in steps, not whole), rounded up to whole steps, cut at `maximum`."""
    mean, deviation = _positive(mean, "the mean of a gamma delay"), _positive(deviation, "its standard deviation")
    if not 1e-3 <= deviation / mean <= 1e3:
        raise DelayRLError(
            f"a gamma delay's deviation must be between 1/1000 and 1000 means; got {deviation:g}, {mean:g}"
        )
    shape, scale = (mean / deviation) ** 2, deviation**2 / mean
    edges = [_gamma_below(shape, k / scale) for k in range(whole(maximum) + 1)]
    weights = np.clip(np.diff(edges, prepend=0.0), 0, None)  # rounding errors of the series
    if not weights.sum() > 0:
        raise DelayRLError(f"a gamma delay of mean {mean:g} and deviation {deviation:g} is never below {maximum}")
    return Choice(tuple(range(maximum + 1)), _scaled(weights), name=f"gamma:{_text(mean)}:{_text(deviation)}:{maximum}")


def gilbert_elliott(good: int, bad: int, worsen: float, recover: float) -> Markov:
    """A network in two states: `worsen` and `recover` are the probabilities of leaving the good and the bad one."""
    rows = ((1 - worsen, worsen), (recover, 1 - recover))
    return Markov((good, bad), rows, name=f"gilbert:{good}:{bad}:{_text(worsen)}:{_text(recover)}")


def random_walk(maximum: int, move: float = 2 / 3) -> Markov:
    """A walk on 0..maximum: with probability `move` a step up or down, equally likely; at an end it stays instead."""
    size = whole(maximum) + 1
    _check_states(size)
    chain = np.eye(size) * (1 - move)
    for state, step in itertools.product(range(size), (-1, 1)):
        chain[state, min(max(state + step, 0), maximum)] += move / 2
    name = f"walk:{maximum}" if move == 2 / 3 else f"walk:{maximum}:{_text(move)}"
    return Markov(tuple(range(size)), tuple(map(tuple, chain.tolist())), name=name)


def recorded(path: str | Path, step_seconds: float | None = None, unit: str = "") -> Recorded:
    """Delays from a .npy file, or a text file with one number a line (or the last column of a CSV with a header).

    Args:
        path: the file.
        step_seconds: the length of an environment step, needed where `unit` is a time.
        unit: of the numbers: "" for whole steps, "s" or "ms" for times, which are rounded up.

    Raises:
        DelayRLError: no such file, nothing in it, or anything but finite numbers of at least 0.
    """
    path = Path(path).expanduser()
    try:
        cells = _cells(path)
    except OSError as error:
        raise DelayRLError(f"cannot read the recorded delays {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, UnicodeDecodeError) as error:
        raise DelayRLError(f"{path} cannot be read as recorded delays: {str(error).splitlines()[0]}") from error
    if not cells:
        raise DelayRLError(f"{path} holds no delays: it is empty")
    steps = []
    for place, cell in cells:
        if not is_number(cell):
            raise DelayRLError(f"{path}, {place}: recorded delays must be numbers; got {cell[:40]!r}")
        value = float(cell)
        if not (math.isfinite(value) and value >= 0):
            raise DelayRLError(f"{path}, {place}: recorded delays must be finite and not negative; got {value:g}")
        if not unit and not value.is_integer():
            raise DelayRLError(
                f"{path}, {place}: {value:g} is no whole number; for times write recorded:{path}:ms or :s"
            )
        steps.append(rounded_up(in_steps(value, unit, step_seconds)))
    return Recorded(tuple(steps))


def _cells(path: Path) -> list[tuple[str, str]]:
    """(where, what) of each recorded value, as text."""
    if path.suffix == ".npy":
        array = np.load(path, allow_pickle=False, mmap_mode="r")  # mapped: its header may promise what is not there
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf" or array.ndim > 2:
            raise ValueError("not an array of numbers with one or two axes")
        column = array if array.ndim < 2 else array[:, -1]
        return [(f"entry {i}", repr(value)) for i, value in enumerate(np.atleast_1d(column).astype(float).tolist())]
    lines = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
    cells = [(f"line {i}", line.split(",")[-1].strip().strip('"')) for i, line in lines if line.strip()]
    return cells[1:] if cells and not is_number(cells[0][1]) else cells


def in_steps(number: float, unit: str, step_seconds: float | None) -> float:
    """A number of steps, not whole, from one with a unit: "" (steps), "s" or "ms"."""
    if not unit:
        return number
    if not step_seconds:
        raise DelayRLError(
            "this task does not say how long a step is (it has no `dt`): give the delay in steps, or step_seconds"
        )
    return number * {"s": 1.0, "ms": 1e-3}[unit] / step_seconds


def rounded_up(steps: float) -> int:
    """What arrives between two steps is seen at the later one; a millionth of a step is rounding error."""
    if not math.isfinite(steps):
        raise DelayRLError(f"a delay must be finite; got {steps:g} steps")
    return whole(math.ceil(steps - 1e-6) if steps > 0 else math.floor(steps))


def is_number(text: str) -> bool:
    """Whether it is one (nan and inf too, for which there are better words)."""
    return bool(
        re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", text.strip(), re.IGNORECASE)
    )


MOST_STATES = 1000


def _check_states(count: int) -> None:
    if not 0 < count <= MOST_STATES:
        raise DelayRLError(f"a Markov chain of delays has 1 to {MOST_STATES} states; got {count}")


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


def _cumulated(probabilities: tuple[float, ...]) -> list[float]:
    """For `bisect_right` with a number below 1, which the last entry is, whatever rounding made of the sum."""
    return [*list(itertools.accumulate(probabilities))[:-1], 1.0]


def _gamma_below(shape: float, x: float) -> float:
    """P(X ≤ x) of a gamma distribution of scale 1, by the series of the lower incomplete gamma function."""
    if x <= 0:
        return 0.0
    if x > shape + 40 * math.sqrt(shape) + 100:  # all of it; the series would overflow
        return 1.0
    term = total = 1 / shape
    n = 0
    while term > total * 1e-16:
        n += 1
        term *= x / (shape + n)
        total += term
    return min(1.0, total * math.exp(shape * math.log(x) - x - math.lgamma(shape)))


def _text(number: float) -> str:
    return repr(int(number) if float(number).is_integer() else float(number))
