"""Protocols: how episodes start and end, what is learned from, and how policies are evaluated."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class Protocol:
    """One way to train and evaluate. docs/concepts.md compares the two that exist."""

    name: str  # as rows and the command line have it
    start_states: Literal["own", "same"] = "own"  # each episode's own, or the one that the run's seed gives
    time_limit: Literal["bootstraps", "terminates"] = "bootstraps"  # what it means for the value of the state after it
    first_action: Literal["agent", "random"] = "agent"  # whose the first action of an episode is, if there is a delay
    last_starts: Literal["kept", "dropped"] = "kept"  # steps too close to an episode's end for a full n-step target
    overrides: Mapping[str, Any] = field(default_factory=dict)  # the agent's hyperparameters that belong to it


CORRECTED = Protocol("corrected")
"""Ours, and the default."""
OFFICIAL = Protocol("official", start_states="same", time_limit="terminates", first_action="random")
"""Habits of VDPO's released code that hold for every agent; the registry adds those of single agents."""
