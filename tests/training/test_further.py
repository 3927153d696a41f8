"""Runs that go on after their end, and runs that begin with the networks of others."""

import os
import shutil
import signal
import threading
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import jax
import numpy as np
import pytest

import delayrl
import own_tasks
from conftest import TINY, TINY_SAC, quick
from delayrl.agents.base import Agent
from delayrl.cli.main import main
from delayrl.core.types import Spec
from delayrl.play.run import Run
from delayrl.run.arrays import Arrays, flatten_tree
from delayrl.run.configuration import override
from delayrl.run.folder import versions_in
from delayrl.training.origin import RENAMED, _renamed, fitting, measured_of, parts_of, taken_over
from random_states import random_state
from short_runs import SHRINK, arrays, assert_same_networks, newest, train

module = import_module("delayrl.training.train")  # `delayrl.training` may show its function under that name


def without_hash(run: Run) -> list[dict]:
    return [{name: value for name, value in row.items() if name != "configuration"} for row in run.rows()]


@pytest.mark.parametrize("agent", quick(["bpql", "vdpo"], "bpql"))
def test_a_run_that_goes_on_is_the_longer_run(agent: str, tmp_path: Path) -> None:
    """Twice further, from the end: rows and networks of a run that was planned so long from the beginning."""
    whole = train(agent, tmp_path / "whole", steps=400)
    run = train(agent, tmp_path / "run", steps=200)
    short = run.config["configuration"]
    for steps in (300, 400):
        assert delayrl.go_on(run.path, steps, progress=False) == run
    assert without_hash(run) == without_hash(whole)
    assert_same_networks(run, whole)
    assert run.config["origin"] == {"lengths": [200, 300]}
    assert run.config["cost"] == whole.config["cost"]
    assert {row["configuration"] for row in run.rows()} == {run.config["configuration"]}
    assert len({run.config["configuration"], whole.config["configuration"], short}) == 3  # a result of its own
    assert delayrl.go_on(run.path, 400, progress=False).rows() == run.rows()  # nothing is left to do


def test_a_run_that_goes_on_elsewhere_names_all_versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a run that was stopped, and of one that was complete; reading it changes nothing."""
    run = train("random", tmp_path / "run", steps=300, callback=lambda step, runs: True)
    first = run.config["versions"]
    for name, steps in (("b", 300), ("b", 400), ("a", 500)):
        monkeypatch.setattr("delayrl.training.resume.versions", lambda name=name: {**first, "commit": name})
        delayrl.go_on(run.path, steps, progress=False)
    monkeypatch.setattr("delayrl.training.resume.versions", lambda: {**first, "commit": "c"})
    delayrl.go_on(run.path, 500, progress=False)
    assert [used["commit"] for used in versions_in(run.config)] == [first["commit"], "b", "a"]
    assert run.config["versions"] == first


def test_a_copy_of_a_seed_is_no_seed(tmp_path: Path) -> None:
    """Neither goes on with the others nor counts beside them; under a seed's name it is refused."""
    train("random", tmp_path, steps=200, seeds=2)
    shutil.copytree(tmp_path / "seed0", tmp_path / "seed0-before")
    assert [run.path.name for run in delayrl.go_on(tmp_path, 300, progress=False)] == ["seed0", "seed1"]
    assert Run(tmp_path / "seed0-before").rows()[-1]["step"] == 200
    (tmp_path / "seed0-before").rename(tmp_path / "seed2")
    with pytest.raises(delayrl.DelayRLError, match=r"two runs in .* have the same seed"):
        delayrl.go_on(tmp_path, 400, progress=False)


def test_seeds_go_on_together(tmp_path: Path) -> None:
    """In lockstep, given their common folder; one of them had been extended already when the first try was killed."""
    train("bpql", tmp_path / "runs", steps=200, seeds=2)
    whole = train("bpql", tmp_path / "whole", steps=300, seeds=2)
    again = tmp_path / "again"
    shutil.copytree(tmp_path / "runs", again)
    runs = delayrl.go_on(tmp_path / "runs", 300, progress=False)
    assert [run.path.name for run in runs] == ["seed0", "seed1"]
    assert [without_hash(run) for run in runs] == [without_hash(run) for run in whole]
    for name in ("config.json", "rows.jsonl"):
        rows = [
            line for line in (runs[0].path / name).read_text().splitlines(keepends=True) if '"step": 300' not in line
        ]
        (again / "seed0" / name).write_text("".join(rows))
    again_runs = delayrl.go_on(again, 300, progress=False)
    assert [run.rows() for run in again_runs] == [run.rows() for run in runs]


