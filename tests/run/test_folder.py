"""Run folders and their checkpoints: what is good stays, what is broken is named in one line."""

import errno
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from delayrl.errors import DelayRLError
from delayrl.run.checkpoint import Checkpoint, checkpoint_folders
from delayrl.run.disk import lock, passes
from delayrl.run.folder import RunFolder
from short_runs import full_disk

WEIGHTS = {"w": np.ones(3, np.float32)}
LOOP = {"rows": np.int32(1)}


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.create(
        {"agent": "sac", "preset": "small", "env": "E", "delay": 0, "hyperparameters": {}, "schedule": {"steps": 300}}
    )
    run.save(100, WEIGHTS, LOOP, {})
    return run


def test_a_checkpoint_of_the_same_step_is_replaced_only_when_complete(run: RunFolder, monkeypatch) -> None:
    """A run that is stopped right after an evaluation saves its step twice."""
    run.save(100, {"w": np.zeros(3, np.float32)}, LOOP, {})
    assert run.latest().arrays("agent")["w"].tolist() == [0, 0, 0]
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(DelayRLError, match="the disk is full; what was stored before is kept"):
        run.save(100, WEIGHTS, LOOP, {})
    assert run.latest().arrays("agent")["w"].tolist() == [0, 0, 0]


def test_a_checkpoint_stays_until_the_new_one_of_its_step_is_whole(run: RunFolder, monkeypatch) -> None:
    """Killed while the old one is deleted: the new one has its name already."""

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", lambda path, **_: killed() if path.exists() else None)
    with pytest.raises(KeyboardInterrupt):
        run.save(100, {"w": np.zeros(3, np.float32)}, LOOP, {})
    assert run.latest().arrays("agent")["w"].tolist() == [0, 0, 0]


def test_drafts_that_a_killed_process_left_are_deleted(run: RunFolder) -> None:
    home = run.path / "checkpoints"
    for name in (".draft", ".000000000150.draft"):  # of version 0.1, and of today
        (home / name).mkdir()
    run.save(200, WEIGHTS, LOOP, {})
    assert sorted(path.name for path in home.iterdir()) == ["000000000100", "000000000200"]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ({"step": 101}, "its manifest is damaged"),
        ({"step": float("inf")}, "its manifest is damaged"),
        ({"files": {}}, "its manifest is damaged"),
        ({"files": {"loop.safetensors": ""}}, "its manifest is damaged"),
        ({"pieces": {"../agent.safetensors": ""}}, "is cut or changed"),
        ({"pieces": {"a\0b": ""}}, "is cut or changed"),
        ({"pieces": 3}, "its manifest is damaged"),
    ],
)
def test_a_damaged_manifest_is_one_line(damage: dict, words: str, run: RunFolder) -> None:
    run.save(200, WEIGHTS, LOOP, {})
    file = run.path / "checkpoints" / "000000000200" / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | damage))
    good, (line,) = run.checkpoints()
    assert [checkpoint.step for checkpoint in good] == [100]
    assert words in line
    run.drop_pieces()
    networks_are_intact = isinstance(damage.get("pieces"), dict)  # which is all that play takes
    assert run.latest().step == (200 if networks_are_intact else 100)


