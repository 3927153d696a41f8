"""Runs: from the command to rows, stopped and resumed, damaged and refused."""

import inspect
import json
import shutil
import typing
from contextlib import nullcontext
from pathlib import Path

import jax
import numpy as np
import pytest

import delayrl
from conftest import quick
from delayrl.core.precision import FEW
from delayrl.envs.making import make
from delayrl.play.evaluation import Evaluator
from delayrl.play.run import Run
from delayrl.run.condition import resolve
from delayrl.training.actor import Actor
from delayrl.training.checks import check_fit
from delayrl.training.learner import Program
from delayrl.training.seeds import seed_numbers
from own_tasks import failing
from short_runs import arrays, assert_same_networks, newest, train


def test_rows(vdpo: Run) -> None:
    """One for each episode, raw; the reference beside the agent; a start state of its own for each."""
    rows = vdpo.rows()
    assert len(rows) == 3 * 2 * 2
    assert {row["policy"] for row in rows} == {"agent", "reference"}
    assert {row["step"] for row in rows} == {100, 200, 300}
    assert len({row["reset_seed"] for row in rows}) == 6
    assert all(row["length"] == 50 and row["return"] < 0 for row in rows)
    assert all(row["privileged"] and row["protocol"] == "corrected" for row in rows)
    metrics = vdpo.metrics()
    assert metrics == []  # logged every 1000 steps
    assert (vdpo.path / "curve.png").stat().st_size > 5000
    assert set(vdpo.config["versions"]) >= {"jax", "mujoco", "gymnasium", "numpy", "device"}


def test_speed_of_learning(tmp_path: Path, monkeypatch) -> None:
    """Logged from the first update on, beside the speed of the whole run; of an agent that never learns, always."""
    monkeypatch.setattr("delayrl.training.loop.METRICS_EVERY", 20)
    run = train("sac", tmp_path / "run", delay=0, steps=80, random_steps=50, evaluate_every=50)
    rows = run.metrics()
    assert [row["step"] for row in rows] == [20, 40, 60, 80]
    assert all(row["steps_per_second"] > 0 for row in rows)
    assert ["learning_steps_per_second" in row for row in rows] == [False, False, True, True]
    assert ["critic_loss" in row for row in rows] == [False, False, True, True]
    never = train("random", tmp_path / "random", steps=40, evaluate_every=40).metrics()
    assert ["learning_steps_per_second" in row for row in never] == [True, True]


def test_same_seed_same_run(vdpo: Run, tmp_path: Path) -> None:
    again = train("vdpo", tmp_path / "again")
    assert again.rows() == vdpo.rows()
    assert_same_networks(again, vdpo)
    other = train("vdpo", tmp_path / "other", seed=1)
    assert other.rows()[0]["return"] != vdpo.rows()[0]["return"]


@pytest.mark.parametrize("agent", quick(["bpql", "vdpo"], "bpql", slow=["vdpo"]))
def test_threads_change_nothing(agent: str, tmp_path: Path) -> None:
    """Two seeds and their evaluations stepped by three threads: rows and parameters of each as ever."""
    alone = train(agent, tmp_path / "alone", seeds=2)
    beside = train(agent, tmp_path / "beside", seeds=2, threads=3)
    for one, other in zip(alone, beside, strict=True):
        assert one.rows() == other.rows()
        assert_same_networks(one, other)
    with pytest.raises(delayrl.DelayRLError, match="threads must be a whole number, at least 1; got 0"):
        train("bpql", tmp_path / "run", threads=0)
    with pytest.raises(delayrl.DelayRLError, match="threads must be a whole number, at least 1; got '2'"):
        train("bpql", tmp_path / "run", threads="2")


@pytest.mark.parametrize(
    ("delay", "update_after", "first"), [("3", 2, 5), ("3+reward=20", 5, 22), ("3", 60, 60), ("3", 0, 100)]
)
def test_first_update(delay: str, update_after: int, first: int, tmp_path: Path) -> None:
    """At its step, at the end of the random ones if none is given, or as soon as a transition has arrived."""
    options = {"delay": delay, "steps": 200, "random_steps": 100, "update_after": update_after}
    run = train("bpql", tmp_path / "run", **options)
    assert arrays(run)["critic_opt_state.0.count"] == 200 - first + 1


