"""`delayrl export` and `delayrl latency`: the content of a bundle, and where it may be written."""

import json
import sys
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from bundles import bundle_of, policy_of, run_of

from delayrl import DelayWarning, evaluate, load, make
from delayrl.agents.registry import AGENTS
from delayrl.agents.sac import SAC
from delayrl.cli.main import main
from delayrl.deploy import Controller, export_run, load_bundle
from delayrl.deploy.latency import ages_of, latency
from delayrl.envs.making import tasks
from delayrl.errors import DelayRLError
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.folder import RunFolder
from short_runs import refused


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(tmp_path_factory.mktemp("runs") / "run").path


def test_a_run_becomes_a_bundle(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bundle"
    main(["export", str(run), "--out", str(out)])
    printed = capsys.readouterr().out
    assert "vdpo on Reacher-v5, ages 0..3" in printed
    assert "a sensor up to 60 ms late in step with the control loop, up to 50 ms at any phase" in printed
    assert sorted(file.name for file in out.iterdir()) == ["bundle.json", "policy.onnx", "policy.safetensors"]
    assert not [file for file in tmp_path.iterdir() if file != out]
    metadata = load_bundle(out).metadata
    assert (metadata["agent"], metadata["env"], metadata["delay"], metadata["ages"]) == (
        "vdpo",
        "Reacher-v5",
        3,
        [0, 3],
    )
    assert metadata["dt"] == pytest.approx(0.02)
    assert metadata["action"] == {"shape": [2], "dtype": "float32", "low": [-1.0, -1.0], "high": [1.0, 1.0]}
    assert metadata["observation"]["low"] == [None] * 10
    assert metadata["step"] == 240
    evaluation = {"step": 240, "episodes": 2, "mean_return": 240.5, "std_return": 0.5**0.5, "protocol": "corrected"}
    assert metadata["evaluation"] == evaluation
    assert metadata["hyperparameters"]["width"] == 8
    assert metadata["trained_with"] == {"numpy": "2"}
    assert metadata["exported_with"]["jax"]
    assert metadata["privileged"] is True


def test_the_ages_that_it_learned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """BPQL learns those that its training shows, any-age and VDPO all up to the longest."""
    learned = {}
    for name in ("bpql", "any-age", "vdpo"):
        source = run_of(tmp_path / name, name).path
        main(["export", str(source), "--out", str(tmp_path / f"{name}-bundle")])
        policy = load_bundle(tmp_path / f"{name}-bundle")
        learned[name] = (policy.metadata["ages"], policy.min_age, Controller(policy).min_age)
    assert learned == {"bpql": ([3, 3], 3, 3), "any-age": ([0, 3], 0, 0), "vdpo": ([0, 3], 0, 0)}
    assert "ages 3..3\n" in (printed := capsys.readouterr().out)
    assert printed.count("; held back until 60 ms late\n") == 1


def test_an_age_that_was_not_learned_is_told(tmp_path: Path) -> None:
    path = run_of(tmp_path / "bpql", "bpql").path
    line = "bpql learned no age below 3 steps, and delay uniform:2:3 shows younger ones"
    with pytest.warns(DelayWarning, match=line):
        evaluate(path, 1, "uniform:2:3")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluate(path, 1)
        evaluate(path, 1, "uniform:2:3@wait")
        evaluate(run_of(tmp_path / "vdpo").path, 1, 0)


def test_the_bundle_plays_as_the_run(run: Path, tmp_path: Path) -> None:
    """A complete episode in the task, from age 0 on, with what the wrapper shows."""
    export_run(run, tmp_path / "bundle")
    policy, bundles = load(run), [load_bundle(tmp_path / "bundle", backend) for backend in ("numpy", "onnx")]
    env = make("Reacher-v5", 3)
    obs, info = env.reset(seed=0)
    ages, done = [], False
    while not done:
        expected = policy.act(obs, info)
        for bundle in bundles:
            action = bundle(obs, info["actions"], info["age"])
            np.testing.assert_allclose(action, expected, rtol=0, atol=1e-5)
        ages.append(info["age"])
        obs, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    assert ages == [0, 1, 2, *[3] * 47]


def test_the_graph_says_what_it_is(run: Path, tmp_path: Path) -> None:
    """And computes the policy: other programs run the file, which our backend does not read."""
    import onnxruntime

    export_run(run, tmp_path / "bundle")
    session = onnxruntime.InferenceSession(tmp_path / "bundle" / "policy.onnx")
    policy, random = load_bundle(tmp_path / "bundle"), np.random.default_rng(0)
    for age in range(4):
        obs, actions = (random.uniform(-1, 1, size).astype(np.float32) for size in (10, (3, 2)))
        (action,) = session.run(["action"], {"obs": obs, "actions": actions, "age": np.array(age)})
        np.testing.assert_allclose(action, policy(obs, actions, age), rtol=0, atol=1e-5)
    properties = json.loads(session.get_modelmeta().custom_metadata_map["delayrl"])
    metadata = load_bundle(tmp_path / "bundle").metadata
    assert properties == {k: v for k, v in metadata.items() if k not in ("files", "checksum", "format")}


def test_the_same_run_gives_the_same_bundle(run: Path, tmp_path: Path) -> None:
    for name in ("first", "second"):
        export_run(run, tmp_path / name)
    assert load_bundle(tmp_path / "first").metadata["checksum"] == load_bundle(tmp_path / "second").metadata["checksum"]


def test_before_the_first_evaluation(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "bpql")
    (run.path / "rows.jsonl").write_text("")
    assert export_run(run.path, tmp_path / "bundle")["evaluation"] is None


def test_a_task_that_does_not_say_its_step(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "a-sac", "delayrl/Counter-v0", 2, (2, 1))
    assert export_run(run.path, tmp_path / "bundle")["dt"] is None
    assert load_bundle(tmp_path / "bundle").dt is None


def test_a_task_that_says_its_step_by_another_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(make("delayrl/Counter-v0").unwrapped), "tau", 0.04, raising=False)
    run = run_of(tmp_path / "run", "a-sac", "delayrl/Counter-v0", 2, (2, 1))
    assert export_run(run.path, tmp_path / "bundle")["dt"] == 0.04
    assert next(seconds for name, _, seconds in tasks() if name == "delayrl/Counter-v0") == 0.04


