"""Protocols: how episodes start and end, which steps are learned from, and how policies are evaluated."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class Protocol:
    """One way to train and evaluate. docs/concepts.md compares the two protocols."""

    name: str  # as in result rows and on the command line
    start_states: Literal["own", "same"] = "own"  # a new one per episode, or always the one that the run's seed gives
    time_limit: Literal["bootstraps", "terminates"] = "bootstraps"  # whether targets keep the next state's value
    first_action: Literal["agent", "random"] = "agent"  # who chooses an episode's first action under a delay
    last_starts: Literal["kept", "dropped"] = "kept"  # steps too close to an episode's end for a full n-step target
    overrides: Mapping[str, Any] = field(default_factory=dict)  # hyperparameters of the agent that it sets


CORRECTED = Protocol("corrected")
"""The default."""
OFFICIAL = Protocol("official", start_states="same", time_limit="terminates", first_action="random")
"""Conventions of VDPO's released code that apply to every agent; the registry adds those of individual agents."""