def test_first_update_of_an_agent_that_sees_the_true_state(tmp_path: Path) -> None:
    """It waits for nothing to arrive."""
    options = {"delay": 20, "steps": 200, "random_steps": 100, "update_after": 2, "representation": "mlp"}
    run = train("vdpo", tmp_path / "run", **options)
    counts = {name: int(array) for name, array in arrays(run).items() if name.endswith("critic_opt_state.0.count")}
    assert set(counts.values()) == {200 - 2 + 1}, counts


@pytest.mark.parametrize(
    ("precision", "words"),
    [
        pytest.param("float32", "precision = [HIGHEST, HIGHEST]", marks=pytest.mark.thorough),
        ("bfloat16", "lhs_precision_type = bf16, rhs_precision_type = bf16, accumulation_type = f32"),
    ],
)
def test_precision_of_every_product(precision: str, words: str, tmp_path: Path, monkeypatch) -> None:
    """As it is lowered for a GPU, in one process after runs of other precisions; evaluating is in float32."""
    lowered: list[str] = []
    evaluated: list[str] = []
    learn, act, played = Program.learn, Program.act, Evaluator.__call__

    def products(function, *args, to=lowered, **options) -> None:
        text = function.trace(*args, **options).lower(lowering_platforms=("cuda",)).as_text()
        to.extend(line for line in text.splitlines() if "dot_general" in line)

    def learning(self, learner, pending, keys, last, random_steps):
        hidden = np.stack([stored.hidden for stored in pending[-1]])
        for index in range(len(self.phases)) if last == 100 else ():
            products(self._jitted_update, learner, hidden, keys, np.int32(1), index=index)
        return learn(self, learner, pending, keys, last, random_steps)

    def acting(self, agent, seen, keys, step):
        products(self._jitted_act, agent, seen, keys, np.int32(step)) if step == 100 else None
        return act(self, agent, seen, keys, step)

    def evaluating(self, states, *args):
        inner = self._act

        def watched(*args):
            products(inner, *args, to=evaluated) if int(args[-1]) == 0 else None
            return inner(*args)

        monkeypatch.setattr(self, "_act", watched)
        result = played(self, states, *args)
        monkeypatch.setattr(self, "_act", inner)
        return result

    monkeypatch.setattr(Program, "learn", learning)
    monkeypatch.setattr(Program, "act", acting)
    monkeypatch.setattr(Evaluator, "__call__", evaluating)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    run = train("bpql", tmp_path / "run", steps=101, precision=precision, hidden=[FEW, FEW])
    assert len(run.rows()) == 4
    assert len(lowered) > 25
    assert all(words in line for line in lowered)
    assert len(evaluated) > 5
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in evaluated)


def test_blocks_end_at_evaluations(tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match="multiple of updates_per_call; got 100 and 7"):
        train("bpql", tmp_path / "run", updates_per_call=7)


@pytest.mark.thorough
def test_a_block_may_begin_before_learning_does(tmp_path: Path) -> None:
    """Its own random steps are there to learn from."""
    run = train("bpql", tmp_path / "run", random_steps=50, updates_per_call=100)
    assert newest(run).complete


@pytest.mark.thorough
def test_episodes_that_are_too_short_to_learn_from(tmp_path: Path) -> None:
    """Where the last n_steps - 1 steps of an episode are never drawn, and it has no more."""
    values = {"protocol": "official", "n_steps": 60, "random_steps": 140, "representation": "mlp"}
    values["replay_capacity"] = 60 * 250
    with pytest.raises(delayrl.DelayRLError, match="no episode of Reacher-v5 is long enough"):
        train("vdpo", tmp_path / "run", **values)


