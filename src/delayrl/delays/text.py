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
episode:2:4             2 to 4 steps, the same in all of an episode; episode:LAW draws it from any of these laws
80ms~, 80ms~15ms        80 ms (to 95 ms), from a sensor at any phase of the control loop: 2 or 3 steps of 40 ms
walk:8, walk:8:0.5      a random walk on 0..8 that moves with probability 2/3 (or 0.5)
recorded:trace.csv      measured delays, from a random one on; recorded:trace.csv:ms if they are times
my_laws:Burst(rate=0.1) a law of your own, as module:Class; or of an installed package, by the name of an entry point
uniform:1:5@fifo        a rule: newest (the default), fifo, raw or wait
2+action=1+reward=3     observations 2 steps late, actions 1, rewards and terminations 3
paper-stochastic-5      VDPO's stochastic delay: 5 with probability 0.9, else uniform on 1..5; rule raw
```
"""

import re
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

from delayrl.delays import laws
from delayrl.delays.channels import CHANNELS, PRESETS, Channel, Delay, Rule
from delayrl.delays.episodes import PerEpisode, unsynchronised
from delayrl.delays.laws import Constant, DelayLaw, whole_steps
from delayrl.delays.own import find_law
from delayrl.delays.recordings import NUMBER, in_steps, recorded, rounded_up
from delayrl.errors import DelayRLError, did_you_mean, near_names

StepSeconds = float | Callable[[], float | None] | None
"""The length of an environment step, or a function that returns it; None if it is unknown."""
DelayLike = float | str | DelayLaw | Channel | Delay
"""Steps, a text, a law (yours too) or a channel of the observations, or a delay."""
FORMS = (
    "a delay is 5, 80ms, uniform:1:5, choice:1=0.1,5=0.9, poisson:MEAN:MAX, gamma:MEAN:DEVIATION:MAX, "
    "gilbert:GOOD:BAD:WORSEN:RECOVER, walk:MAX, markov:0,5:0.9,0.1/0.5,0.5, recorded:FILE, episode:2:4, 80ms~, "
    "paper-stochastic-5, or MODULE:CLASS(ARGUMENT=VALUE); then @newest, @fifo, @raw or @wait"
)
LAWS = ("uniform", "choice", "poisson", "gamma", "gilbert", "walk", "markov", "recorded", "episode")


def as_delay(delay: DelayLike, step_seconds: StepSeconds = None) -> Delay:
    """Convert what can stand for a delay to a `Delay`.

    Args:
        delay: the value to convert; a `Delay` is returned as it is.
        step_seconds: the length of an environment step, for texts with times. A function that returns it is called
            only if the text holds a time.

    Raises:
        DelayRLError: a negative or fractional number, a text that does not parse, or a value of another type.
    """
    if isinstance(delay, Delay):
        return delay
    if isinstance(delay, Channel):
        return Delay(delay)
    if isinstance(delay, str):
        return Delay(**DelayParser(delay, step_seconds).channels())
    if isinstance(delay, float) and delay.is_integer():
        delay = int(delay)
    return Delay(Channel(delay))  # type: ignore[arg-type]


def stored_delay(text: int | str, folder: Path) -> Delay:
    """Return the delay of a run folder, as its configuration has it.

    A law that the folder has no name for has its maximum, and cannot be drawn from.

    Raises:
        DelayRLError: no text of a delay; or the folder names code that it may not name (`own.find_law`).
    """
    return Delay(**DelayParser(str(text), folder=folder).channels())


class DelayParser:
    """Parse the text of one delay. The methods raise DelayRLError if they cannot."""

    def __init__(self, text: str, step_seconds: StepSeconds = None, folder: Path | None = None):
        self._text, self._given_seconds, self._folder = text, step_seconds, folder
        self._read: dict[str, list[str]] = {}  # the travel times of one law, by their units

    @cached_property
    def step_seconds(self) -> float | None:
        """The length of a step."""
        return self._given_seconds() if callable(self._given_seconds) else self._given_seconds

    def channels(self) -> dict[str, Channel]:
        """Return each channel that the text names."""
        channels: dict[str, Channel] = {}
        if unknown := {*re.findall(r"\+\s*([a-z_]+)\s*=", re.split(r"\(|recorded:", self._text)[0])} - {*CHANNELS}:
            raise DelayRLError(f"{self._text!r} delays {min(unknown)}; it may delay {', '.join(CHANNELS)}")
        for part in re.split(rf"\+(?=\s*(?:{'|'.join(CHANNELS)})\s*=)", self._text):
            name, separator, rest = part.partition("=")
            name = name.strip()
            if not separator or name not in CHANNELS:
                name, rest = "observation", part
            if name in channels:
                raise DelayRLError(f"the delay {self._text!r} gives two for the {name}s")
            channels[name] = self.channel(rest.strip())
        return channels

    def channel(self, part: str) -> Channel:
        """Return the channel that a part of the text describes."""
        head, separator, rule = part.rpartition("@")
        in_path = re.match("(episode:)*recorded:", part) and rule not in get_args(Rule)
        if not separator or in_path or ")" in rule:
            return PRESETS.get(part) or Channel(self._in_one_unit(part))
        law = PRESETS[head].law if head in PRESETS else self._in_one_unit(head)
        return Channel(law, rule)  # type: ignore[arg-type]  # Channel checks the rule

    def _in_one_unit(self, part: str) -> DelayLaw:
        """Return the law that a part of the text describes, if all its travel times are steps or all are times."""
        self._read = dict[str, list[str]]()
        law = self.law(part)
        if bare := self._read.pop("", []) if len(self._read) > 1 else []:
            raise DelayRLError(f"{part!r} mixes steps and times: {bare[0]!r} has no unit, as in {bare[0]}ms")
        return law

    def law(self, part: str) -> DelayLaw:
        """Return the law that a part of the text describes."""
        name, separator, rest = part.partition(":")
        if not separator and name in LAWS:
            raise DelayRLError(f"the law {name!r} takes values after a colon ({FORMS})")
        if name not in LAWS and re.match(r"[^\W\d]|<", part) and (own := find_law(part, self._folder)):
            return own
        if not separator and "~" in part:
            delay, _, jitter = part.partition("~")
            return unsynchronised(self.real(delay), self.real(jitter or "0"))
        if not separator:
            return Constant(self.steps(part))
        match name:
            case "uniform":
                return laws.uniform(*self.values(rest, self.steps, self.steps))
            case "choice":
                pairs = [pair.partition("=") for pair in rest.split(",")]
                steps, probabilities = [self.steps(s) for s, _, _ in pairs], [self.probability(p) for _, _, p in pairs]
                return laws.Choice(tuple(steps), tuple(probabilities))
            case "poisson":
                return laws.poisson(*self.values(rest, self.real, self.steps))
            case "gamma":
                return laws.gamma(*self.values(rest, self.real, self.real, self.steps))
            case "gilbert":
                readers = self.steps, self.steps, self.probability, self.probability
                return laws.gilbert_elliott(*self.values(rest, *readers))
            case "walk" if ":" in rest:
                return laws.random_walk(*self.values(rest, self.steps, self.probability))
            case "walk":
                return laws.random_walk(self.steps(rest))
            case "markov":
                states, table = self.values(rest, str, str)
                rows = tuple(tuple(map(self.probability, row.split(","))) for row in table.split("/"))
                return laws.Markov(tuple(map(self.steps, states.split(","))), rows)
            case "episode":  # with two numbers, of a uniform law
                return PerEpisode(self.law(f"uniform:{rest}" if re.match(r"[\d.+-][^:]*:", rest) else rest))
            case "recorded" if re.fullmatch(r"(\d{1,9},)+(\d{1,9})?", rest):
                return laws.Recorded(tuple(int(word) for word in rest.split(",") if word))
            case "recorded" if self._folder is None:  # a run folder holds the numbers, and may come from elsewhere
                path, _, unit = rest.rpartition(":")
                timed = path and unit in ("s", "ms", "us", "ns")  # `recorded` says which units it takes
                return recorded(path, self.step_seconds, unit) if timed else recorded(rest)
        near = near_names(name, [*LAWS, *PRESETS]) if name not in LAWS else []
        raise DelayRLError(f"unknown delay {part!r}{did_you_mean(near, FORMS)}")

    def values(self, rest: str, *readers: Callable[[str], Any]) -> list[Any]:
        """Split what follows the name of a law at its colons, and read each value with its reader."""
        words = rest.split(":")
        if len(words) != len(readers):
            raise DelayRLError(f"{self._text!r} takes {len(readers)} values between colons; got {rest!r} ({FORMS})")
        return [reader(word) for reader, word in zip(readers, words, strict=True)]

    def real(self, word: str) -> float:
        """Read a number of steps or a time, without rounding."""
        number, unit = self._travel_time(word)
        return in_steps(number, unit, self.step_seconds) if unit else number

    def steps(self, word: str) -> int:
        """Read whole steps, or a time that is rounded up to whole steps."""
        number, unit = self._travel_time(word)
        if unit:
            return rounded_up(in_steps(number, unit, self.step_seconds))
        return whole_steps(int(number) if number.is_integer() else number)

    def probability(self, word: str) -> float:
        """Read a number that has no unit."""
        number, unit = self._split(word)
        if unit:
            raise DelayRLError(f"a probability has no unit; got {word!r} in the delay {self._text!r}")
        return number

    def _travel_time(self, word: str) -> tuple[float, str]:
        """Split a travel time into its number and its unit, and remember it: 0 needs no unit."""
        number, unit = self._split(word)
        if number:
            self._read.setdefault(unit, []).append(word)
        return number, unit

    def _split(self, word: str) -> tuple[float, str]:
        """Split a word into its number and its unit."""
        match = re.fullmatch(rf"({NUMBER})\s*(s|ms)?", word.strip())
        if not match:
            raise DelayRLError(f"{word!r} in the delay {self._text!r} is not a number ({FORMS})")
        return float(match[1]), match[2] or ""
