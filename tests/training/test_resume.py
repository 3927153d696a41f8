"""A run killed at any moment and resumed is the uninterrupted one, bit for bit: rows, parameters, optimisers."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import killing
import numpy as np
import pytest
from killing import KilledError, moments, options

import delayrl
from delayrl.run.folder import Run

AGENTS = ("sac", "bpql", "vdpo")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory):
    """Uninterrupted runs, and the moments that they had."""
    made = {}

    def get(agent: str) -> tuple[list[Run], list[str]]:
        if agent not in made:
            found = []
            with moments(lambda _, what, path: found.append(what)):
                runs = delayrl.train(agent, out=tmp_path_factory.mktemp("whole") / agent, **options(agent))
            made[agent] = runs, found
        return made[agent]

    return get


def assert_same(agent: str, out: Path, whole: list[Run]) -> None:
    for run, expected in zip(delayrl.train(agent, out=out, **options(agent)), whole, strict=True):
        assert run.read("rows") == expected.read("rows")
        mine, theirs = (r.latest().arrays("agent") for r in (run, expected))
        assert mine.keys() == theirs.keys()
        for name, array in mine.items():
            np.testing.assert_array_equal(array, theirs[name])
        assert sorted(p.name for p in run.path.iterdir()) == sorted(p.name for p in expected.path.iterdir())


def die(agent: str, out: Path, now: Callable[[int, str, str], bool]) -> bool:
    """Train until a moment; whether the run ended before it."""

    def kill(number: int, what: str, path: str) -> None:
        if now(number, what, path):
            raise KilledError

    try:
        with moments(kill):
            delayrl.train(agent, out=out, **options(agent))
    except KilledError:
        return False
    return True


@pytest.mark.parametrize("trial", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in range(1, 8))])
@pytest.mark.parametrize("agent", AGENTS)
def test_killed_at_random_moments(agent: str, trial: int, tmp_path: Path, whole) -> None:
    """Several times in a row, half of them while something is written or deleted."""
    runs, found = whole(agent)
    disk = [number for number, what in enumerate(found, 1) if what != "step"]
    assert len(disk) > 100
    rng = np.random.default_rng([trial, AGENTS.index(agent)])
    for _ in range(4):
        moment = int(rng.choice(disk) if rng.random() < 0.5 else rng.integers(1, len(found) + 1))
        if die(agent, tmp_path / "cut", lambda number, *_, moment=moment: number == moment):
            break
    assert_same(agent, tmp_path / "cut", runs)


def test_killed_between_the_first_checkpoints_of_a_group(tmp_path: Path, whole) -> None:
    """One seed has a checkpoint, the other none; and then killed at each moment of starting afresh."""
    out = tmp_path / "cut"
    first = "seed1/checkpoints/.000000000060.draft"
    assert not die("sac", out, lambda _, what, path: what == "rename" and path.endswith(first))
    assert [len(Run(out / f"seed{seed}").checkpoints()[0]) for seed in (0, 1)] == [1, 0]
    for moment in range(1, 12):
        assert not die("sac", out, lambda number, *_, moment=moment: number == moment)
    assert_same("sac", out, whole("sac")[0])


def sigkilled(agent: str, moment: int, out: Path, runs: list[Run]) -> None:
    command = [sys.executable, killing.__file__, str(moment), agent, str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert_same(agent, out, runs)


def test_sigkill(tmp_path: Path, whole) -> None:
    """A process of its own, and the real signal."""
    runs, found = whole("bpql")
    sigkilled("bpql", int(np.random.default_rng(0).integers(len(found) // 2, len(found))), tmp_path / "cut", runs)


@pytest.mark.slow
@pytest.mark.parametrize("trial", range(4))
@pytest.mark.parametrize("agent", AGENTS)
def test_sigkill_at_random_moments(agent: str, trial: int, tmp_path: Path, whole) -> None:
    runs, found = whole(agent)
    moment = np.random.default_rng([trial, 7]).integers(1, len(found) + 1)
    sigkilled(agent, int(moment), tmp_path / "cut", runs)
