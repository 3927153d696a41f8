"""Channels and delays: which message counts on each of the three ways, and the delays of all three together."""

from dataclasses import dataclass, replace
from typing import get_args

from delayrl.delays.laws import Constant, DelayLaw
from delayrl.delays.text import CHANNELS, PRESETS, Parser, Rule, StepSeconds, short_label
from delayrl.errors import DelayRLError

NO_DELAY = Constant(0)


@dataclass(frozen=True)
class Channel:
    """A law of travel times, and the rule that says which message counts when several are on their way."""

    law: DelayLaw = NO_DELAY
    rule: Rule = "newest"

    def __post_init__(self) -> None:
        if isinstance(self.law, str):
            raise DelayRLError(f"a channel takes a law, not text: write as_delay({self.law!r}) or Delay({self.law!r})")
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
        """Whether every message travels equally long."""
        return isinstance(self.law, Constant)

    def __str__(self) -> str:
        for name, preset in PRESETS.items():
            if (self.law, self.rule) == preset:
                return name
        return str(self.law) if self.rule == "newest" else f"{self.law}@{self.rule}"


PAPER_STOCHASTIC_5 = Channel(*PRESETS["paper-stochastic-5"])
"""VDPO's stochastic delay of observations."""


@dataclass(frozen=True)
class Delay:
    """The delays of observations, of actions, and of rewards together with terminations."""

    observation: Channel = Channel()
    action: Channel = Channel()
    reward: Channel = Channel()

    def __post_init__(self) -> None:
        for name in CHANNELS:
            channel = getattr(self, name)
            if isinstance(channel, str):
                channel = _channel(*Parser(channel).channel(channel))
            elif not isinstance(channel, Channel):
                channel = Channel(channel)
            if not channel.maximum:
                channel = Channel()  # all ways to write no delay are equal
            object.__setattr__(self, name, channel)
        if self.reward.rule == "raw" and self.reward.maximum:
            raise DelayRLError("rewards arrive as newest or fifo: with raw some would be lost and others come twice")

    @property
    def maximum(self) -> int:
        """Δ, the longest history that a decision needs: the longest observation delay and the longest action delay."""
        return self.observation.maximum + self.action.maximum

    def observed(self) -> "Delay":
        """Move the delay of the actions to the observations, as training does.

        An action that acts D steps later acts on a state that is D steps newer than the one seen with it. In the
        actions' own time the observations are thus late by D more. The replay keeps rewards with their steps.

        Raises:
            DelayRLError: the actions have a random delay.
        """
        if not self.action.constant:
            raise DelayRLError(
                f"training takes actions with a constant delay; got {self.action}. Hold early ones back until "
                f"{self.action.maximum} steps have passed (action={self.action.maximum}), or train on delayrl.wrappers"
            )
        if not self.action.maximum:
            return Delay(self.observation)
        return Delay(replace(self.observation, law=self.observation.law.shifted(self.action.maximum)))

    def acted(self) -> "Delay":
        """Remove the delay of the rewards, as evaluation and deployment do."""
        return replace(self, reward=Channel())

    def plain(self) -> int | str:
        """Return a number for a constant delay of the observations alone, else a text. `as_delay` reads both."""
        text = str(self)
        return int(text) if text.isdecimal() else text

    def label(self) -> int | str:
        """Return `plain` with long lists of numbers replaced by their checksum, for rows and names of folders."""
        return short_label(self.plain())

    def __str__(self) -> str:
        parts = [str(self.observation)]
        if self.action.maximum:
            parts.append(f"action={self.action}")
        if self.reward.maximum:
            parts.append(f"reward={self.reward}")
        return "+".join(parts)


def as_delay(delay: float | str | DelayLaw | Channel | Delay, step_seconds: StepSeconds = None) -> Delay:
    """Convert steps, a text, a law or a channel of the observations to a `Delay`.

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
        return Delay(**{name: _channel(*parsed) for name, parsed in Parser(delay, step_seconds).channels().items()})
    if isinstance(delay, float) and delay.is_integer():
        delay = int(delay)
    return Delay(Channel(delay))  # type: ignore[arg-type]


def _channel(law: DelayLaw, rule: str) -> Channel:
    return Channel(law, rule)  # type: ignore[arg-type]  # Channel checks the rule
