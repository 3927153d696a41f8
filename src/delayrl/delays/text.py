"""The text form of delays. `as_delay` reads it, and `str` of a law, a channel or a delay writes it.

```
5                       every observation is 5 steps late
80ms, 0.08s             a time, rounded up to whole steps; the task must say how long a step is
uniform:1:5             1 to 5 steps, equally likely
choice:1=0.1,5=0.9      1 step with probability 0.1, 5 with 0.9
poisson:3:8             Poisson of mean 3, cut at 8
gamma:3:1.5:8           gamma of mean 3 and standard deviation 1.5, rounded up to whole steps, cut at 8
gilbert:1:6:0.05:0.3    a network in a good (1 step) or bad state (6); worsens with 0.05, recovers with 0.3
markov:0,5:0.9,0.1/0.5,0.5  a chain of two states with delays 0 and 5, and its transitions row by row
walk:8, walk:8:0.5      a random walk on 0..8 that moves with probability 2/3 (or 0.5)
recorded:trace.csv      measured delays, from a random one on; recorded:trace.csv:ms if they are times
uniform:1:5@fifo        a rule: newest (the default), fifo or raw
2+action=1+reward=3     observations 2 steps late, actions 1, rewards and terminations 3
paper-stochastic-5      VDPO's stochastic delay: 5 with probability 0.9, else uniform on 1..5; rule raw
```
"""

import hashlib
import re
from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal, get_args

from delayrl.delays import laws
from delayrl.delays.laws import DelayLaw
from delayrl.delays.recordings import recorded
from delayrl.delays.units import in_steps, is_number, rounded_up, whole_steps
from delayrl.errors import DelayRLError

Rule = Literal["newest", "fifo", "raw"]
"""Which message counts at step t. `newest`: of those that have arrived, the last one sent; older ones that arrive later
are ignored. `fifo`: the same, but no message overtakes another. `raw`: s_{t-d} with d drawn anew at each step, so that
the observation may go back in time."""
StepSeconds = float | Callable[[], float | None] | None
"""The length of an environment step, or a function that returns it; None if it is unknown."""

CHANNELS = ("observation", "action", "reward")
PRESETS: dict[str, tuple[DelayLaw, Rule]] = {
    # VDPO's §5.3: "Δ = 5 with probability 0.9 and Δ in [1, 5] with probability 0.1", so 5 with 0.92 in all. The paper
    # does not say how it is drawn, and no code was released. Here each step draws anew, and the age is known.
    "paper-stochastic-5": (laws.Choice((1, 2, 3, 4, 5), (0.02, 0.02, 0.02, 0.02, 0.92)), "raw"),
}


def short_label(text: int | str) -> int | str:
    """Replace long lists of numbers in a delay's text by their checksum, for rows and names of folders."""
    if isinstance(text, int):
        return text
    return re.sub(r"[\d,./=e-]{40,}", lambda match: hashlib.sha256(match[0].encode()).hexdigest()[:12], text)