def test_the_delay_of_actions_comes_along(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "a-sac", "delayrl/Counter-v0", 3, (2, 1))
    config = json.loads((run.path / "config.json").read_text())
    (run.path / "config.json").write_text(json.dumps(config | {"delay": "1+action=2"}))
    export_run(run.path, tmp_path / "bundle")
    policy = load_bundle(tmp_path / "bundle")
    assert (policy.action_delay, policy.max_age) == (2, 3)
    assert Controller(policy).action_delay == 2
    older = bundle_of(tmp_path / "older", policy_of("a-sac"))  # which does not say it
    assert load_bundle(older).action_delay == 0


ROW = b'{"step": 120, "policy": "agent", "episode": 0, "reset_seed": 1, "return": 2.0, "length": 3}'


@pytest.mark.parametrize(
    "rows",
    [b'{"step": 1}', b"3", b"\xff\xfe", b"[" * 100_000, ROW.replace(b"120", b"-Infinity")]
    + [ROW.replace(b"2.0", value) for value in (b'"a"', b"null", b"9" * 400, b"NaN")],
)
def test_odd_rows_are_one_line(rows: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(tmp_path / "run", "bpql")
    (run.path / "rows.jsonl").write_bytes(rows + b"\n")
    assert "rows.jsonl" in refused(capsys, "export", str(run.path), "--out", str(tmp_path / "bundle"))


def test_training_may_go_on_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If a checkpoint appears while the newest is read, step and weights still belong to the same one."""
    run = run_of(tmp_path / "run", "bpql")
    latest = RunFolder.latest

    def then_another(self: RunFolder) -> Checkpoint:
        newest = latest(self)
        run.save(newest.step + 120, newest.arrays("agent"), None, {}, complete=True)
        return newest

    monkeypatch.setattr(RunFolder, "latest", then_another)
    assert export_run(run.path, tmp_path / "bundle")["step"] == 240


def test_random_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_of(tmp_path / "run", "random")
    assert "no deterministic policy" in refused(capsys, "export", str(tmp_path / "run"), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_nothing_else_is_overwritten(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "policy.onnx").write_text("mine")
    file = tmp_path / "file"
    file.write_text("mine")
    arguments = ["export", str(run), "--out"]
    assert "is not empty" in refused(capsys, *arguments, str(full))
    assert "holds no bundle" in refused(capsys, *arguments, str(full), "--force")
    assert "not a folder" in refused(capsys, *arguments, str(file), "--force")
    assert "not a run folder" in refused(capsys, "export", str(full), "--out", str(tmp_path / "new"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "full"]
    assert (full / "policy.onnx").read_text() == file.read_text() == "mine"
    for theirs in ('{"format": 1}', '{"format": "esbuild", "policy": {}, "files": {}}', '{"policy": {}', "[]", "\x00"):
        (full / "bundle.json").write_text(theirs)  # of another program
        assert "holds no bundle" in refused(capsys, *arguments, str(full), "--force")
        assert (full / "bundle.json").read_text() == theirs
    assert "is not empty" in refused(capsys, "export", str(tmp_path / "nowhere"), "--out", str(full))  # said first


def test_out_may_be_here(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    export_run(run, ".")
    load_bundle(".")
    assert [file.name for file in tmp_path.iterdir()] == ["here"]


def test_force_replaces_a_bundle_and_follows_no_link(run: Path, tmp_path: Path) -> None:
    out, outside = bundle_of(tmp_path / "bundle", policy_of("bpql")), tmp_path / "outside"
    outside.write_text("mine")
    (out / "policy.onnx").unlink()
    (out / "policy.onnx").symlink_to(outside)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(DelayRLError, match="not empty"):
        export_run(run, out)
    export_run(run, out, force=True)
    assert load_bundle(out).metadata["agent"] == "vdpo"
    assert (out / "notes.txt").read_text() == outside.read_text() == "mine"
    assert not (out / "policy.onnx").is_symlink()


def test_latency(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (ages_of(3), ages_of(5), ages_of(30)) == ([3], [5], [5, 25, 30])
    out = tmp_path / "bundle"
    export_run(run, out)
    main(["latency", str(out), "--decisions", "40", "--period", "100Hz"])
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines()]
    assert [line[0] for line in lines[1:4]] == ["numpy", "onnx", "jax"]
    for line in lines[1:4]:
        assert line[1] == "3"
        p50, p99, most, processor = map(float, line[2:6])
        assert 0 < p50 <= p99 <= most < 10_000
        assert 0 < processor < 10_000
        assert float(line[6].rstrip("%")) == pytest.approx(10 * p99, abs=0.06)
    assert "control period 10 ms" in text
    main(["latency", str(out), "--decisions", "5", "--backend", "numpy", "--ages", "0", "2"])
    text = capsys.readouterr().out
    assert "control period 20 ms" in text
    assert "onnx" not in text


def test_export_without_onnx(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The bundle has no graph and says so. All else works, and --force adds the graph later."""
    out = tmp_path / "bundle"
    with monkeypatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("always")
        patch.setitem(sys.modules, "onnx", None)
        main(["export", str(run), "--out", str(out)])
    err = capsys.readouterr().err
    assert err.startswith(
        "delayrl: the bundle has no policy.onnx, because the package onnx is not installed: pip install"
    )
    assert err.count("\n") == 1
    assert sorted(file.name for file in out.iterdir()) == ["bundle.json", "policy.safetensors"]
    main(["latency", str(out), "--decisions", "5"])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[0] for line in lines[1:4]] == ["numpy", "onnx", "jax"]  # onnx is here again, and runs the weights
    main(["export", str(run), "--out", str(out), "--force"])
    assert (out / "policy.onnx").exists()


