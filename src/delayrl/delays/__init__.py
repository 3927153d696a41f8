"""How late things are: laws of travel times, channels with arrival rules, and their text form. NumPy alone."""

from delayrl.delays.channels import PAPER_STOCHASTIC_5, Channel, Delay, Rule, as_delay
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
    recorded,
    uniform,
)

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
    "uniform",
]