def test_what_cannot_go_on_is_left_as_it_is(tmp_path: Path) -> None:
    slim = train("random", tmp_path / "slim", steps=200, slim=True)
    assert not (slim.path / "replay").exists()
    before = {file: file.read_bytes() for file in slim.path.rglob("*") if file.is_file()}
    with pytest.raises(delayrl.DelayRLError, match=r"keeps no replay; --from .*slim starts a new run"):
        delayrl.go_on(slim.path, 300)
    with pytest.raises(delayrl.DelayRLError, match="has 200 steps; to train it further, give more than that: got 150"):
        delayrl.go_on(slim.path, 150)
    with pytest.raises(delayrl.DelayRLError, match=r"another steps; .*--steps N` trains it further"):
        train("random", slim.path, steps=300)
    assert {file: file.read_bytes() for file in slim.path.rglob("*") if file.is_file()} == before
    part = train("random", tmp_path / "part", steps=200)
    shutil.rmtree(part.path / "replay")
    assert delayrl.load(part.path)  # what a finished run is for is still there
    assert train("random", part.path, steps=200).rows()
    with pytest.raises(
        delayrl.DelayRLError, match=r"part has lost a part of its replay .*--from .*part starts a new run"
    ):
        delayrl.go_on(part.path, 300)
    with pytest.raises(delayrl.DelayRLError, match=r"nowhere is not a run folder"):
        delayrl.go_on(tmp_path / "nowhere", 300)
    with pytest.raises(delayrl.DelayRLError, match=r"nowhere is not a run folder"):
        train("random", tmp_path / "new", start_from=tmp_path / "nowhere")
    train("random", tmp_path / "two" / "seed0", steps=200)
    train("random", tmp_path / "two" / "seed1", steps=200, seed=1, delay=2)
    with pytest.raises(delayrl.DelayRLError, match="seed1 has another delay than the other seeds; train it alone"):
        delayrl.go_on(tmp_path / "two", 300)


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = train("bpql", tmp_path / "run", steps=200)
    main(["train", str(run.path), "--steps", "3e2", "--quiet", "--slim"])
    assert "300 steps" in capsys.readouterr().out
    assert max(row["step"] for row in run.rows()) == 300
    assert not (run.path / "replay").exists()
    with pytest.raises(SystemExit):
        main(["train", str(run.path)])
    assert "--steps" in capsys.readouterr().err


def files(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"threads": 0}, "threads must be a whole number, at least 1"),
        ({"track": "mlflow"}, "tensorboard or wandb; got 'mlflow'"),
        ({"callback": 3}, "callback is a function of the step and the runs; got 3"),
        ({"device": "cuda"}, "device must be cpu or gpu"),
        ({"env": "Swimmer-v5"}, "a run goes on in its own task, Reacher-v5; got Swimmer-v5"),
        ({"env": "Reacher-v5(reward_dist_weight=9)"}, r"in its own task, Reacher-v5; got Reacher-v5\(reward_dist"),
    ],
)
def test_what_is_refused_changes_no_run(wrong: dict, line: str, tmp_path: Path) -> None:
    run = train("random", tmp_path / "run", steps=200)
    before = files(run.path)
    with pytest.raises(delayrl.DelayRLError, match=line):
        delayrl.go_on(run, 300, progress=False, **wrong)
    assert files(run.path) == before
    if "env" not in wrong:
        with pytest.raises(delayrl.DelayRLError, match=line):
            train("random", run.path, steps=200, overwrite=True, **wrong)
        assert files(run.path) == before


def test_rows_go_on_to_name_the_task_that_the_run_began_with(tmp_path: Path) -> None:
    """One run is one result, also where its task has no name by which it could be found again."""
    nameless = lambda: own_tasks.make_arm()  # noqa: E731
    run = train("random", tmp_path / "run", steps=200, env=nameless, wrappers=own_tasks.LIMIT)
    delayrl.go_on(run, 300, env=own_tasks.make_arm, progress=False)
    assert [row["step"] for row in run.rows()][::2] == [100, 200, 300]
    assert {row["env"] for row in run.rows()} == {run.config["env"]}
    assert run.config["env"].startswith("<")
    with pytest.raises(delayrl.DelayRLError, match="belongs to another agent or configuration: action_size"):
        delayrl.go_on(run, 400, env=lambda: gym.make("Reacher-v5"), progress=False)