@pytest.mark.parametrize("name", ["safetensors", "numpy", "json"])
def test_a_module_beside_the_bundle_is_not_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = bundle_of(tmp_path / "bundle", policy_of("bpql"))
    (out / f"{name}.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')")
    monkeypatch.chdir(out)
    assert latency(".", "numpy", decisions=1)
    assert not (tmp_path / "executed").exists()


def test_latency_refuses(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bundle"
    export_run(run, out)
    for options, message in (
        (["--period", "0ms"], "must be above 0; got 0 s"),
        (["--period", "20"], "a time such as 20ms, 0.02s or 50Hz; got '20'"),
        (["--decisions", "0"], "decisions must lie"),
        (["--ages", "9", "--backend", "numpy"], "ages 0..3; got 9"),
        (["--backend", "torch"], "invalid choice"),
    ):
        assert message in refused(capsys, "latency", str(out), *options)


@dataclass(frozen=True)
class Gentle(SAC):
    """Acts half as strongly as its network says."""

    def act(self, state, seen, key, *, explore):
        return 0.5 * super().act(state, seen, key, explore=explore)


def test_a_network_that_does_not_give_the_agents_actions_is_not_written(tmp_path: Path) -> None:
    source = run_of(tmp_path / "run", "bpql").path
    gentle = Gentle(actor_sees="augmented", critic_sees="current")
    with pytest.raises(
        DelayRLError, match=r"`deterministic` does not give .* its `act`: at age 0 it is 0\.\d+ of the r"
    ):
        export_run(source, tmp_path / "bundle", agent=gentle)
    assert not (tmp_path / "bundle").exists()
    export_run(source, tmp_path / "bundle", agent=SAC(actor_sees="augmented", critic_sees="current"))


def test_an_agent_that_samples_in_evaluation_is_exported_by_its_mode(tmp_path: Path) -> None:
    source = run_of(tmp_path / "run", "ad-sac").path
    agent = replace(AGENTS["ad-sac"].presets["small"].agent, evaluation="sample")
    export_run(source, tmp_path / "bundle", agent=agent)
    assert load_bundle(tmp_path / "bundle").metadata["agent"] == "ad-sac"
