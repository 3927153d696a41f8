"""A run killed at any moment and resumed is the uninterrupted one, bit for bit: rows, parameters, optimisers."""

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import killing
import numpy as np
import pytest
from killing import KilledError, moments, options

import delayrl
from conftest import quick
from delayrl.agents.registry import AGENTS
from delayrl.play.run import Run
from delayrl.run.folder import RunFolder
from delayrl.training.signals import stop_signal
from short_runs import assert_same_networks, at_step, newest, train

KILLED = ("bpql", "vdpo")


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
        assert run.rows() == expected.rows()
        assert_same_networks(run, expected)
        assert sorted(p.name for p in run.path.iterdir()) == sorted(p.name for p in expected.path.iterdir())


def killed() -> None:
    raise KilledError


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
@pytest.mark.parametrize("agent", quick(KILLED, "bpql", slow=["vdpo"]))
def test_killed_at_random_moments(agent: str, trial: int, tmp_path: Path, whole) -> None:
    """Several times in a row, half of them while something is written or deleted."""
    runs, found = whole(agent)
    disk = [number for number, what in enumerate(found, 1) if what != "step"]
    assert len(disk) > 100
    rng = np.random.default_rng([trial, KILLED.index(agent)])
    for _ in range(4):
        moment = int(rng.choice(disk) if rng.random() < 0.5 else rng.integers(1, len(found) + 1))
        if die(agent, tmp_path / "cut", lambda number, *_, moment=moment: number == moment):
            break
    assert_same(agent, tmp_path / "cut", runs)


@pytest.mark.thorough
def test_killed_between_the_first_checkpoints_of_a_group(tmp_path: Path, whole) -> None:
    """One seed has a checkpoint, the other none; and then killed at each moment of starting afresh."""
    out = tmp_path / "cut"
    first = "seed1/checkpoints/.000000000060.draft"
    assert not die("bpql", out, lambda _, what, path: what == "rename" and path.endswith(first))
    assert [len(RunFolder(out / f"seed{seed}").checkpoints()[0]) for seed in (0, 1)] == [1, 0]
    for moment in range(1, 12):
        assert not die("bpql", out, lambda number, *_, moment=moment: number == moment)
    assert_same("bpql", out, whole("bpql")[0])


def sigkilled(agent: str, moment: int, out: Path, runs: list[Run]) -> None:
    command = [sys.executable, killing.__file__, str(moment), agent, str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert_same(agent, out, runs)


@pytest.mark.thorough
def test_sigkill(tmp_path: Path, whole) -> None:
    """A process of its own, and the real signal."""
    runs, found = whole("bpql")
    sigkilled("bpql", int(np.random.default_rng(0).integers(len(found) // 2, len(found))), tmp_path / "cut", runs)


@pytest.mark.slow
@pytest.mark.parametrize("trial", range(4))
@pytest.mark.parametrize("agent", KILLED)
def test_sigkill_at_random_moments(agent: str, trial: int, tmp_path: Path, whole) -> None:
    runs, found = whole(agent)
    moment = np.random.default_rng([trial, 7]).integers(1, len(found) + 1)
    sigkilled(agent, int(moment), tmp_path / "cut", runs)


KEPT = ("vdpo",)  # with a phase more
ALIKE = ("bpql", "sac", "sac-memoryless", "a-sac", "any-age", "lifting", "ad-sac", "dcac")  # `official` above is bpql


@pytest.mark.parametrize(
    ("agent", "at", "options"),
    [
        ("bpql", 260, {"protocol": "official"}),
        *(pytest.param(*param.values, 237, {}, marks=param.marks) for param in quick(AGENTS, *KEPT, slow=ALIKE)),
    ],
)
def test_killed_and_resumed_is_uninterrupted(agent: str, at: int, options: dict, tmp_path: Path) -> None:
    """Bit for bit: rows and parameters, with a replay that has gone round, and an episode cut in its middle."""
    whole = train(agent, tmp_path / "whole", **options)
    with at_step(at, killed), pytest.raises(KilledError):
        train(agent, tmp_path / "cut", **options, slim=True)
    run = RunFolder(tmp_path / "cut")
    assert run.latest().step == at // 100 * 100
    # made after the checkpoint
    run.append("rows", [{"step": 299, "policy": "agent", "episode": 0, "reset_seed": 0, "return": 0.0, "length": 1}])
    with open(run.path / "rows.jsonl", "a") as file:
        file.write('{"step": 299, "pol')
    resumed = train(agent, tmp_path / "cut", **options, slim=True)
    assert resumed.rows() == whole.rows()
    assert_same_networks(resumed, whole)
    assert not (run.path / "replay").exists()
    assert len(list((whole.path / "checkpoints").iterdir())) == 1


@pytest.mark.parametrize(
    ("agent", "block"),
    [
        ("bpql", 4),
        pytest.param("bpql", 1, marks=pytest.mark.slow),
        pytest.param("vdpo", 10, marks=pytest.mark.slow),
    ],
)
def test_stopped_between_checkpoints_and_resumed(agent: str, block: int, tmp_path: Path) -> None:
    """A run that is asked to stop keeps its newest steps and goes on with them, bit for bit."""
    values = {"updates_per_call": block}
    whole = train(agent, tmp_path / "whole", **values)
    interrupt = partial(signal.raise_signal, signal.SIGINT)
    with at_step(157, interrupt), pytest.raises(delayrl.DelayRLError, match="stopped at step 157"):
        train(agent, tmp_path / "cut", **values)
    assert len(newest(tmp_path / "cut").arrays("loop")["pending.obs"]) == (157 - 1) % block + 1
    resumed = train(agent, tmp_path / "cut", **values)
    assert resumed.rows() == whole.rows()
    assert_same_networks(resumed, whole)


def test_a_run_that_begins_anew_is_of_its_new_code_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What ended before its first checkpoint has left nothing; the code that is named made the rows."""
    monkeypatch.setattr("delayrl.training.resume.versions", lambda: {"commit": "old"})
    with at_step(50, killed), pytest.raises(KilledError):
        train("random", tmp_path)
    monkeypatch.setattr("delayrl.training.resume.versions", lambda: {"commit": "new"})
    config = train("random", tmp_path).config
    assert (config["versions"]["commit"], config.get("later_versions")) == ("new", None)


def test_a_second_interrupt_does_not_wait_for_the_loop() -> None:
    """While something compiles, nobody looks at the event. SIGTERM comes from machines, and may come twice."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    try:
        with stop_signal() as stop:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
            assert stop.is_set()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_broken_checkpoint_falls_back(tmp_path: Path) -> None:
    """A cut file is named, and the checkpoint before it is used; with none left the run says so."""
    with at_step(250, killed), pytest.raises(KilledError):
        train("bpql", tmp_path / "run")
    run = RunFolder(tmp_path / "run")
    last = run.latest().path / "agent.safetensors"
    last.write_bytes(last.read_bytes()[:-100])
    good, broken = run.checkpoints()
    assert [c.step for c in good] == [100]
    assert "agent.safetensors is cut or changed" in broken[0]
    backup = tmp_path / "backup"
    shutil.copytree(run.path, backup)
    whole = train("bpql", tmp_path / "whole")
    assert train("bpql", run.path).rows() == whole.rows()
    (newest(backup).path / "manifest.json").write_text("{")
    with pytest.raises(delayrl.DelayRLError, match="no good checkpoint"):
        train("bpql", backup)
    with pytest.raises(delayrl.DelayRLError, match="broken"):
        delayrl.load(backup)
