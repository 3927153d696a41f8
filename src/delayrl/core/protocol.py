"""Protocols: how episodes start and end, which steps are learned from, and how policies are evaluated."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Opening = Literal["agent", "one-random", "random", "zeros"]
"""The first actions of an episode under a delay of Δ steps: the agent's; one at random, then the agent's; or Δ that are
random or zero."""


@dataclass(frozen=True)
class Protocol:
    """One way to train and evaluate. docs/protocols.md compares the two protocols, for each agent."""

    start_states: Literal["own", "same"] = "own"  # a new one per episode, or always the one that the run's seed gives
    time_limit: Literal["bootstraps", "terminates", "dropped"] = "bootstraps"  # whether targets keep the next state's
    # value where it ends an episode, or whether the step that it ends is not learned from
    opening: Opening = "agent"  # in training
    evaluation_opening: Opening = "agent"
    opening_steps: Literal["kept", "dropped"] = "kept"  # whether the steps of a whole opening are learned from
    last_starts: Literal["kept", "dropped"] = "kept"  # steps too close to an episode's end for a full n-step target
    capacity: Literal["rows", "entries"] = "rows"  # what replay_capacity counts: rows of the trajectory, or entries of
    # a replay that stores one for each k of a step's k-step targets
    overrides: Mapping[str, Any] = field(default_factory=dict)  # hyperparameters of the agent that it sets


def opening_length(opening: Opening, delay: int) -> int:
    """Return how many actions of an episode are not the agent's, under a delay of so many steps."""
    return {"agent": 0, "one-random": min(delay, 1)}.get(opening, delay)


CORRECTED = Protocol()
"""The default."""
OFFICIAL = Protocol(overrides={"entropy_unit": "task"})
"""What all released code of this family shares; the registry adds each agent's own habits."""
