"""Protocols: how episodes start and end, what is learned from, and how policies are evaluated."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class Protocol:
    """One way to train and evaluate. docs/concepts.md compares the two that exist.

    Attributes:
        name: as rows and the command line have it.
        start_states: of training and evaluation episodes: each its own, or the one that the run's seed gives.
        time_limit: whether the value of the state after it is bootstrapped, or it counts as a termination.
        first_action: of an episode, if there is a delay: the agent's, or a uniformly random one.
        last_starts: whether the last steps of an episode, too close to its end for a full n-step target, are learned
            from or dropped.
        overrides: hyperparameters of the agent that belong to the protocol.
    """

    name: str
    start_states: Literal["own", "same"] = "own"
    time_limit: Literal["bootstraps", "terminates"] = "bootstraps"
    first_action: Literal["agent", "random"] = "agent"
    last_starts: Literal["kept", "dropped"] = "kept"
    overrides: Mapping[str, Any] = field(default_factory=dict)


CORRECTED = Protocol("corrected")
"""Ours, and the default."""
OFFICIAL = Protocol("official", start_states="same", time_limit="terminates", first_action="random")
"""Habits of VDPO's released code that hold for every agent; the registry adds those of single agents."""