def test_a_task_without_a_name_in_a_wrapper_with_one(tmp_path: Path) -> None:
    """As text it is not looked up, as a class it is, and going on looks it up: one task."""
    arm = lambda: gym.make("Reacher-v5")  # noqa: E731
    given: dict[str, Any] = {"env": arm, "steps": 100, "random_steps": 100}
    run = train(
        "random", tmp_path / "run", wrappers=["gymnasium.wrappers.transform_observation:FlattenObservation"], **given
    )
    assert "unnamed" in run.config
    train("random", tmp_path / "run", wrappers=[gym.wrappers.FlattenObservation], **given)
    delayrl.go_on(run, 200, env=arm, progress=False)


def test_a_finished_run_gives_up_its_replay_when_asked_to(tmp_path: Path) -> None:
    run = train("random", tmp_path / "run", steps=200)
    assert (run.path / "replay").exists()
    train("random", run.path, steps=200, slim=True)
    assert not (run.path / "replay").exists()


def test_a_signal_before_the_first_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the run is prepared or a replay is read."""
    assert threading.current_thread() is threading.main_thread()
    begin = module.start

    def signalled(*given: object) -> object:
        os.kill(os.getpid(), signal.SIGTERM)
        return begin(*given)

    monkeypatch.setattr(module, "start", signalled)
    with pytest.raises(delayrl.StoppedError, match="stopped at step 0"):
        train("random", tmp_path / "run", steps=200)
    monkeypatch.undo()
    assert train("random", tmp_path / "run", steps=200).rows()


def test_a_service_that_is_not_installed_is_missed_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = train("random", tmp_path / "run", steps=200)
    monkeypatch.setattr("delayrl.training.checks.find_spec", lambda module: None)
    with pytest.raises(delayrl.DelayRLError, match=r"--track wandb needs `pip install 'delayrl\[wandb\]'`"):
        train("random", run.path, steps=200, overwrite=True, track="wandb")
    assert len(run.rows()) == 4


def test_a_run_from_another_goes_on_although_that_one_was_trained_further(tmp_path: Path) -> None:
    """What it began with stays in its configuration. Afresh, it begins with what the other one has now."""
    old = train("bpql", tmp_path / "old", steps=200)
    new = train("bpql", tmp_path / "new", steps=200, start_from=old)
    origin = new.config["origin"]
    delayrl.go_on(old, 300, progress=False)
    assert train("bpql", tmp_path / "new", steps=200, start_from=old).config["origin"] == origin
    for steps in (200, 300):
        other = train("bpql", tmp_path / f"other{steps}", steps=steps, random_steps=120)
        with pytest.raises(delayrl.DelayRLError, match="holds a run that began otherwise"):
            train("bpql", tmp_path / "new", steps=200, start_from=other)
    again = train("bpql", tmp_path / "new", steps=200, start_from=old, overwrite=True)
    assert again.config["origin"]["from"]["step"] == 300


def test_a_run_whose_source_is_gone_is_told_how_to_go_on(tmp_path: Path) -> None:
    train("random", tmp_path / "plain", steps=200)
    with pytest.raises(delayrl.DelayRLError, match=r"nowhere is not a run folder[^;]*$"):
        train("random", tmp_path / "plain", steps=200, start_from=tmp_path / "nowhere")
    old = train(SHRINK, tmp_path / "old", steps=200)
    train(SHRINK, tmp_path / "new", steps=200, start_from=old, callback=lambda step, runs: True)
    shutil.rmtree(old.path)
    with pytest.raises(delayrl.DelayRLError, match=r"old is not .*without it: `delayrl train .*new --steps 200`"):
        train(SHRINK, tmp_path / "new", steps=200, start_from=old.path)
    assert delayrl.go_on(tmp_path / "new", 200, progress=False).rows()[-1]["step"] == 200


def test_a_run_goes_on_although_the_newest_checkpoint_of_its_source_is_damaged(tmp_path: Path) -> None:
    train("bpql", tmp_path / "old", steps=300, callback=lambda step, runs: step == 200)  # unfinished, it keeps two
    new = train("bpql", tmp_path / "new", steps=200, start_from=tmp_path / "old")
    weights = newest(tmp_path / "old").path / "agent.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    assert train("bpql", tmp_path / "new", steps=200, start_from=tmp_path / "old").config == new.config


def test_networks_of_another_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Those whose sizes fit, before the first update; the notes and the configuration say which run it was."""
    old = train("bpql", tmp_path / "old", steps=200)
    new = train("bpql", tmp_path / "new", steps=101, random_steps=100, delay=5, start_from=old.path, progress=True)
    assert "taken over: critic, target, log_temperature; new: actor, and the optimisers" in capsys.readouterr().err
    assert new.config["origin"]["from"] == {
        "agent": "bpql",
        "env": "Reacher-v5",
        "delay": 3,
        "seed": 0,
        "configuration": old.config["configuration"],
        "step": 200,
        "networks": newest(old).files["agent.safetensors"],
    }
    before, after, fresh = arrays(old), arrays(new), arrays(train("bpql", tmp_path / "fresh", steps=101, delay=5))
    for name in ("critic.0.0.w", "target.1.1.w"):  # two updates later they have moved by two steps of Adam
        assert np.abs(after[name] - before[name]).max() < 1e-2 < np.abs(after[name] - fresh[name]).max()
    assert after["critic_opt_state.0.count"] == 2
    assert new.config["configuration"] != Run(tmp_path / "fresh").config["configuration"]
    assert len({row["configuration"] for row in new.rows()}) == 1


