"""Tasks of a user are trained, resumed, evaluated, loaded and exported; in grids and from the command line too."""

import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeReward
from PIL import Image

import delayrl
from delayrl.bench.grid import load_grid
from delayrl.cli.main import main
from delayrl.deploy import load_bundle
from delayrl.errors import DelayRLError
from delayrl.measure import probe
from delayrl.play.evaluation import evaluate
from delayrl.run.condition import resolve
from delayrl.run.folder import RunFolder
from own_tasks import LIMIT, Arm, Camera, make_arm, write_module
from short_runs import SHRINK, assert_same_networks, killed_and_resumed, train

LENGTH = ["--steps", "240", "--random-steps", "100", "--evaluate-every", "120", "--evaluation-episodes", "2"]
LENGTH += ["--replay-capacity", "250", "--quiet"]


def test_a_run_names_its_task(tmp_path: Path) -> None:
    """By one text, in its configuration, its rows and its folder; class and text are one condition."""
    values: dict[str, Any] = {"env_kwargs": {"gain": 0.5}, "wrappers": [LIMIT, Camera], "flatten": True}
    run = train("random", tmp_path / "run", env=Arm, **values)
    text = f"own_tasks:Arm(gain=0.5) | {LIMIT} | own_tasks:Camera | flatten"
    assert run.config["env"] == text
    assert {row["env"] for row in run.rows()} == {text}
    assert train("random", tmp_path / "run", env=text).path == run.path
    ids = [resolve("bpql", env, 3, "small", "corrected", {}).cell_id([0]) for env in (Arm, "own_tasks:Arm", make_arm)]
    assert ids[0] == ids[1] != ids[2]
    with pytest.raises(DelayRLError, match="holds a run with another env"):
        train("random", tmp_path / "run", env=Arm, **{**values, "env_kwargs": {"gain": 0.25}})
    result = evaluate(run.path, 2)
    assert result["env"] == text
    assert evaluate(run.path, 2, env_kwargs={"gain": 0})["returns"] != result["returns"]
    RunFolder(run.path).create(run.config | {"env": "own_tasks:Arm"})
    with pytest.raises(DelayRLError, match=r"own_tasks:Arm has no time limit.*behind a \| in the task"):
        evaluate(run, 2)
    assert evaluate(run, 2, env=text)["returns"] == result["returns"]


class Unseeded(Arm):
    """An arm that begins anywhere, whatever its seed."""

    def reset(self, **options: Any) -> Any:
        return super().reset(**options | {"seed": None})


def test_a_task_that_ignores_its_seed_is_named_at_the_start(tmp_path: Path) -> None:
    """Not hours later, when the run is stopped and cannot go on."""
    line = "Unseeded does not begin an episode twice in the same way from one seed .* cannot go on after a stop"
    with pytest.warns(delayrl.DelayWarning, match=line):
        train("random", tmp_path / "run", env=Unseeded, wrappers=[LIMIT])


class Shaky(Arm):
    """An arm whose steps draw from NumPy's global generator."""

    def step(self, action: Any) -> Any:
        return super().step(action + np.random.uniform(-0.1, 0.1, 1))  # noqa: NPY002


@pytest.mark.parametrize(("env", "wrappers"), [(Shaky, [LIMIT]), (Arm, [NormalizeReward, LIMIT])])
def test_steps_and_rewards_that_are_not_repeated_are_named_too(env: Any, wrappers: list, tmp_path: Path) -> None:
    """A resumed run would silently be another one where rewards alone differ."""
    with pytest.warns(delayrl.DelayWarning, match="does not begin an episode twice in the same way from one seed"):
        train("random", tmp_path / "run", env=env, wrappers=wrappers)


def test_a_stopped_run_whose_rewards_are_not_repeated_does_not_go_on(tmp_path: Path, monkeypatch) -> None:
    """Within an episode, of which a checkpoint here lies in the middle. Observations alone would not show it."""
    options: dict[str, Any] = {"env": Arm, "wrappers": [NormalizeReward, LIMIT], "evaluate_every": 75}
    with (
        pytest.warns(delayrl.DelayWarning),
        pytest.raises(DelayRLError, match="does not repeat an episode from its seed"),
    ):
        killed_and_resumed("random", tmp_path / "run", monkeypatch, **options)


