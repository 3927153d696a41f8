"""Channels: laws of travel times with the rule of arrival; and delays, which are channels of what travels."""

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Literal, get_args

from delayrl.delays import laws
from delayrl.delays.episodes import OURS, PerEpisode, Sum, later
from delayrl.delays.laws import Constant, DelayLaw
from delayrl.delays.own import own_law
from delayrl.errors import DelayRLError

Rule = Literal["newest", "fifo", "raw", "wait"]
"""Which message counts at step t. `newest`: of those that have arrived, the last one sent; older ones that arrive later
are ignored. `fifo`: the same, but no message overtakes another. `raw`: s_{t-d} with d drawn anew at each step, so that
the observation may go back in time. `wait`: each message counts once the longest delay has passed since it was sent."""
NO_DELAY = Constant(0)
RARE = 1e-3
"""Delays that are less probable do not count as those that a policy learns from."""


@dataclass(frozen=True)
class Channel:
    """A law of travel times, and the rule that says which message counts when several are on their way.

    Args:
        law: of `delayrl.delays` or your own; a number is a constant delay in steps.
        rule: "newest", "fifo", "raw" or "wait", as docs/delays.md describes them.

    Raises:
        DelayRLError: a text, a delay that is no whole number of steps from 0 on, another rule.
    """

    law: DelayLaw = NO_DELAY
    rule: Rule = "newest"

    if TYPE_CHECKING:

        def __init__(self, law: DelayLaw | int = ..., rule: Rule = ...) -> None: ...

    def __post_init__(self) -> None:
        if isinstance(self.law, str):
            raise DelayRLError(f"a channel takes a law, not text: write as_delay({self.law!r})")
        if not isinstance(self.law, OURS):
            law = own_law(self.law) if hasattr(self.law, "draw") else Constant(self.law)  # type: ignore[arg-type]
            object.__setattr__(self, "law", law)
        if self.rule not in get_args(Rule):
            raise DelayRLError(f"an arrival rule is one of {', '.join(get_args(Rule))}; got {self.rule!r}")

    @property
    def maximum(self) -> int:
        """The longest delay."""
        return self.law.maximum

    @property
    def minimum(self) -> int:
        """The shortest delay, but for such as come less than once in a thousand messages."""
        return self.maximum if self.rule == "wait" else _shortest(self.law)

    @property
    def constant(self) -> bool:
        """Whether every message counts equally late: it travels as long as every other, or waits for the longest."""
        return isinstance(self.law, Constant) or self.rule == "wait"

    @property
    def steady(self) -> bool:
        """Whether every message of one episode counts equally late."""
        return self.constant or isinstance(self.law, PerEpisode)

    def __str__(self) -> str:
        for name, preset in PRESETS.items():
            if self == preset:
                return name
        return str(self.law) if self.rule == "newest" else f"{self.law}@{self.rule}"


PAPER_STOCHASTIC_5 = Channel(laws.Choice((1, 2, 3, 4, 5), (0.02, 0.02, 0.02, 0.02, 0.92)), "raw")
"""VDPO's stochastic delay of observations, §4.2.3: "Δ = 5 with probability 0.9 and Δ in [1, 5] with probability 0.1",
so 5 with 0.92. The paper does not say how it is drawn. Here each step draws anew, and the age is known."""
PRESETS = {"paper-stochastic-5": PAPER_STOCHASTIC_5}
CHANNELS = ("observation", "action", "reward")


@dataclass(frozen=True)
class Delay:
    """The delays of observations, of actions, and of rewards together with terminations, in environment steps.

    Args:
        observation: a `Channel`, or the law or number of one.
        action: as `observation`.
        reward: as `observation`.

    Raises:
        DelayRLError: as `Channel`, or rewards under the rule `raw`.
    """

    observation: Channel = Channel()
    action: Channel = Channel()
    reward: Channel = Channel()

    if TYPE_CHECKING:
        _Given = Channel | DelayLaw | int

        def __init__(self, observation: _Given = ..., action: _Given = ..., reward: _Given = ...) -> None: ...

    def __post_init__(self) -> None:
        for name in CHANNELS:
            channel = getattr(self, name)
            if not isinstance(channel, Channel):
                channel = Channel(channel)
            if not channel.maximum:
                channel = Channel()  # all ways to write no delay are equal
            object.__setattr__(self, name, channel)
        if self.reward.rule == "raw" and self.reward.maximum:
            raise DelayRLError("rewards arrive as newest, fifo or wait: raw would lose some and repeat others")

    @property
    def maximum(self) -> int:
        """Δ, the longest history that a decision needs: the longest observation delay and the longest action delay."""
        return self.observation.maximum + self.action.maximum

    @property
    def minimum(self) -> int:
        """The least age of observations, which counts the longest delay that actions have in an episode."""
        return self.observation.minimum + (self.action.minimum if self.action.steady else self.action.maximum)

    @property
    def latest(self) -> int:
        """After how many steps all of a step has arrived, overtaken messages and its reward too."""
        return self.action.maximum + max(self.observation.maximum, self.reward.maximum)

    def observed(self) -> "Delay":
        """Move the delay of the actions to the observations, as training does.

        An action that acts D steps later acts on a state that is D steps newer than the one seen with it. In the
        actions' own time the observations are thus late by D more. D may differ between episodes. The replay keeps
        rewards with their steps.

        Raises:
            DelayRLError: the actions have a delay that is random within an episode.
        """
        if not self.action.steady:
            raise DelayRLError(
                f"training takes actions with a constant delay, at least within an episode; got {self.action}. "
                f"Hold early ones back until {self.action.maximum} steps have passed "
                f"(action={self.action.law}@wait), or train on delayrl.wrappers"
            )
        if not self.action.maximum:
            return Delay(self.observation)
        if self.action.constant:
            return Delay(replace(self.observation, law=later(self.observation.law, self.action.maximum)))
        if self.observation.constant:
            return Delay(Channel(later(self.action.law, self.observation.maximum)))
        return Delay(replace(self.observation, law=Sum(self.observation.law, self.action.law)))

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


def _shortest(law: DelayLaw) -> int:
    match law:
        case Constant():
            return law.steps
        case laws.Choice():
            return _first_not_rare(law.steps, law.probabilities)
        case laws.Markov():
            return _first_not_rare(law.steps, law.stationary)
        case laws.Recorded():
            return _first_not_rare(law.steps, [1 / len(law.steps)] * len(law.steps))
        case PerEpisode():
            return _shortest(law.law)
        case Sum():
            return _shortest(law.law) + _shortest(law.lag)
    return 0  # of a user's law it is unknown


def _first_not_rare(steps: Sequence[int], shares: Iterable[float]) -> int:
    """Return the least of some delays, but for those that together are RARE."""
    ordered, each = zip(*sorted(zip(steps, shares, strict=True)), strict=True)
    return next(n for n, share in zip(ordered, accumulate(each), strict=True) if share >= RARE)


def short_label(text: int | str) -> int | str:
    """Replace long lists of numbers in a delay's text by their checksum, for rows and names of folders."""
    if isinstance(text, int):
        return text
    return re.sub(r"[\d,./=e-]{40,}", lambda match: hashlib.sha256(match[0].encode()).hexdigest()[:12], text)