class Parser:
    """Parse the text of one delay. The methods raise DelayRLError if they cannot.

    Args:
        text: the text.
        step_seconds: the length of a step. A function is called at most once, and only if the text holds a time.
    """

    def __init__(self, text: str, step_seconds: StepSeconds = None):
        self._text, self._given_seconds = text, step_seconds

    @cached_property
    def step_seconds(self) -> float | None:
        """The length of a step."""
        return self._given_seconds() if callable(self._given_seconds) else self._given_seconds

    def channels(self) -> dict[str, tuple[DelayLaw, str]]:
        """Return the law and the rule of each channel that the text names."""
        channels: dict[str, tuple[DelayLaw, str]] = {}
        for part in re.split(rf"\+(?=\s*(?:{'|'.join(CHANNELS)})\s*=)", self._text):
            name, separator, rest = part.partition("=")
            name = name.strip()
            if not separator or name not in CHANNELS:
                name, rest = "observation", part
            if name in channels:
                raise DelayRLError(f"the delay {self._text!r} gives two for the {name}s")
            channels[name] = self.channel(rest.strip())
        return channels

    def channel(self, part: str) -> tuple[DelayLaw, str]:
        """Return the law and the rule that a part of the text names."""
        head, separator, rule = part.rpartition("@")
        in_path = part.startswith("recorded:") and rule not in get_args(Rule)
        if not separator or in_path:
            return PRESETS.get(part) or (self._law(part), "newest")
        return PRESETS[head][0] if head in PRESETS else self._law(head), rule

    def _law(self, part: str) -> DelayLaw:
        name, _, rest = part.partition(":")
        if name not in LAWS and not rest:
            return laws.Constant(self.steps(part))
        if name not in LAWS or not rest:
            raise DelayRLError(f"unknown delay {part!r} ({FORMS})")
        return LAWS[name][0](self, rest)

    def values(self, rest: str, *readers: Callable[[str], Any]) -> list[Any]:
        """Split what follows the name of a law at its colons, and read each value with its reader."""
        words = rest.split(":")
        if len(words) != len(readers):
            raise DelayRLError(f"the delay {self._text!r} needs {len(readers)} values where {rest!r} is ({FORMS})")
        return [reader(word) for reader, word in zip(readers, words, strict=True)]

    def real(self, word: str) -> float:
        """Read a number of steps or a time, without rounding."""
        number, unit = self._split(word)
        return in_steps(number, unit, self.step_seconds) if unit else number

    def steps(self, word: str) -> int:
        """Read whole steps, or a time that is rounded up to whole steps."""
        number, unit = self._split(word)
        if unit:
            return rounded_up(in_steps(number, unit, self.step_seconds))
        return whole_steps(int(number) if number.is_integer() else number)

    def probability(self, word: str) -> float:
        """Read a number that has no unit."""
        number, unit = self._split(word)
        if unit:
            raise DelayRLError(f"a probability has no unit; got {word!r} in the delay {self._text!r}")
        return number

    def _split(self, word: str) -> tuple[float, str]:
        """Split a word into its number and its unit."""
        match = re.fullmatch(r"([+-]?[\d.]+(?:e[+-]?\d+)?)(s|ms)?", word.strip())
        if not match or not is_number(match[1]):
            raise DelayRLError(f"{word!r} in the delay {self._text!r} is not a number ({FORMS})")
        return float(match[1]), match[2] or ""


def _uniform(parser: Parser, rest: str) -> DelayLaw:
    return laws.uniform(*parser.values(rest, parser.steps, parser.steps))


def _choice(parser: Parser, rest: str) -> DelayLaw:
    pairs = [pair.partition("=") for pair in rest.split(",")]
    return laws.Choice(tuple(parser.steps(s) for s, _, _ in pairs), tuple(parser.probability(p) for _, _, p in pairs))


def _poisson(parser: Parser, rest: str) -> DelayLaw:
    return laws.poisson(*parser.values(rest, parser.real, parser.steps))


def _gamma(parser: Parser, rest: str) -> DelayLaw:
    return laws.gamma(*parser.values(rest, parser.real, parser.real, parser.steps))


def _gilbert(parser: Parser, rest: str) -> DelayLaw:
    steps, probability = parser.steps, parser.probability
    return laws.gilbert_elliott(*parser.values(rest, steps, steps, probability, probability))


def _walk(parser: Parser, rest: str) -> DelayLaw:
    if ":" in rest:
        return laws.random_walk(*parser.values(rest, parser.steps, parser.probability))
    return laws.random_walk(parser.steps(rest))


def _markov(parser: Parser, rest: str) -> DelayLaw:
    states, table = parser.values(rest, str, str)
    rows = tuple(tuple(parser.probability(word) for word in row.split(",")) for row in table.split("/"))
    return laws.Markov(tuple(parser.steps(word) for word in states.split(",")), rows)


def _recorded(parser: Parser, rest: str) -> DelayLaw:
    if re.fullmatch(r"(\d{1,9},)+(\d{1,9})?", rest):
        return laws.Recorded(tuple(int(word) for word in rest.split(",") if word))
    path, separator, unit = rest.rpartition(":")
    if separator and unit in ("s", "ms"):
        return recorded(path, parser.step_seconds, unit)
    return recorded(rest)


LAWS: dict[str, tuple[Callable[[Parser, str], DelayLaw], str]] = {
    "uniform": (_uniform, "uniform:1:5"),
    "choice": (_choice, "choice:1=0.1,5=0.9"),
    "poisson": (_poisson, "poisson:MEAN:MAX"),
    "gamma": (_gamma, "gamma:MEAN:DEVIATION:MAX"),
    "gilbert": (_gilbert, "gilbert:GOOD:BAD:WORSEN:RECOVER"),
    "walk": (_walk, "walk:MAX"),
    "markov": (_markov, "markov:0,5:0.9,0.1/0.5,0.5"),
    "recorded": (_recorded, "recorded:FILE"),
}
"""By name: the function that parses what follows the name and a colon, and the form that error messages show."""
_EXAMPLES = ", ".join(["5", "80ms", *(form for _, form in LAWS.values()), *PRESETS])
FORMS = f"a delay is {_EXAMPLES}; then @newest, @fifo or @raw"
