"""Delays that differ between episodes: drawn once in each, or left open by a sensor that runs on its own clock."""

import math
from dataclasses import dataclass, replace

import numpy as np

from delayrl.delays import laws
from delayrl.delays.laws import Constant, DelayLaw, uniform
from delayrl.delays.own import OwnLaw, own_law
from delayrl.delays.recordings import next_whole
from delayrl.errors import DelayRLError


@dataclass(frozen=True)
class PerEpisode:
    """Draw a delay from `law` at the start of an episode, and keep it until the end: domain randomisation.

    `episode:2:4` is the text of `PerEpisode(uniform(2, 4))`. In the other laws every message draws its own delay.
    """

    law: DelayLaw

    def __post_init__(self) -> None:
        if not isinstance(self.law, OURS):
            object.__setattr__(self, "law", own_law(self.law))

    @property
    def maximum(self) -> int:
        """The longest delay of any episode."""
        return self.law.maximum

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Return the delay of the episode; the state is 1 plus it."""
        travel = state - 1 if state else self.law.draw(0, random)[0]
        return travel, travel + 1

    def __str__(self) -> str:
        return f"episode:{str(self.law).removeprefix('uniform:')}"


@dataclass(frozen=True)
class Sum:
    """Add a delay that an episode keeps to that of each message. `Delay.observed` makes it; it has no text."""

    law: DelayLaw
    lag: DelayLaw  # a constant one, or one of an episode

    @property
    def maximum(self) -> int:
        """The longest delay of any message."""
        return self.law.maximum + self.lag.maximum

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        """Draw both; the state holds those of both laws."""
        if isinstance(self.lag, Constant):
            travel, state = self.law.draw(state, random)
            return travel + self.lag.steps, state
        states = self.lag.maximum + 2  # 0 before the first message, then 1 plus a delay
        state, of_lag = divmod(state, states)
        lag, of_lag = self.lag.draw(of_lag, random)
        travel, state = self.law.draw(state, random)
        return travel + lag, state * states + of_lag


OURS = (Constant, laws.Choice, laws.Markov, laws.Recorded, PerEpisode, Sum, OwnLaw)
"""All classes of laws. Others are a user's, which `own_law` makes one of these."""


def later(law: DelayLaw, steps: int) -> DelayLaw:
    """Return the law whose travel times are longer by `steps`."""
    match law:
        case Constant():
            return Constant(law.steps + steps)
        case laws.Choice() | laws.Markov():
            return replace(law, steps=tuple(s + steps for s in law.steps), name="")
        case laws.Recorded():
            return replace(law, steps=tuple(s + steps for s in law.steps))
        case PerEpisode():
            return PerEpisode(later(law.law, steps))
    return Sum(law, Constant(steps))


def any_phase(shortest: float, longest: float, period: float = 1.0) -> tuple[int, int]:
    """Return the shortest and the longest age of an observation whose sensor is not in step with the control loop.

    An observation is made at any time between two decisions, and is used until the next has arrived. At a decision the
    newest was therefore made between `shortest` and `longest + period` ago. Its age counts
    from the decision nearest to that (`delayrl.deploy.Controller`), so it is rounded to the nearest whole step.

    Args:
        shortest: the least travel time, in steps, which need not be whole.
        longest: the largest travel time.
        period: of the sensor, in steps.

    Raises:
        DelayRLError: a negative travel time, or one that is not finite.
    """
    if not 0 <= shortest <= longest < math.inf:
        raise DelayRLError(f"a delay and its jitter are finite and not negative; got {shortest:g} to {longest:g} steps")
    # half a step is rounded towards the younger age
    return max(0, next_whole(shortest - 0.5)), next_whole(longest + period - 0.5)


def unsynchronised(delay: float, jitter: float = 0.0) -> DelayLaw:
    """Make the law of a sensor that is not in step with the control loop: `80ms~`, or `80ms~15ms` with a jitter.

    Without jitter all observations of an episode have the same age, which depends on how the two clocks happen to lie.
    With it, ages differ from message to message.

    Args:
        delay: the shortest travel time, in steps, which need not be whole.
        jitter: how much longer a message may travel, in steps. Add how late a decision of the control loop may come,
            and how much longer than a step the sensor's period is.
    """
    law = uniform(*any_phase(delay, delay + jitter))
    return law if jitter else PerEpisode(law)
