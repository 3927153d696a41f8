"""A group of seeds in training: what stays the same, and the state that changes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.agents.base import State
from delayrl.core.types import Key, Spec
from delayrl.run.condition import Setup
from delayrl.run.folder import Run
from delayrl.training.actor import Actor
from delayrl.training.learner import Learner, Program, Stored


@dataclass(frozen=True)
class Group:
    """The seeds that one call trains in lockstep, and what they share.

    Attributes:
        setup: what is trained, on what.
        seeds, runs, keys: of each seed its number, folder and random key.
        spec: sizes of the task.
        template: shapes and types of the agent's state.
        program: the compiled functions.
        apply: `map`, or that of a pool of threads, which steps environments beside each other.
    """

    setup: Setup
    seeds: list[int]
    runs: list[Run]
    keys: Key
    spec: Spec
    template: State
    program: Program
    apply: Callable[..., Iterator[Any]] = map


@dataclass
class TrainState:
    """Where training stands; all that a checkpoint holds.

    Attributes:
        step: environment steps that each seed has taken.
        learner: agents and replays of all seeds.
        actors: the environments in their current episodes.
        pending: the newest steps, which the learner has not been given yet, [steps][seeds].
        actions: the next actions, [seeds, A], if they have been chosen already.
        pieces: for each seed the files of its replay, with their checksums.
        stored: for each seed the rows and the steps of its replay that these files hold.
    """

    step: int
    learner: Learner
    actors: list[Actor]
    pending: list[list[Stored]]
    actions: NDArray[np.float32] | None
    pieces: list[dict[str, str]]
    stored: list[tuple[int, int]]
