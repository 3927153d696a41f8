"""Runs: from the command to rows, stopped and resumed, damaged and refused."""

import json
import shutil
import signal
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.core.protocol import OFFICIAL
from delayrl.delays import as_delay
from delayrl.envs import make
from delayrl.play.evaluation import Evaluator, evaluate
from delayrl.run.configuration import override, values_of
from delayrl.run.folder import Run
from delayrl.run.provenance import versions
from delayrl.training.actor import Actor
from delayrl.training.learner import Program
from delayrl.training.loop import hidden_steps
from short_runs import arrays, train


@pytest.fixture(scope="module")
def vdpo(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train("vdpo", tmp_path_factory.mktemp("runs") / "vdpo")


def test_rows(vdpo: Run) -> None:
    """One for each episode, raw; the reference beside the agent; a start state of its own for each."""
    rows = vdpo.read("rows")
    assert len(rows) == 3 * 2 * 2
    assert {row["policy"] for row in rows} == {"agent", "reference"}
    assert {row["step"] for row in rows} == {100, 200, 300}
    assert len({row["reset_seed"] for row in rows}) == 6
    assert all(row["length"] == 50 and row["return"] < 0 for row in rows)
    assert all(row["privileged"] and row["protocol"] == "corrected" for row in rows)
    metrics = vdpo.read("metrics")
    assert metrics == []  # logged every 1000 steps
    assert (vdpo.path / "curve.png").stat().st_size > 5000
    assert set(vdpo.config["versions"]) >= {"jax", "mujoco", "gymnasium", "numpy", "device"}


def test_load_and_act(vdpo: Run) -> None:
    """The loaded policy, in the task's own units, plays what evaluation played."""
    policy = delayrl.load(vdpo.path)
    result = evaluate(vdpo.path, episodes=2, seed=5)
    from delayrl.play.evaluation import HELD_OUT, reset_seed

    env = delayrl.make("Reacher-v5", delay=3)
    for episode in range(2):
        obs, info = env.reset(seed=reset_seed(5, HELD_OUT, episode))
        total, done = 0.0, False
        while not done:
            obs, reward, terminated, truncated, info = env.step(policy.act(obs, info))
            total += float(reward)
            done = terminated or truncated
        np.testing.assert_allclose(total, result["returns"][episode], rtol=1e-3)


def test_policy_in_other_units(tmp_path: Path) -> None:
    """Pendulum's actions lie in ±2: `act` takes and gives them so."""
    run = train("bpql", tmp_path / "run", env="Pendulum-v1", steps=150)
    policy = delayrl.load(run.path)
    env, scaled = delayrl.make("Pendulum-v1", 3), delayrl.make("Pendulum-v1", 3, rescale=True)
    (obs, info), (obs2, info2) = env.reset(seed=1), scaled.reset(seed=1)
    from delayrl.core.views import seen_now

    for _ in range(6):
        action = policy.act(obs, info)
        seen = seen_now(obs2, info2, 3, privileged=False)
        inner = np.asarray(policy.agent.act(policy.state, seen, jax.random.key(0), explore=False))
        np.testing.assert_allclose(action, 2 * inner, atol=1e-4)
        obs, _, _, _, info = env.step(action)
        obs2, _, _, _, info2 = scaled.step(inner)


def test_policy_refuses_what_it_does_not_know(vdpo: Run) -> None:
    policy = delayrl.load(vdpo.path)
    obs, actions = np.zeros(10), np.zeros((9, 2))
    with pytest.raises(delayrl.DelayRLError, match=r"ages 0\.\.3"):
        policy.act(obs, {"age": 4, "actions": actions})
    with pytest.raises(delayrl.DelayRLError, match="size 10"):
        policy.act(obs[:4], {"age": 1, "actions": actions})
    with pytest.raises(delayrl.DelayRLError, match="needs the 3 actions"):
        policy.act(obs, {"age": 3, "actions": actions[:2]})


def test_any_shorter_delay(vdpo: Run) -> None:
    assert len({evaluate(vdpo.path, 2, delay)["mean_return"] for delay in (0, 1, 2, 3)}) == 4
    with pytest.raises(delayrl.DelayRLError, match="up to 3"):
        evaluate(vdpo.path, 2, 4)


def test_same_seed_same_run(vdpo: Run, tmp_path: Path) -> None:
    again = train("vdpo", tmp_path / "again")
    assert again.read("rows") == vdpo.read("rows")
    for name, array in arrays(again).items():
        np.testing.assert_array_equal(array, arrays(vdpo)[name])
    other = train("vdpo", tmp_path / "other", seed=1)
    assert other.read("rows")[0]["return"] != vdpo.read("rows")[0]["return"]


class KilledError(Exception):
    pass


@pytest.mark.parametrize(
    ("agent", "at", "protocol"),
    [("bpql", 260, "official"), *((agent, 237, "corrected") for agent in AGENTS)],
)
def test_killed_and_resumed_is_uninterrupted(agent: str, at: int, protocol: str, tmp_path: Path, monkeypatch) -> None:
    """Bit for bit: rows and parameters, with a replay that has gone round, and an episode cut in its middle."""
    whole = train(agent, tmp_path / "whole", protocol=protocol)
    step = Actor.step
    calls = 0

    def dying(self, action):
        nonlocal calls
        calls += 1
        if calls == at:
            raise KilledError
        return step(self, action)

    monkeypatch.setattr(Actor, "step", dying)
    with pytest.raises(KilledError):
        train(agent, tmp_path / "cut", protocol=protocol)
    monkeypatch.setattr(Actor, "step", step)
    run = Run(tmp_path / "cut")
    assert run.latest().step == at // 100 * 100
    run.append("rows", [{"step": 299, "policy": "agent", "return": 0.0}])  # made after the checkpoint
    with open(run.path / "rows.jsonl", "a") as file:
        file.write('{"step": 299, "pol')
    resumed = train(agent, tmp_path / "cut", protocol=protocol)
    assert resumed.read("rows") == whole.read("rows")
    for name, array in arrays(resumed).items():
        np.testing.assert_array_equal(array, arrays(whole)[name])
    assert not (run.path / "replay").exists()


@pytest.mark.parametrize(("agent", "block"), [("bpql", 1), ("bpql", 4), ("vdpo", 10)])
def test_stopped_between_checkpoints_and_resumed(agent: str, block: int, tmp_path: Path, monkeypatch) -> None:
    """A run that is asked to stop keeps its newest steps and goes on with them, bit for bit."""
    values = {"updates_per_call": block}
    whole = train(agent, tmp_path / "whole", **values)
    step, calls = Actor.step, 0

    def interrupted(self, action):
        nonlocal calls
        calls += 1
        if calls == 157:
            signal.raise_signal(signal.SIGINT)
        return step(self, action)

    monkeypatch.setattr(Actor, "step", interrupted)
    with pytest.raises(delayrl.DelayRLError, match="stopped at step 157"):
        train(agent, tmp_path / "cut", **values)
    assert len(Run(tmp_path / "cut").latest().arrays("loop")["pending.obs"]) == (157 - 1) % block + 1
    resumed = train(agent, tmp_path / "cut", **values)
    assert resumed.read("rows") == whole.read("rows")
    for name, array in arrays(resumed).items():
        np.testing.assert_array_equal(array, arrays(whole)[name])


def test_threads_change_nothing(tmp_path: Path) -> None:
    """Two seeds and their evaluations stepped by three threads: rows and parameters of each as ever."""
    alone = train("vdpo", tmp_path / "alone", seeds=2)
    beside = train("vdpo", tmp_path / "beside", seeds=2, threads=3)
    for one, other in zip(alone, beside, strict=True):
        assert one.read("rows") == other.read("rows")
        for name, array in arrays(one).items():
            np.testing.assert_array_equal(array, arrays(other)[name])
    with pytest.raises(delayrl.DelayRLError, match="threads must be at least 1; got 0"):
        train("bpql", tmp_path / "run", threads=0)


@pytest.mark.parametrize(
    ("precision", "words"),
    [
        ("float32", "precision = [HIGHEST, HIGHEST]"),
        ("bfloat16", "lhs_precision_type = bf16, rhs_precision_type = bf16, accumulation_type = f32"),
    ],
)
def test_precision_of_every_product(precision: str, words: str, tmp_path: Path, monkeypatch) -> None:
    """As it is lowered for a GPU: learning, acting and evaluating, in one process after runs of other precisions."""
    lowered: list[str] = []
    learn, act, played = Program.learn, Program.act, Evaluator.__call__

    def products(function, *args, **options) -> None:
        text = function.trace(*args, **options).lower(lowering_platforms=("cuda",)).as_text()
        lowered.extend(line for line in text.splitlines() if "dot_general" in line)

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
            products(inner, *args) if int(args[-1]) == 0 else None
            return inner(*args)

        monkeypatch.setattr(self, "_act", watched)
        result = played(self, states, *args)
        monkeypatch.setattr(self, "_act", inner)
        return result

    monkeypatch.setattr(Program, "learn", learning)
    monkeypatch.setattr(Program, "act", acting)
    monkeypatch.setattr(Evaluator, "__call__", evaluating)
    run = train("bpql", tmp_path / "run", steps=101, precision=precision)
    assert len(run.read("rows")) == 4
    assert len(lowered) > 30
    assert all(words in line for line in lowered)


def test_a_policy_is_evaluated_in_single_precision(vdpo: Run, monkeypatch) -> None:
    """`evaluate` too, where a GPU would multiply more coarsely."""
    played, found = Evaluator.__call__, []

    def watched(self, *args):
        found.append(jax.config.jax_default_matmul_precision)
        return played(self, *args)

    monkeypatch.setattr(Evaluator, "__call__", watched)
    evaluate(vdpo.path, 1)
    assert found == ["float32"]


def test_the_device_that_is_written_down_is_the_one_in_use(monkeypatch) -> None:
    """`--device cpu` where there is a GPU too."""
    cpu = jax.devices("cpu")[0]
    monkeypatch.setattr(jax, "devices", lambda *_: [SimpleNamespace(device_kind="GPU")])
    with jax.default_device(cpu):
        assert versions()["device"] == "cpu"


def test_blocks_end_at_evaluations(tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match="multiple of updates_per_call; got 100 and 7"):
        train("bpql", tmp_path / "run", updates_per_call=7)


def test_a_block_may_begin_before_learning_does(tmp_path: Path) -> None:
    """Its own random steps are there to learn from."""
    run = train("bpql", tmp_path / "run", random_steps=50, updates_per_call=100)
    assert run.latest().complete


def test_episodes_that_are_too_short_to_learn_from(tmp_path: Path) -> None:
    """Where the last n_steps - 1 steps of an episode are never drawn, and it has no more."""
    values = {"protocol": "official", "n_steps": 60, "random_steps": 140, "representation": "mlp"}
    with pytest.raises(delayrl.DelayRLError, match="no episode of Reacher-v5 is long enough"):
        train("vdpo", tmp_path / "run", **values)


def test_runs_from_before_an_option_go_on(tmp_path: Path) -> None:
    """A schedule that says nothing of an option means its default."""
    run = train("random", tmp_path / "run")
    stored = json.loads((run.path / "config.json").read_text())
    for name in ("updates_per_call", "precision"):
        del stored["schedule"][name]
    (run.path / "config.json").write_text(json.dumps(stored))
    assert train("random", tmp_path / "run").read("rows") == run.read("rows")
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
    assert len(train("random", run.path, steps=150, overwrite=True).read("rows")) == 4
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


def test_agents_check_the_schedule(tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match="expert_steps must lie between"):
        train("dida", tmp_path / "dida", expert_steps=400)
    with pytest.raises(delayrl.DelayRLError, match="lifting_end must be no later"):
        train("lifting", tmp_path / "lifting", lifting_end=400)


def test_complete_run_is_given_back(vdpo: Run, monkeypatch) -> None:
    monkeypatch.setattr(Actor, "step", lambda *_: pytest.fail("it trains again"))
    assert train("vdpo", vdpo.path).read("rows") == vdpo.read("rows")


def test_several_seeds(tmp_path: Path) -> None:
    """Each seed has its own folder, and the same start states and random steps as when it is trained alone."""
    runs = train("a-sac", tmp_path / "group", seeds=2, seed=3, steps=150)
    assert [run.path.name for run in runs] == ["seed3", "seed4"]
    alone = train("a-sac", tmp_path / "alone", seed=4, steps=150)
    for a, b in zip(runs[1].read("rows"), alone.read("rows"), strict=True):
        assert a["reset_seed"] == b["reset_seed"]
        np.testing.assert_allclose(a["return"], b["return"], rtol=1e-3)


def test_broken_checkpoint_falls_back(tmp_path: Path, monkeypatch) -> None:
    """A cut file is named, and the checkpoint before it is used; with none left the run says so."""
    step, calls = Actor.step, 0

    def dying(self, action):
        nonlocal calls
        calls += 1
        if calls == 250:
            raise KilledError
        return step(self, action)

    monkeypatch.setattr(Actor, "step", dying)
    with pytest.raises(KilledError):
        train("bpql", tmp_path / "run")
    monkeypatch.setattr(Actor, "step", step)
    run = Run(tmp_path / "run")
    newest = run.latest().path / "agent.safetensors"
    newest.write_bytes(newest.read_bytes()[:-100])
    good, broken = run.checkpoints()
    assert [c.step for c in good] == [100]
    assert "agent.safetensors is cut or changed" in broken[0]
    backup = tmp_path / "backup"
    shutil.copytree(run.path, backup)
    whole = train("bpql", tmp_path / "whole")
    assert train("bpql", run.path).read("rows") == whole.read("rows")
    (Run(backup).latest().path / "manifest.json").write_text("{")
    with pytest.raises(delayrl.DelayRLError, match="no good checkpoint"):
        train("bpql", backup)
    with pytest.raises(delayrl.DelayRLError, match="broken"):
        delayrl.load(backup)


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
    assert len(train("bpql", tmp_path / "twice", steps=150, overwrite=True).read("rows")) == 4


@pytest.mark.parametrize("what", ["reward", "observation"])
def test_nan_from_the_environment(what: str, tmp_path: Path, monkeypatch) -> None:
    """The run stops with one line; its last good checkpoint stays, and goes on when the environment is mended."""
    from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv

    step, calls = ReacherEnv.step, 0

    def nan(self, action):
        nonlocal calls
        calls += 1
        obs, reward, *rest = step(self, action)
        if calls > 250:  # 100 steps, 100 of evaluation, and then 50
            obs, reward = (obs * np.nan, reward) if what == "observation" else (obs, np.nan)
        return obs, reward, *rest

    monkeypatch.setattr(ReacherEnv, "step", nan)
    with pytest.raises(delayrl.DelayRLError, match=f"{what} that is not finite"):
        train("bpql", tmp_path / "run")
    monkeypatch.setattr(ReacherEnv, "step", step)
    assert Run(tmp_path / "run").latest().step >= 100
    assert train("bpql", tmp_path / "run").latest().step == 300


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
    assert train("bpql", tmp_path / "run").read("rows") == whole.read("rows")


def test_official_protocol(tmp_path: Path) -> None:
    """One start state for all episodes, time limits as terminations, a random first action: stated in every row."""
    run = train("a-sac", tmp_path / "run", protocol="official", steps=150)
    rows = run.read("rows")
    assert {row["reset_seed"] for row in rows} == {0}
    assert {row["protocol"] for row in rows} == {"official"}
    assert len({row["return"] for row in rows if row["step"] == 100}) == 2  # the first actions differ
    actor = Actor(make("Reacher-v5", 3, rescale=True), 7, privileged=False, protocol=OFFICIAL)
    first = actor.truth
    steps = [actor.step(np.zeros(2, np.float32)) for _ in range(50)]
    assert steps[-1].done
    assert steps[-1].terminated
    np.testing.assert_array_equal(actor.truth, first)


def test_options_round_trip() -> None:
    """What a run writes down rebuilds its agent."""
    for entry in AGENTS.values():
        for preset in entry.presets.values():
            assert override(preset.agent, values_of(preset.agent)) == preset.agent


@pytest.mark.parametrize("agent", list(AGENTS))
def test_unprivileged_agents_are_not_given_the_truth(agent: str) -> None:
    preset = AGENTS[agent].presets["small"]
    delay = as_delay(0 if agent == "sac" else 3)
    actor = Actor(make("Reacher-v5", delay, rescale=True), 0, preset.agent.privileged)
    for _ in range(5):
        actor.step(np.zeros(2, np.float32))
    assert (actor.seen.truth is not None) == preset.agent.privileged
    assert hidden_steps(actor, delay) == (0 if preset.agent.privileged else actor.seen.age)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"preset": "huge"}, "unknown preset"),
        ({"widht": 3}, "did you mean width"),
        ({"batch_size": 0}, "at least 1"),
        ({"batch_size": 2.5}, "whole number"),
        ({"discount": float("nan")}, "number"),
        ({"representation": "lstm"}, "one of"),
        ({"hidden": [8, -1]}, "at least 1"),
        ({"seed": -1}, "seed"),
        ({"device": "tpu"}, "cpu or gpu"),
        ({"replay_capacity": 5}, "at least"),
        ({"track": "paper"}, "tensorboard or wandb"),
    ],
)
def test_bad_values(values: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match=words):
        train("vdpo", tmp_path / "run", **values)


def test_unknown_agent() -> None:
    with pytest.raises(delayrl.DelayRLError, match="did you mean vdpo"):
        delayrl.train("vpdo", env="Reacher-v5", delay=3)


def test_training_shows_what_the_wrapper_shows() -> None:
    """Actions are stored as they were executed: the history that the actor sees is in [-1, 1], bit for bit."""
    actor = Actor(make("Pusher-v5", 3, rescale=True), 0, privileged=False)
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1, 1, 7).astype(np.float32) for _ in range(5)]
    for action in actions:
        actor.step(action)
    np.testing.assert_array_equal(actor.seen.actions, actions[-3:])