def test_runs_from_before_an_option_go_on(tmp_path: Path) -> None:
    """A schedule that says nothing of an option means its default."""
    run = train("random", tmp_path / "run")
    stored = json.loads((run.path / "config.json").read_text())
    for name in ("updates_per_call", "precision"):
        del stored["schedule"][name]
    (run.path / "config.json").write_text(json.dumps(stored))
    assert train("random", tmp_path / "run").rows() == run.rows()
    with pytest.raises(delayrl.DelayRLError, match="another updates_per_call"):
        train("random", tmp_path / "run", updates_per_call=2)


def test_overwrite_touches_only_runs(tmp_path: Path) -> None:
    """Folders of others are refused whole; a run's folder keeps what others put there."""
    mine = tmp_path / "mine"
    (mine / "checkpoints").mkdir(parents=True)
    (mine / "config.json").write_text('{"lr": 1}')
    (mine / "checkpoints" / "best.pt").write_text("x")
    with pytest.raises(delayrl.DelayRLError, match="of another program"):
        train("random", mine, overwrite=True)
    assert (mine / "checkpoints" / "best.pt").exists()
    run = train("random", tmp_path / "run", steps=120)
    (run.path / "episode.gif").write_text("x")
    assert len(train("random", run.path, steps=150, overwrite=True).rows()) == 4
    assert (run.path / "episode.gif").exists()
    with pytest.raises(delayrl.DelayRLError):
        train("random", run.path / "episode.gif", overwrite=True)


def test_damaged_configuration(tmp_path: Path) -> None:
    """Wrong types and missing names are one line."""
    run = train("random", tmp_path / "run", steps=120)
    good = run.config
    for change in ({"agent": ["vdpo"]}, {"env": 3}, {"delay": None}, {"schedule": None}, {"hyperparameters": 7}):
        (run.path / "config.json").write_text(json.dumps(good | change))
        with pytest.raises(delayrl.DelayRLError, match="damaged"):
            delayrl.load(run.path)
    (run.path / "config.json").write_text(json.dumps(good | {"preset": "tiny"}))
    with pytest.raises(delayrl.DelayRLError, match="unknown preset 'tiny'"):
        delayrl.go_on(run.path, 200)
    (run.path / "config.json").write_text(json.dumps({k: v for k, v in good.items() if k not in ("protocol", "seed")}))
    with pytest.raises(delayrl.DelayRLError, match="does not say its protocol and seed: the run cannot go on"):
        delayrl.go_on(run.path, 200)


def test_agents_check_the_schedule(tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match=r"must lie between random_steps \(or update_after\) and steps"):
        train("dida", tmp_path / "dida", expert_steps=400)
    with pytest.raises(delayrl.DelayRLError, match="lifting_end must be no later"):
        train("lifting", tmp_path / "lifting", lifting_end=400)


def test_complete_run_is_given_back(vdpo: Run, monkeypatch) -> None:
    monkeypatch.setattr(Actor, "step", lambda *_: pytest.fail("it trains again"))
    assert train("vdpo", vdpo.path).rows() == vdpo.rows()


def test_several_seeds(tmp_path: Path) -> None:
    """Each seed has its own folder, and the same start states and random steps as when it is trained alone."""
    runs = train("bpql", tmp_path / "group", seeds=[3, 4], steps=150)
    again = train("bpql", tmp_path / "group", seeds=2, seed=3, steps=150)
    assert [run.path for run in again] == [run.path for run in runs]
    assert [run.path.name for run in runs] == ["seed3", "seed4"]
    alone = train("bpql", tmp_path / "alone", seed=4, steps=150)
    assert [run.path for run in train("bpql", tmp_path / "alone", seed=4, seeds=1, steps=150)] == [alone.path]
    for a, b in zip(runs[1].rows(), alone.rows(), strict=True):
        assert a["reset_seed"] == b["reset_seed"]
        np.testing.assert_allclose(a["return"], b["return"], rtol=1e-3)