def test_environments_are_closed(tmp_path: Path) -> None:
    """Whoever makes one, also where nothing is played. An environment may hold a window, a process or a robot."""
    open_now: set[int] = set()

    class Held(Arm):
        def __init__(self) -> None:
            super().__init__()
            open_now.add(id(self))

        def close(self) -> None:
            open_now.discard(id(self))
            raise RuntimeError("the port is gone")

    held = lambda: gym.wrappers.TimeLimit(Held(), 50)  # noqa: E731
    run = train(SHRINK, tmp_path / "run", env=held, seeds=2)[0]
    assert not open_now
    evaluate(run, 2, env=held)
    delayrl.load(run, held)
    delayrl.export_run(run, tmp_path / "bundle", env=held)
    probe(held, episodes=2)
    assert not open_now

    def two_at_most() -> gym.Env:
        if len(open_now) == 2:
            raise RuntimeError("no third")
        return held()

    with pytest.raises(DelayRLError, match="RuntimeError: no third"):
        train(SHRINK, tmp_path / "three", env=two_at_most, seeds=3)
    assert not open_now
    other = train("random", tmp_path / "other", env="Pendulum-v1", steps=200)
    with pytest.raises(DelayRLError, match="the policy takes observations of size 3"):
        evaluate(other.policy(), 2, env=held)
    assert not open_now


def test_a_function_without_a_name_is_given_again(tmp_path: Path, monkeypatch) -> None:
    """Trained, killed, resumed and evaluated with the same function, it gives what a named one gives."""
    maker = functools.partial(make_arm)
    run = killed_and_resumed(SHRINK, tmp_path / "partial", monkeypatch, env=maker, env_kwargs={"gain": 0.5})
    named = train(SHRINK, tmp_path / "named", env="own_tasks:make_arm(gain=0.5)")
    assert (run.config["env"], named.config["env"]) == ("<partial>(gain=0.5)", "own_tasks:make_arm(gain=0.5)")
    assert_same_networks(named, run)
    for call in (lambda: delayrl.load(run.path), lambda: evaluate(run.path)):
        with pytest.raises(DelayRLError, match="<partial> has no name"):
            call()
    assert evaluate(run.path, 3, env=maker)["returns"] == evaluate(named.path, 3)["returns"]
    policy, info = delayrl.load(run.path, maker), {"age": 0, "actions": np.zeros((3, 1))}
    np.testing.assert_array_equal(policy.act(np.ones(1), info), delayrl.load(named.path).act(np.ones(1), info))


def test_a_task_without_a_limit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DelayRLError, match=r"own_tasks:Arm has no time limit.*TimeLimit\(max_episode_steps"):
        train("random", tmp_path / "run", env=Arm)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("outcome", "line"),
    [
        ((np.zeros(2), 0.0, False, False), r"Arm gave an observation of shape \(2,\), but its .* has \(1,\)"),
        ((np.zeros(1), np.zeros(2), False, False), r"Arm gave the reward array\(\[0., 0.\]\), terminated = False"),
        ((np.zeros(1), None, False, False), "Arm gave the reward None, .* a number and two truth values"),
        ((np.zeros(1), 0.0, np.zeros(2, bool), False), r"terminated = array\(\[False, False\]\)"),
    ],
)
@pytest.mark.parametrize("when", ["training", "evaluation"])
def test_what_no_environment_gives(when: str, outcome: tuple, line: str, tmp_path: Path, monkeypatch) -> None:
    run = train("random", tmp_path / "run", env=make_arm) if when == "evaluation" else None
    monkeypatch.setattr(Arm, "step", lambda self, action: (*outcome, {}))
    with pytest.raises(DelayRLError, match=line):
        evaluate(run.path, 2, env=make_arm) if run else train("random", tmp_path / "run", env=make_arm)


def test_from_the_command_line(tmp_path: Path, monkeypatch, capsys) -> None:
    """In a process of its own, which has no path to the module but its working folder."""
    write_module(tmp_path, "my_cli_arm")
    monkeypatch.chdir(tmp_path)
    words = ["--env", "my_cli_arm:Arm", "--env-kwargs", "gain=0.5", "names=left", "--wrapper", LIMIT]
    words += ["--wrapper", "my_cli_arm:Camera(offset=2)", "--flatten", "--delay", "3"]
    console = "import sys; sys.path.remove(''); from delayrl.cli.main import main; main()"
    command = [sys.executable, "-W", "ignore", "-c", console]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}

    def program(*arguments: str) -> str:
        done = subprocess.run([*command, *arguments], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    program("train", "random", *words, *LENGTH, "--preset", "small", "--out", "run")
    text = f'my_cli_arm:Arm(gain=0.5, names="left") | {LIMIT} | my_cli_arm:Camera(offset=2) | flatten'
    assert json.loads((tmp_path / "run/config.json").read_text())["env"] == text
    assert json.loads(program("evaluate", "run", "--episodes", "2", "--json"))["env"] == text
    main(["evaluate", "run", "--episodes", "2", "--json", "--env", "own_tasks:Arm", "--env-kwargs", "gain=0"])
    result = json.loads(capsys.readouterr().out)
    assert result["env"] == text.replace("my_cli_arm:Arm(gain=0.5", "own_tasks:Arm(gain=0")
    main(["measure", "own_tasks:Arm", "--wrapper", LIMIT, "--json", "--episodes", "2", "--longest", "10"])
    assert json.loads(capsys.readouterr().out)["maximum"] == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--env-kwargs", "gain"], "are written NAME=VALUE, e.g. gain=2; got 'gain'"),
        (["--env-kwargs", "2=gain"], "are written NAME=VALUE"),
        (["--env-kwargs", "gian=2"], "unexpected keyword argument 'gian'"),
        (["--wrapper", "Camera"], "a wrapper is named module:Class"),
        (["--wrapper", "own_tasks:Camera"], "--flatten"),
    ],
)
def test_bad_words(words: list[str], line: str, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["train", "random", "--env", "own_tasks:Arm", *words])
    err = capsys.readouterr().err
    assert line in err
    assert err.count("\n") == 1