@pytest.mark.parametrize(("number", "passing"), [(errno.EIO, True), (errno.EACCES, False)])
def test_a_checkpoint_on_a_disk_that_does_not_answer_is_not_broken(
    number: int, passing: bool, run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be whole: a run that went on from an older one would delete it."""

    def refuse(self: Checkpoint, *, replay: bool) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Checkpoint, "check", refuse)
    if passing:
        with pytest.raises(DelayRLError, match="cannot be read now") as error:
            run.checkpoints()
        assert passes(error.value)
    else:
        good, lines = run.checkpoints()
        assert (good, len(lines)) == ([], 1)


def test_a_copy_of_a_checkpoint_is_left_out(run: RunFolder) -> None:
    home = run.path / "checkpoints"
    shutil.copytree(home / "000000000100", home / "000000000100.bak")
    assert run.latest().step == 100
    run.drop_pieces()


@pytest.mark.parametrize("name", ["agent", "delay", "schedule"])
def test_a_damaged_configuration_is_one_line(name: str, run: RunFolder) -> None:
    config = run.config
    assert "protocol" not in config  # none is needed to open a run
    (run.path / "config.json").write_text(json.dumps({key: value for key, value in config.items() if key != name}))
    with pytest.raises(DelayRLError, match=f"no {name}"):
        print(run.config)


def test_a_schedule_without_steps_is_damaged(run: RunFolder) -> None:
    (run.path / "config.json").write_text(json.dumps(run.config | {"schedule": {}}))
    with pytest.raises(DelayRLError, match=r"config.json is damaged: its schedule has no steps$"):
        print(run.config)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("versions", "x"),
        ("later_versions", 1),
        ("later_versions", [1]),
        ("configuration", [1]),
        ("seed", "x"),
        ("protocol", 0.5),
    ],
)
def test_what_a_configuration_holds_besides_is_checked(name: str, value: object, run: RunFolder) -> None:
    (run.path / "config.json").write_text(json.dumps(run.config | {name: value}))
    with pytest.raises(DelayRLError, match=f"config.json is damaged: no good {name}: {re.escape(repr(value))}$"):
        print(run.config)


def test_a_line_that_is_no_object(run: RunFolder) -> None:
    (run.path / "metrics.jsonl").write_text("[1]\n")
    with pytest.raises(DelayRLError, match=r"metrics.jsonl is damaged: no object$"):
        run.read("metrics")


@pytest.mark.parametrize("line", [{}, {"x": 1}, {"step": "x"}, {"step": None}])
def test_a_line_without_a_step(line: dict, run: RunFolder) -> None:
    """A run that goes on could not tell whether the line is of a later step."""
    (run.path / "episodes.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(DelayRLError, match=r"episodes.jsonl is damaged: a line has no step: \{"):
        run.rewind(100)


def test_an_episode_that_is_there_twice(run: RunFolder) -> None:
    """Else its evaluation had most episodes, and all others seemed to be cut off by a crash."""
    row = {"step": 100, "policy": "agent", "episode": 0, "reset_seed": 1, "return": 1.0, "length": 2}
    run.append("rows", [row, row | {"episode": 1}, row | {"policy": "reference"}, row | {"step": 200}])
    assert len(run.read("rows")) == 4
    run.append("rows", [row])
    with pytest.raises(DelayRLError, match=r"rows.jsonl holds an episode twice: step 100, agent$"):
        run.read("rows")


def test_what_is_no_checkpoint_or_piece_is_left_alone(run: RunFolder) -> None:
    (run.path / "checkpoints" / "\u00b2").mkdir()
    (run.path / "checkpoints" / "000000000700").write_text("a file")
    (run.path / "replay" / "mine").mkdir(parents=True)
    (run.path / "replay" / "notes.txt").write_text("mine")
    piece = run.path / "replay" / "000000000000-000000000001.safetensors"
    piece.write_bytes(b"old")
    run.drop_pieces()
    assert [path.name for path in checkpoint_folders(run.path)] == ["000000000100"]
    assert sorted(path.name for path in (run.path / "replay").iterdir()) == ["mine", "notes.txt"]


def test_what_may_only_be_read_is_locked(tmp_path: Path, monkeypatch) -> None:
    opened = os.open

    def refuse(path: object, flags: int, *more: int) -> int:
        if flags & os.O_RDWR:
            raise PermissionError
        return opened(path, flags, *more)

    monkeypatch.setattr(os, "open", refuse)
    with lock(tmp_path) as free, lock(tmp_path) as again:
        assert (free, again) == (True, False)


def test_a_pipe_is_no_run(tmp_path: Path) -> None:
    """Reading it would wait for ever."""
    os.mkfifo(tmp_path / "config.json")
    with pytest.raises(DelayRLError, match="is not a run folder"):
        print(RunFolder(tmp_path).config)


def test_a_damaged_row_is_one_line(run: RunFolder) -> None:
    (run.path / "rows.jsonl").write_text("{}\n")
    with pytest.raises(DelayRLError, match=r"rows.jsonl holds a damaged row: \{\}$"):
        run.read("rows")


def test_play_needs_no_replay(run: RunFolder) -> None:
    """An unfinished run that was copied without it has a policy, but cannot be resumed."""
    run.save(200, WEIGHTS, LOOP, {"piece": run.save_piece("piece", WEIGHTS)})
    assert [checkpoint.step for checkpoint in run.checkpoints()[0]] == [200, 100]
    shutil.rmtree(run.path / "replay")
    assert run.latest().step == 200
    assert [checkpoint.step for checkpoint in run.checkpoints()[0]] == [100]