@pytest.mark.thorough
def test_normalised_networks_come_with_their_moments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also as a reference; moments alone are nothing to begin with."""
    old = train("sac", tmp_path / "sac", steps=200, observation_norm="running")
    train("vdpo", tmp_path / "vdpo", steps=100, start_from=old, observation_norm="running", progress=True)
    said = capsys.readouterr().err
    assert all(f"agent.reference.{name}" in said.split("new:")[0] for name in ("actor", "critic", "target"))
    with pytest.raises(delayrl.DelayRLError, match="sac has no network that fits: it lacks"):
        train("dcac", tmp_path / "dcac", start_from=old, observation_norm="running")
    with pytest.raises(delayrl.DelayRLError, match="its observation_norm is running, and that of the new run none"):
        train("sac", tmp_path / "plain", start_from=old)


def test_a_block_that_was_cut_does_not_go_on(tmp_path: Path) -> None:
    run = train("random", tmp_path / "run", steps=200, updates_per_call=3, evaluate_every=150)
    with pytest.raises(delayrl.DelayRLError, match="ended within a block of updates_per_call = 3 steps; --from"):
        delayrl.go_on(run, 300, progress=False)


def test_each_seed_keeps_its_own_replay(tmp_path: Path) -> None:
    """One of two finished seeds was trained with --slim; asking for both again deletes nothing."""
    train("bpql", tmp_path / "runs" / "seed0", steps=200, slim=True)
    train("bpql", tmp_path / "runs" / "seed1", steps=200, seed=1)
    train("bpql", tmp_path / "runs", steps=200, seeds=2)
    assert list((tmp_path / "runs" / "seed1" / "replay").iterdir())


def test_of_a_deeper_network_no_part_is_taken() -> None:
    """Two blocks of three would be no network that anyone trained. Counters and optimisers begin anew."""
    shallow = {"encoder.blocks.0.w": np.zeros(2), "steps": np.zeros((), int), "a_opt_state.0.mu": np.zeros(2)}
    deep = shallow | {"encoder.blocks.1.w": np.zeros(2)}
    assert fitting(shallow, shallow) == ["encoder.blocks"]
    assert fitting(shallow, deep) == fitting(deep, shallow) == []


def test_parts_of_a_state() -> None:
    """A number is a part of its own, unless what it is in has arrays beside it."""
    names = ["critic.0.2.w", "reference.actor.1.b", "encoder.position", "encoder.blocks.0.out.w", "moments.mean"]
    numbers = ["log_temperature", "reference.log_temperature", "moments.number"]
    state = {name: np.zeros(2) for name in names} | {name: np.zeros(()) for name in numbers}
    assert parts_of(state) == {
        "critic": ["critic.0.2.w"],
        "reference.actor": ["reference.actor.1.b"],
        "encoder": ["encoder.position"],
        "encoder.blocks": ["encoder.blocks.0.out.w"],
        "moments": ["moments.mean", "moments.number"],
        "log_temperature": ["log_temperature"],
        "reference.log_temperature": ["reference.log_temperature"],
    }


def test_agents_inside_agents_fit_each_other() -> None:
    """AD-SAC's auxiliary learner without a delay is a SAC, as VDPO's reference and BPQL's critics are."""
    sizes = {"actor": 2, "critic": 3}
    alone = {f"{name}.0.w": np.zeros(size) for name, size in sizes.items()}
    inside = {
        inner: {f"{inner}.{name}": x for name, x in alone.items()} for inner in ("auxiliary", "reference", "delayed")
    }

    def fitted(fresh: Arrays, stored: Arrays) -> set[str]:
        return {part for old, new in RENAMED for part in fitting(fresh, _renamed(stored, old, new))}

    for inner, own in inside.items():
        assert fitted(own, alone) == {f"{inner}.actor", f"{inner}.critic"}
        assert fitted(alone, own) == {"actor", "critic"}
        assert all(fitted(own, other) == {f"{inner}.actor", f"{inner}.critic"} for other in inside.values())
    augmented = {"actor.0.w": np.zeros(5)} | inside["auxiliary"]  # ad-sac, beside bpql
    assert fitted({"actor.0.w": np.zeros(5), "critic.0.w": np.zeros(3)}, augmented) == {"actor", "critic"}