def test_in_a_grid(tmp_path: Path) -> None:
    """The keys are of the grid or of a product; a cell's task is the same text, and so the same cell, as by hand."""
    file = tmp_path / "mine.toml"
    file.write_text(f"""
agents = ["random"]
tasks = ["own_tasks:Arm"]
delays = [3]
preset = "small"
wrappers = ["{LIMIT}"]
[[product]]
env_kwargs = {{ gain = 2, names = ["a"] }}
[[product]]
wrappers = ["{LIMIT}", "own_tasks:Camera"]
flatten = true
[[product]]
tasks = ['own_tasks:Arm(gain=1.5)']
""")
    cells = load_grid(file).cells
    texts = [
        f'own_tasks:Arm(gain=2, names=["a"]) | {LIMIT}',
        f"own_tasks:Arm | {LIMIT} | own_tasks:Camera | flatten",
        f"own_tasks:Arm(gain=1.5) | {LIMIT}",
    ]
    assert [cell.condition.env for cell in cells] == texts
    assert [cell.id for cell in cells] == [
        resolve("random", text, 3, "small", "corrected", {}).cell_id([0]) for text in texts
    ]
    assert all(len(cell.folder) < 200 for cell in cells)
    file.write_text(file.read_text().replace("flatten = true", "flatten = 1"))
    with pytest.raises(DelayRLError, match="flatten must be true or false"):
        load_grid(file)


def test_a_bundle_of_an_own_task(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    from delayrl.deploy import export_run

    run = train(SHRINK, tmp_path / "run", env=lambda **kwargs: make_arm(**kwargs))
    with pytest.raises(DelayRLError, match="<lambda> has no name"):
        export_run(run.path, tmp_path / "bundle")
    metadata = export_run(run.path, tmp_path / "bundle", env=make_arm)
    assert metadata["env"] == "<lambda>"
    policy, info = delayrl.load(run.path, make_arm), {"age": 1, "actions": np.full((3, 1), 0.5)}
    action = load_bundle(tmp_path / "bundle")(np.ones(1), info["actions"], 1)
    np.testing.assert_allclose(action, policy.act(np.ones(1), info), atol=1e-5)


def test_the_page_on_own_tasks(tmp_path: Path, monkeypatch) -> None:
    """Its Python runs as it stands: the first block is the module that the others import."""
    page = (Path(__file__).parents[2] / "docs" / "own-task.md").read_text()
    module, *blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(write_module(tmp_path, "arm", module))
    monkeypatch.syspath_prepend(tmp_path)
    assert len(blocks) == 2
    for block in blocks:
        exec(block.replace("steps=3000", "steps=1500, evaluate_every=750"), {})
    assert {path.parent.parent.name for path in Path("runs").glob("*/*/*")} == {
        "arm-make-gain=0.2-delay4",
        "lambda-gain=0.2-delay4",
    }
    delayrl.watch(Path("runs/arm-make-gain=0.2-delay4/bpql-small/seed0"), "arm.gif")
    with Image.open("arm.gif") as file:
        assert (file.size, file.n_frames > 30) == ((240, 240), True)
    arm = sys.modules.pop("arm").Arm(render_mode="rgb_array")
    for angle, end in ((0, (25, 120)), (np.pi / 2, (120, 215)), (-np.pi / 2, (120, 25))):
        arm.angle = np.array([angle])
        black = arm.render()[..., 0] == 0
        assert [bool(black[at]) for at in ((25, 120), (120, 215), (120, 25))] == [
            at == end for at in ((25, 120), (120, 215), (120, 25))
        ]