def test_foreign_checkpoint(vdpo: Run, tmp_path: Path) -> None:
    """Weights of another agent are refused by name and shape, and so is a manifest that leads out of the folder."""
    other = train("bpql", tmp_path / "bpql", steps=150)
    mixed = tmp_path / "mixed"
    shutil.copytree(vdpo.path, mixed)
    shutil.rmtree(mixed / "checkpoints")
    shutil.copytree(other.path / "checkpoints", mixed / "checkpoints")
    with pytest.raises(delayrl.DelayRLError, match="belongs to another agent"):
        delayrl.load(mixed)
    manifest = next((mixed / "checkpoints").glob("*/manifest.json"))
    text = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(text | {"files": {"../../config.json": "0"}}))
    with pytest.raises(delayrl.DelayRLError, match="broken"):
        delayrl.load(mixed)


def test_other_configuration_is_refused(vdpo: Run, tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match="another width"):
        train("vdpo", vdpo.path, width=9)
    with pytest.raises(delayrl.DelayRLError, match="another agent"):
        train("bpql", vdpo.path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("dear reader")
    with pytest.raises(delayrl.DelayRLError, match="not empty"):
        train("bpql", tmp_path / "mine")
    train("bpql", tmp_path / "twice", steps=120)
    assert len(train("bpql", tmp_path / "twice", steps=150, overwrite=True).rows()) == 4


@pytest.mark.parametrize("nth", [1, 9])
def test_full_disk(nth: int, tmp_path: Path, monkeypatch) -> None:
    """One line, no row lost, and the run goes on when there is room."""
    import os

    fsync, calls = os.fsync, 0

    def full(file):
        nonlocal calls
        calls += 1
        if calls == nth:
            raise OSError(28, "No space left on device")
        return fsync(file)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(delayrl.DelayRLError, match="the disk is full"):
        train("bpql", tmp_path / "run")
    monkeypatch.setattr(os, "fsync", fsync)
    whole = train("bpql", tmp_path / "whole")
    assert train("bpql", tmp_path / "run").rows() == whole.rows()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"preset": "huge"}, "unknown preset"),
        ({"widht": 3}, "did you mean width"),
        ({"normalise": True}, "unknown hyperparameter 'normalise'; did you mean observation_norm"),
        ({"from_": "run"}, "unknown hyperparameter 'from_'; did you mean start_from"),
        ({"quiet": True}, "unknown hyperparameter 'quiet'; did you mean progress"),
        ({"lr": 3}, "unknown hyperparameter 'lr'; did you mean learning_rate, actor_learning_rate, critic_"),
        ({"xyz": 3}, "unknown hyperparameter 'xyz'; `delayrl train AGENT --help` lists them"),
        ({"batch_size": 0}, "at least 1"),
        ({"batch_size": 2.5}, "whole number"),
        ({"discount": float("nan")}, "number"),
        ({"representation": "lstm"}, "one of"),
        ({"hidden": [8, -1]}, "at least 1"),
        ({"seed": -1}, "seed"),
        ({"seeds": []}, "a list of different seeds"),
        ({"seeds": [1, 1]}, "a list of different seeds"),
        ({"seeds": [0.5]}, "a seed must be a whole number from 0 to 2147483647; got 0.5"),
        ({"seeds": 2.0}, "a list of different seeds; got 2.0"),
        ({"seed": 1, "seeds": [0, 2]}, r"without seed=; got seed=1, seeds=\[0, 2\]"),
        ({"seeds": "01"}, "a list of different seeds; got '01'"),
        ({"seeds": np.array(3)}, r"a list of different seeds; got array\(3\)"),
        ({"seeds": np.array([[0, 1]])}, r"a seed must be a whole number .*; got \[0, 1\]"),
        ({"seeds": [np.int64(1), 1]}, "a list of different seeds"),
        ({"flatten": "no"}, "flatten is True or False; got 'no'"),
        ({"seed": 1.5}, "a seed must be a whole number from 0 to 2147483647; got 1.5"),
        ({"seed": "0"}, "a seed must be a whole number from 0 to 2147483647; got '0'"),
        ({"seeds": [0, 1], "seed": 3}, "without seed="),
        ({"seeds": [0, -1]}, "a seed must be"),
        ({"seeds": 0}, "seeds must be from 1 to 10,000; got 0"),
        ({"seeds": 10**30}, "seeds must be from 1 to 10,000"),
        ({"device": "tpu"}, "cpu or gpu"),
        ({"replay_capacity": 5}, "at least"),
        (
            {"steps": 99},
            "the first update is at step 100, and the run ends at step 99; give more steps, or fewer random_steps$",
        ),
        ({"steps": 100, "update_every": 101, "clone_every": 102}, "the first update is at step 101"),
        (
            {"steps": 250, "clone_every": 251},
            "a part would learn nothing: its first update is at step 251, and the run",
        ),
        ({"steps": 200, "update_after": 201}, "ends at step 200; give more steps, or a smaller update_after$"),
        ({"log_std_range": [2.0, -20.0]}, "log_std_range is LOW HIGH, with LOW below HIGH; got 2.0, -20.0"),
        ({"track": "paper"}, "tensorboard or wandb"),
    ],
)
def test_bad_values(values: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match=words):
        train("vdpo", tmp_path / "run", **values)