def test_a_temperature_alone_is_not_taken() -> None:
    """Nor beside another agent's network."""
    fresh = {name: np.zeros(2) for name in ("actor.0.w", "reference.actor.0.w")}
    fresh |= {name: np.zeros(()) for name in ("log_temperature", "reference.log_temperature")}
    other = fresh | {"reference.actor.0.w": np.zeros(3)}
    assert fitting(fresh, other) == ["actor", "log_temperature"]
    assert fitting(fresh, {name: x for name, x in other.items() if name != "actor.0.w"}) == []


def began(old: Agent, new: Agent) -> tuple[Arrays, Arrays, str]:
    """What a run of `old` has, what a new one of `new` begins with, and what is said of it."""
    states = [random_state(agent, Spec(10, 2, 0 if agent == TINY_SAC else 3), i) for i, agent in enumerate((old, new))]
    stored, notes = flatten_tree(states[0]), []
    source: Any = SimpleNamespace(arrays=lambda name: stored, path=Path("old/checkpoints/1"))
    begun = taken_over(jax.tree.map(lambda x: np.asarray(x)[None], states[1]), source, notes.append)
    return stored, flatten_tree(jax.tree.map(lambda x: x[0], begun)), notes[0]


BOTH = "delayed.actor, delayed.critic, delayed.target, reference.critic, reference.target"
REFERENCE = "reference.actor, reference.critic, reference.target, reference.log_temperature"
WHOLE = "actor, critic, target, log_temperature; new: no network"


@pytest.mark.parametrize(
    ("old", "new", "taken", "pairs"),
    [
        ("bpql", "lifting", BOTH, {"delayed.actor": "actor", "reference.critic": "critic"}),
        ("lifting", "vdpo", REFERENCE, {name: name for name in ("reference.actor", "reference.critic")}),
        ("lifting", "bpql", WHOLE, {name: f"delayed.{name}" for name in ("actor", "critic")}),
        ("lifting", "sac", WHOLE, {name: f"reference.{name}" for name in ("actor", "critic")}),
        ("sac", "vdpo", REFERENCE, {f"reference.{name}": name for name in ("actor", "target")}),
        ("vdpo", "bpql", "critic, target, log_temperature; new: actor", {"critic": "reference.critic"}),
    ],
)
def test_agents_begin_with_what_fits(old: str, new: str, taken: str, pairs: dict[str, str]) -> None:
    """The delayed agent of lifting fits BPQL whole, its reference SAC; critics come from where the actor does."""
    agents = {"sac": TINY_SAC, **TINY}
    stored, begun, note = began(agents[old], agents[new])
    assert note.startswith(f"taken over: {taken}")
    for part, origin in pairs.items():
        names = [name for name in begun if name.startswith(f"{part}.")]
        assert names
        for name in names:
            np.testing.assert_array_equal(begun[name], stored[origin + name.removeprefix(part)])


def test_the_deviation_of_a_forecast_comes_with_its_networks_alone() -> None:
    """It has the task's size in any network, and says nothing of another one."""
    agent = TINY["any-age"]
    wider = override(agent, {"hidden": [9, 9]})
    with pytest.raises(delayrl.DelayRLError, match="has no network that fits"):
        began(agent, wider)
    *_, note = began(override(agent, {"critic_norm": "none"}), agent)
    assert (
        note
        == "taken over: actor, actor.forecast, actor.policy, log_temperature; new: critic, target, and the optimisers"
    )
    flat = {"theta": np.zeros(5)}  # an agent of a user without layers
    assert fitting(flat, flat) == ["theta"]
    assert not measured_of(flat)
    stored, begun, note = began(agent, agent)
    assert note.startswith("taken over: actor, actor.forecast, actor.policy, critic")
    np.testing.assert_array_equal(begun["actor.deviation"], stored["actor.deviation"])


@pytest.mark.parametrize(("old", "new"), [("a-sac", "vdpo"), ("sac", "dcac")])
def test_of_an_agent_with_other_views_nothing_is_taken(old: str, new: str) -> None:
    """A temperature fits every agent, and is no network."""
    agents = {"sac": TINY_SAC, **TINY}
    with pytest.raises(delayrl.DelayRLError, match="has no network that fits: it lacks"):
        began(agents[old], agents[new])
