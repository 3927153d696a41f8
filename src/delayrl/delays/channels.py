"""Channels: a law of travel times, and which message counts when several are on their way; and delays as text.

A `Channel` is a law with an arrival rule, a `Delay` is a channel for each of observations, actions and rewards. All of
them can be written as text, and `str` gives the text back:

    5                       every observation is 5 steps late
    80ms, 0.08s             the same in time, where the task says how long a step is: rounded up to whole steps
    uniform:1:5             1 to 5 steps, equally likely
    choice:1=0.1,5=0.9      1 step with probability 0.1, 5 with 0.9
    poisson:3:8             Poisson of mean 3, cut at 8
    gamma:3:1.5:8           gamma of mean 3 and standard deviation 1.5, rounded up to whole steps, cut at 8
    gilbert:1:6:0.05:0.3    a network that is good (1 step) or bad (6): it worsens with 0.05, recovers with 0.3
    markov:0,5:0.9,0.1/0.5,0.5  a chain of two states with delays 0 and 5, and its transitions row by row
    walk:8, walk:8:0.5      a random walk on 0..8 that moves with probability 2/3 (or 0.5)
    recorded:trace.csv      measured delays, from a random place on; recorded:trace.csv:ms where they are times
    uniform:1:5@fifo        a rule: newest (the default), fifo or raw
    2+action=1+reward=3     observations 2 steps late, actions 1, rewards and terminations 3
    paper-stochastic-5      VDPO's stochastic delay: 5 with probability 0.9, else uniform on 1..5; rule raw
"""

import hashlib
import re
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from delayrl.delays.laws import (
    Choice,
    Constant,
    DelayLaw,
    Markov,
    Recorded,
    gamma,
    gilbert_elliott,
    in_steps,
    is_number,
    poisson,
    random_walk,
    recorded,
    rounded_up,
    uniform,
    whole,
)
from delayrl.errors import DelayRLError

Rule = Literal["newest", "fifo", "raw"]
"""What an actor sees at step t. `newest`: of what has arrived, what was made last; what it overtook is dropped. `fifo`:
the same, but nothing overtakes. `raw`: s_{t-d} with d drawn afresh at each step, so that it may go back in time."""


NONE = Constant(0)


@dataclass(frozen=True)
class Channel:
    """A law, and which message counts when several are on their way."""

    law: DelayLaw = NONE
    rule: Rule = "newest"

    def __post_init__(self) -> None:
        if isinstance(self.law, str):
            raise DelayRLError(f"a text may name a rule too: write as_delay({self.law!r}), or Delay({self.law!r})")
        if not isinstance(self.law, DelayLaw):
            object.__setattr__(self, "law", Constant(self.law))
        if self.rule not in get_args(Rule):
            raise DelayRLError(f"an arrival rule is one of {', '.join(get_args(Rule))}; got {self.rule!r}")

    @property
    def maximum(self) -> int:
        """The longest delay."""
        return self.law.maximum

    @property
    def constant(self) -> bool:
        """Whether everything travels equally long."""
        return isinstance(self.law, Constant)

    def __str__(self) -> str:
        for name, preset in PRESETS.items():
            if self == preset:
                return name
        return str(self.law) if self.rule == "newest" else f"{self.law}@{self.rule}"


PAPER_STOCHASTIC_5 = Channel(Choice((1, 2, 3, 4, 5), (0.02, 0.02, 0.02, 0.02, 0.92)), "raw")
"""VDPO's §5.3: "Δ = 5 with probability 0.9 and Δ in [1, 5] with probability 0.1", so 5 with 0.92 in all. How it is
drawn is not said there, and no code was released; here afresh at each step, with the age known."""
PRESETS = {"paper-stochastic-5": PAPER_STOCHASTIC_5}


@dataclass(frozen=True)
class Delay:
    """What is late: observations, actions, rewards (with which terminations travel)."""

    observation: Channel = Channel()
    action: Channel = Channel()
    reward: Channel = Channel()

    def __post_init__(self) -> None:
        for name in ("observation", "action", "reward"):
            channel = getattr(self, name)
            if isinstance(channel, str):
                channel = _parse_channel(channel, channel, None)
            elif not isinstance(channel, Channel):
                channel = Channel(channel)
            # no delay is no delay, however it is written
            object.__setattr__(self, name, channel if channel.maximum else Channel())
        if self.reward.rule == "raw" and self.reward.maximum:
            raise DelayRLError("rewards arrive as newest or fifo: with raw some would be lost and others come twice")

    @property
    def maximum(self) -> int:
        """Δ, the longest history that a decision needs: the longest observation delay and the longest action delay."""
        return self.observation.maximum + self.action.maximum

    def observed(self) -> "Delay":
        """The same with the delay of the actions moved to the observations: what is trained on.

        An action that acts D steps later acts on a state that is D steps newer than the one seen with it: in the
        actions' own time the observations are late by D more. Rewards are kept with their steps in the replay.

        Raises:
            DelayRLError: for actions whose delay is random.
        """
        if not self.action.constant:
            raise DelayRLError(
                f"training takes actions with a constant delay; got {self.action}. Hold early ones back until "
                f"{self.action.maximum} steps have passed (action={self.action.maximum}), or train on delayrl.wrappers"
            )
        law = self.observation.law.shifted(self.action.maximum) if self.action.maximum else self.observation.law
        return Delay(replace(self.observation, law=law))

    def acted(self) -> "Delay":
        """The same with rewards at once: what is evaluated, and deployed."""
        return replace(self, reward=Channel())

    def plain(self) -> int | str:
        """A number for a constant delay of the observations alone, else text; `as_delay` reads both."""
        text = str(self)
        return int(text) if text.isdecimal() else text

    def label(self) -> int | str:
        """`plain`, with long lists of numbers shortened to its checksum: for rows and names of folders."""
        plain = self.plain()
        if isinstance(plain, int):
            return plain
        return re.sub(r"[\d,./=e-]{40,}", lambda m: hashlib.sha256(m[0].encode()).hexdigest()[:12], plain)

    def __str__(self) -> str:
        parts = [str(self.observation)]
        parts += [f"{name}={c}" for name in ("action", "reward") if (c := getattr(self, name)).maximum]
        return "+".join(parts)


