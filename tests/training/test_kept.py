"""What is refused leaves every stored file as it was."""

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import pytest

import delayrl
from delayrl.envs.making import make
from delayrl.play import evaluation
from delayrl.play.policy import spec_of
from delayrl.run.folder import RunFolder, hold
from delayrl.training import checks, machine
from short_runs import TINY, train


def stored(folder: Path) -> dict[str, str]:
    """Return the checksum of each file."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def assert_refused(folder: Path, why: str, call: Callable[[], object]) -> None:
    before = stored(folder)
    with pytest.raises(delayrl.DelayRLError, match=why):
        call()
    assert stored(folder) == before


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds, one finished and one stopped after its first evaluation."""
    out = tmp_path_factory.mktemp("apart")
    train("random", out / "seed0", seed=0)
    train("random", out / "seed1", seed=1, callback=lambda step, runs: True)
    return out


def test_seeds_at_different_steps_do_not_begin_again(apart: Path) -> None:
    why = "different steps .*seed0 at 300, .*seed1 at 100"
    assert_refused(apart, why, lambda: train("random", apart, seeds=2))
    assert_refused(apart, why, lambda: delayrl.go_on(apart, 600, progress=False))
    assert train("random", apart / "seed1", seed=1).rows()[-1]["step"] == 300
    assert [run.rows()[-1]["step"] for run in train("random", apart, seeds=2)] == [300, 300]


def test_a_seed_that_is_new_does_not_restart_the_others(tmp_path: Path) -> None:
    train("random", tmp_path / "seed0", callback=lambda step, runs: True)
    assert_refused(tmp_path, "seed0 at 100, .*seed1 at 0", lambda: train("random", tmp_path, seeds=2))
    assert not (tmp_path / "seed1").exists()


def test_a_seed_that_died_early_does_not_restart_a_finished_one(tmp_path: Path) -> None:
    """Its folder holds a configuration and nothing else. Alone it begins again, and then both are complete."""
    train("random", tmp_path / "seed0", seed=0)
    begun = RunFolder(tmp_path / "seed1")
    begun.create(RunFolder(tmp_path / "seed0").config | {"seed": 1})
    assert_refused(tmp_path, "seed0 at 300, .*seed1 at 0", lambda: train("random", tmp_path, seeds=2))
    train("random", begun.path, seed=1)
    assert [run.rows()[-1]["step"] for run in train("random", tmp_path, seeds=2)] == [300, 300]


def test_lost_rows_are_told(tmp_path: Path) -> None:
    """A run that is complete, or goes on, would have a curve that begins late, or none."""
    rows = train("random", tmp_path).path / "rows.jsonl"
    whole = rows.read_text()
    for kept in ("", "".join(line for line in whole.splitlines(keepends=True) if '"step": 100,' in line)):
        rows.write_text(kept)
        assert_refused(tmp_path, "checkpoint at step 300, and rows up to step", lambda: train("random", tmp_path))
        assert_refused(tmp_path, "some are lost", lambda: delayrl.go_on(tmp_path, 600, progress=False))
    rows.unlink()
    assert_refused(tmp_path, "rows up to step 0 alone", lambda: train("random", tmp_path))
    rows.write_text(whole)
    assert train("random", tmp_path).rows()[-1]["step"] == 300


def test_rows_without_a_checkpoint_are_not_begun_again(tmp_path: Path) -> None:
    """Somebody has deleted the checkpoints to save space."""
    run = train("random", tmp_path / "run")
    shutil.rmtree(run.path / "checkpoints")
    assert_refused(tmp_path, "rows up to step 300 and no checkpoint", lambda: train("random", run.path))
    assert len(train("random", run.path, overwrite=True).rows()) == len(run.rows()) > 0


def test_a_refused_overwrite_keeps_the_run(tmp_path: Path) -> None:
    old = train("bpql", tmp_path / "old", steps=101)
    other = train("random", tmp_path / "other", steps=101)
    why = "no network that fits"
    assert_refused(tmp_path, why, lambda: train("bpql", old.path, start_from=other, overwrite=True))
    (tmp_path / "seed1").mkdir()
    (tmp_path / "seed1" / "notes.txt").write_text("mine")
    shutil.copytree(old.path, tmp_path / "seed0")
    assert_refused(tmp_path, "seed1 is not empty", lambda: train("bpql", tmp_path, seeds=2, overwrite=True))


