"""Laws of travel times, channels with arrival rules, and the text form of both. Needs NumPy alone."""

from delayrl.delays.channels import PAPER_STOCHASTIC_5, Channel, Delay, as_delay
from delayrl.delays.laws import (
    Choice,
    Constant,
    DelayLaw,
    Markov,
    Recorded,
    gamma,
    gilbert_elliott,
    poisson,
    random_walk,
    uniform,
)
from delayrl.delays.recordings import recorded
from delayrl.delays.text import Rule, short_label

__all__ = [
    "PAPER_STOCHASTIC_5",
    "Channel",
    "Choice",
    "Constant",
    "Delay",
    "DelayLaw",
    "Markov",
    "Recorded",
    "Rule",
    "as_delay",
    "gamma",
    "gilbert_elliott",
    "poisson",
    "random_walk",
    "recorded",
    "short_label",
    "uniform",
]
