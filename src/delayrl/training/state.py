"""A group of seeds in training: what stays the same, and the state that changes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.core.types import Key, Spec
from delayrl.play.run import Run
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.condition import Setup
from delayrl.run.folder import RunFolder
from delayrl.training.actor import Actor
from delayrl.training.learner import Learner, Program, Stored

Callback = Callable[[int, list[Run]], Any]
"""A function of the step and the runs, called after each evaluation is stored. If it returns true, training ends."""


@dataclass(frozen=True)
class Ways:
    """How to train, which does not change what is learned: arguments of `train`."""

    device: str | None = None
    track: str | None = None
    threads: int = 1
    slim: bool = False
    callback: Callback | None = None
    progress: bool = True


@dataclass(frozen=True)
class Group:
    """The seeds that one call trains in lockstep, and what they share."""

    setup: Setup
    seeds: list[int]
    folders: list[RunFolder]  # one folder for each seed
    keys: Key  # one random key for each seed
    spec: Spec
    program: Program
    ways: Ways
    apply: Callable[..., Iterator[Any]] = map  # or that of a pool of threads, which step environments beside each other
    source: Checkpoint | None = None  # of another run, whose networks training begins with
    further: bool = False  # whether these are runs of fewer steps, which go on


@dataclass
class TrainState:
    """Where training stands; all that a checkpoint holds."""

    step: int
    learner: Learner
    actors: list[Actor]
    pending: list[list[Stored]]  # the newest steps, [steps][seeds], which the learner has not been given yet
    actions: NDArray[np.float32] | None  # the next actions, [seeds, A], if they have been chosen already
    pieces: list[dict[str, str]]  # for each seed the files of its replay, with their checksums
    stored: list[tuple[int, int]]  # for each seed the rows and the steps of its replay that these files hold
