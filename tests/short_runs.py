"""Runs of a few hundred steps with tiny networks; and what an installed package says of itself."""

import errno
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import delayrl
from delayrl.cli.main import main
from delayrl.core.types import Transition
from delayrl.play.run import Run
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.folder import RunFolder, RunLike
from delayrl.training.actor import Actor
from delayrl.training.loop import Loop

TINY = {
    "steps": 300,
    "random_steps": 100,
    "replay_capacity": 250,
    "evaluate_every": 100,
    "evaluation_episodes": 2,
    "hidden": [8, 8],
    "batch_size": 8,
}
OWN = {
    "vdpo": {"width": 8, "layers": 1, "clone_every": 50, "clone_updates": 5},
    "dida": {"expert_steps": 200, "round_steps": 20, "imitation_updates": 5, "student_hidden": [8]},
    "lifting": {"lifting_hold": 120, "lifting_end": 250},
}
SHRINK = "own_agents:Shrink"
"""Acts, learns, and compiles in a second: for tests of everything but agents."""
SMALL = ("random", SHRINK)


def train(agent: str, out: Path, **values):
    tiny = TINY | OWN.get(agent, {}) if agent not in SMALL else {name: TINY[name] for name in list(TINY)[:5]}
    options = {
        "env": "Reacher-v5",
        "delay": 0 if agent == "sac" else 3,
        "progress": False,
        "out": out,
        "preset": "small",
    }
    options |= tiny | values
    return delayrl.train(agent, **options)


def full_disk(handle: int) -> None:
    """In place of `os.fsync`: the disk is full."""
    raise OSError(errno.ENOSPC, "No space left on device")


class KilledError(Exception):
    """Ends a run where it is."""


def killed_and_resumed(agent: str, out: Path, monkeypatch: pytest.MonkeyPatch, **values) -> Run:
    """Train until step 237, in the middle of an episode, die there, and go on with the same call."""
    learn = Loop.learn

    def fail(self: Loop):
        if self.state.step == 237:
            raise KilledError
        return learn(self)

    with monkeypatch.context() as patch:
        patch.setattr(Loop, "learn", fail)
        with pytest.raises(KilledError):
            train(agent, out, **values)
    return train(agent, out, **values)


def newest(run: RunLike) -> Checkpoint:
    return RunFolder(Path(run)).latest()


def arrays(run: RunLike) -> dict[str, np.ndarray]:
    return newest(run).arrays("agent")


def assert_same_networks(one: RunLike, other: RunLike) -> None:
    """The newest checkpoints of two runs hold the same arrays of the agent, its optimisers' included, bit for bit."""
    mine, theirs = arrays(one), arrays(other)
    assert mine.keys() == theirs.keys()
    for name, array in mine.items():
        np.testing.assert_array_equal(array, theirs[name], name, strict=True)


def assert_same_replay(one: RunLike, other: RunLike) -> None:
    """The replays of two runs are stored in the same files, byte for byte."""
    mine, theirs = ({file.name: file.read_bytes() for file in (Path(run) / "replay").iterdir()} for run in (one, other))
    assert mine == theirs


@contextmanager
def at_step(number: int, call: Callable[[], object]) -> Iterator[None]:
    """Call something just before the environment step of this number."""
    step, steps = Actor.step, itertools.count(1)

    def counted(self: Actor, action: np.ndarray) -> Transition:
        if next(steps) == number:
            call()
        return step(self, action)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Actor, "step", counted)
        yield


def declare(folder: Path, group: str, **points: str) -> None:
    """Write into a folder what an installed package says of its entry points."""
    home = folder / f"{group.replace('.', '_')}-1.0.dist-info"
    home.mkdir()
    (home / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {group.replace('.', '_')}\nVersion: 1.0\n")
    lines = [f"{name} = {source}" for name, source in points.items()]
    (home / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run `delayrl` with arguments that it must refuse in one line, and return that line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        main(list(map(str, arguments)))
    captured = capsys.readouterr()
    assert (end.value.code, captured.out, captured.err.count("\n")) == (2, "", 1), captured.err
    assert captured.err.startswith("delayrl: ")
    return captured.err