def test_too_few_simulators_for_an_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A licence may allow that of training, and no more."""

    def make(*task: object, **options: object) -> None:
        raise delayrl.DelayRLError("only one simulator may run")

    old = train("random", tmp_path / "old")
    monkeypatch.setattr(evaluation, "make", make)
    assert_refused(tmp_path, "only one simulator", lambda: train("random", old.path, seed=1, overwrite=True))


@pytest.mark.parametrize(("seeds", "words"), [(1, "the replay takes 0.0 GB"), (2, "replays of 2 seeds take 0.0 GB")])
def test_a_replay_larger_than_the_memory(seeds: int, words: str, tmp_path: Path, monkeypatch) -> None:
    """It would be killed without a word, or fail with a traceback."""
    train("bpql", tmp_path / "old" / "seed0", steps=101)
    monkeypatch.setattr(machine, "entry_points", lambda group: [])
    spec = spec_of(make("Reacher-v5", 3))
    size = TINY["replay_capacity"] * (4 * (spec.obs_size + spec.action_size) + 17) + 12  # with three counters
    out = tmp_path / "old" / ("seed0" if seeds == 1 else "")
    monkeypatch.setattr(checks, "free_memory", lambda: seeds * size - 1)
    assert_refused(tmp_path, words, lambda: train("bpql", out, seeds=seeds, overwrite=True))
    monkeypatch.setattr(checks, "free_memory", lambda: seeds * size)
    train("bpql", tmp_path / "fits", steps=101, seeds=seeds)


def test_a_run_may_begin_with_its_own_networks(tmp_path: Path) -> None:
    old = train("bpql", tmp_path, steps=101)
    networks = RunFolder(tmp_path).latest().files["agent.safetensors"]
    new = train("bpql", tmp_path, steps=102, start_from=old, overwrite=True)
    assert new.config["origin"]["from"]["networks"] == networks
    assert new.rows()[-1]["step"] == 102


def test_a_run_that_began_with_other_networks_is_another(tmp_path: Path) -> None:
    old = train("bpql", tmp_path / "old", steps=101)
    train("bpql", tmp_path / "new", steps=101, start_from=old)
    assert_refused(tmp_path, "began otherwise", lambda: train("bpql", tmp_path / "new", steps=101))
    assert_refused(tmp_path, "began otherwise", lambda: train("bpql", old.path, steps=101, start_from=tmp_path / "new"))
    delayrl.go_on(old, 103, progress=False)
    assert_refused(tmp_path, "was trained further, to 103 steps", lambda: train("bpql", old.path, steps=103))


def test_a_call_that_failed_is_in_nobodys_way(tmp_path: Path) -> None:
    """Before its first result it left a configuration alone. What has results is kept."""

    def broken() -> gym.Env:
        env = gym.make("Reacher-v5")
        env.unwrapped.reset_model = lambda: 1 / 0  # type: ignore[attr-defined]
        return env

    before = train("random", tmp_path / "before")
    (tmp_path / "run").mkdir()
    shutil.copyfile(before.path / "config.json", tmp_path / "run" / "config.json")
    with pytest.raises(delayrl.DelayRLError, match="ZeroDivisionError"):
        train("random", tmp_path / "run", env=broken)
    assert train("random", tmp_path / "run", delay=1).config["delay"] == 1
    assert_refused(tmp_path, "another delay", lambda: train("random", tmp_path / "run", delay=2))
    for name, text in (("config.json", '{"model_type": "bert"}'), ("episodes.jsonl", "{}")):
        shutil.copytree(before.path, tmp_path / name)
        for other in ("checkpoints", "replay"):
            shutil.rmtree(tmp_path / name / other)
        (tmp_path / name / "rows.jsonl").unlink()
        (tmp_path / name / name).write_text(text)
        assert_refused(tmp_path, "damaged|another", lambda name=name: train("random", tmp_path / name, delay=2))


def test_a_run_is_trained_by_one_process(tmp_path: Path) -> None:
    run = train("random", tmp_path / "seed0")
    with hold(run.path):
        assert_refused(tmp_path, "trained by another process", lambda: train("random", run.path))
        assert_refused(tmp_path, "trained by another process", lambda: train("random", tmp_path, seeds=2))
        assert_refused(tmp_path, "trained by another process", lambda: delayrl.go_on(run, 400, progress=False))
    assert train("random", run.path).rows() == run.rows()


def test_what_is_refused_leaves_no_folder(tmp_path: Path) -> None:
    source = train("random", tmp_path / "source", steps=101)
    (tmp_path / "file").write_text("mine")
    for out, why in (
        (tmp_path / "a" / "b", "no network that fits"),
        (tmp_path / "file", "is a file; give another --out"),
    ):
        assert_refused(tmp_path, why, lambda out=out: train("bpql", out, start_from=source))
    assert {path.name for path in tmp_path.iterdir()} == {"source", "file"}