def test_a_folder_is_a_path() -> None:
    with pytest.raises(delayrl.DelayRLError, match="out is the path of a folder; got 3"):
        delayrl.train("bpql", "Pendulum-v1", 2, out=3)  # type: ignore[call-overload]
    with pytest.raises(delayrl.DelayRLError, match="there is no folder None"):
        delayrl.runs(None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("steps", "every", "fits"), [(100, 1, True), (99, 1, False), (119, 40, False), (120, 40, True)]
)
def test_a_run_learns_something(steps: int, every: int, fits: bool) -> None:
    """Updates are due at multiples of `update_every`, from random_steps on; one is enough."""
    values = {"steps": steps, "update_every": every, "random_steps": 100}
    setup, task = resolve("bpql", "Reacher-v5", 3, "small", "corrected", values), make("Reacher-v5", 3, rescale=True)
    with nullcontext() if fits else pytest.raises(delayrl.DelayRLError, match="nothing would be learned"):
        check_fit(setup, task)
    check_fit(resolve("random", "Reacher-v5", 3, "small", "corrected", {"steps": steps}), task)  # never learns
    with pytest.raises(delayrl.DelayRLError, match=r"step 5,000, .* fewer random_steps, or preset small$"):
        check_fit(resolve("a-sac", "Reacher-v5", 3, "paper", "corrected", {"steps": 1500}), task)


@pytest.mark.parametrize("method", ["reset", "step"])
def test_an_environment_that_fails(method: str, tmp_path: Path) -> None:
    with pytest.raises(
        delayrl.DelayRLError, match=f"^Failing failed in {method}: ZeroDivisionError: .*own_tasks.py, line"
    ):
        train("random", tmp_path / "run", env=failing(method))


def test_editors_see_every_argument_of_train() -> None:
    one, several = typing.get_overloads(delayrl.train)
    shown, real = (dict(inspect.signature(function).parameters) for function in (one, delayrl.train))
    assert list(shown) == list(real)
    for name in real:
        assert name == "seeds" or shown[name].annotation == real[name].annotation, name
        assert (shown[name].default is ...) == (real[name].default is not inspect.Parameter.empty), name
    assert several.__annotations__["seeds"] | None == real["seeds"].annotation


def test_seeds_of_numpy() -> None:
    assert seed_numbers(0, np.int64(2)) == [0, 1]
    assert seed_numbers(0, np.arange(3).tolist()) == [0, 1, 2]
    assert {type(number) for number in seed_numbers(np.int64(4), np.int64(2))} == {int}


def test_unknown_agent() -> None:
    with pytest.raises(delayrl.DelayRLError, match="did you mean vdpo"):
        delayrl.train("vpdo", env="Reacher-v5", delay=3)


@pytest.mark.filterwarnings("ignore::delayrl.errors.DelayWarning")
@pytest.mark.thorough
def test_a_delay_as_long_as_the_episode(tmp_path: Path) -> None:
    """The agent is blind after the start, and what it did is still learned from."""
    run = train("a-sac", tmp_path / "run", delay=50, random_steps=110)
    assert {row["length"] for row in run.rows()} == {50}
    assert newest(run).complete