def as_delay(delay: "float | str | DelayLaw | Channel | Delay", step_seconds: float | None = None) -> Delay:
    """A delay from a number of steps, a text, a law (of the observations), a channel, or a delay.

    Args:
        delay: what is given.
        step_seconds: the length of an environment step, for texts with times.

    Raises:
        DelayRLError: for a negative or fractional number, a text that does not parse, or anything that is no delay.
    """
    if isinstance(delay, Delay):
        return delay
    if isinstance(delay, Channel):
        return Delay(delay)
    if isinstance(delay, str):
        return _parse(delay, step_seconds)
    if isinstance(delay, float) and delay.is_integer():
        delay = int(delay)
    return Delay(Channel(delay if isinstance(delay, DelayLaw) else Constant(delay)))  # type: ignore[arg-type]


def _parse(text: str, step_seconds: float | None) -> Delay:
    channels: dict[str, Channel] = {}
    for part in re.split(r"\+(?=\s*(?:observation|action|reward)\s*=)", text):
        part = part.strip()
        name, found, rest = (word.strip() for word in part.partition("="))
        if not found or name not in ("observation", "action", "reward"):
            name, rest = "observation", part
        if name in channels:
            raise DelayRLError(f"the delay {text!r} gives two for the {name}s")
        channels[name] = _parse_channel(rest, text, step_seconds)
    return Delay(**channels)


def _parse_channel(part: str, text: str, step_seconds: float | None) -> Channel:
    head, found, rule = part.rpartition("@")
    if not found or (part.startswith("recorded:") and rule not in get_args(Rule)):  # a path may have an @
        head, found, rule = part, "", "newest"
    if head in PRESETS:
        return replace(PRESETS[head], rule=rule) if found else PRESETS[head]  # type: ignore[arg-type]
    kind, *words = head.split(":")

    def real(word: str) -> float:
        number, unit = _split(word, text)
        return in_steps(number, unit, step_seconds)

    def steps(word: str) -> int:
        number, unit = _split(word, text)
        if unit:
            return rounded_up(in_steps(number, unit, step_seconds))
        return whole(int(number) if number.is_integer() else number)

    def probability(word: str) -> float:
        number, unit = _split(word, text)
        if unit:
            raise DelayRLError(f"a probability has no unit; got {word!r} in the delay {text!r}")
        return number

    shapes: dict[
        str, tuple[Any, tuple[Any, ...], int]
    ] = {  # words that a law takes, the last `optional` of which may be left out
        "uniform": (uniform, (steps, steps), 0),
        "poisson": (poisson, (real, steps), 0),
        "gamma": (gamma, (real, real, steps), 0),
        "gilbert": (gilbert_elliott, (steps, steps, probability, probability), 0),
        "walk": (random_walk, (steps, probability), 1),
    }
    law: DelayLaw
    if kind in shapes:
        make, readers, optional = shapes[kind]
        if not len(readers) - optional <= len(words) <= len(readers):
            raise DelayRLError(f"{kind} takes {len(readers)} numbers divided by colons; got {head!r} ({_FORMS})")
        law = make(*(read(word) for read, word in zip(readers, words, strict=False)))
    elif kind == "choice" and len(words) == 1:
        pairs = [pair.partition("=") for pair in words[0].split(",")]
        law = Choice(tuple(steps(s) for s, _, _ in pairs), tuple(probability(p) for _, _, p in pairs))
    elif kind == "markov" and len(words) == 2:
        rows = tuple(tuple(probability(p) for p in row.split(",")) for row in words[1].split("/"))
        law = Markov(tuple(steps(s) for s in words[0].split(",")), rows)
    elif kind == "recorded" and words:
        file = ":".join(words)
        if re.fullmatch(r"(\d{1,9},)+(\d{1,9})?", file):
            law = Recorded(tuple(int(word) for word in file.split(",") if word))
        else:
            unit = words[-1] if len(words) > 1 and words[-1] in ("s", "ms") else ""
            law = recorded(file.removesuffix(f":{unit}") if unit else file, step_seconds, unit)
    elif words or kind in ("choice", "markov", "recorded", *shapes):
        raise DelayRLError(f"unknown delay {head!r} ({_FORMS})")
    else:
        law = Constant(steps(head))
    return Channel(law, rule)  # type: ignore[arg-type]


_FORMS = (
    "a delay is 5, 80ms, uniform:1:5, choice:1=0.1,5=0.9, poisson:MEAN:MAX, gamma:MEAN:DEVIATION:MAX, "
    "gilbert:GOOD:BAD:WORSEN:RECOVER, walk:MAX, markov:0,5:0.9,0.1/0.5,0.5, recorded:FILE, "
    f"{', '.join(PRESETS)}; then @newest, @fifo or @raw"
)


def _split(word: str, text: str) -> tuple[float, str]:
    """A number and its unit."""
    match = re.fullmatch(r"([+-]?[\d.]+(?:e[+-]?\d+)?)(s|ms)?", word.strip())
    if not match or not is_number(match[1]):
        raise DelayRLError(f"{word!r} in the delay {text!r} is no number ({_FORMS})")
    return float(match[1]), match[2] or ""
