"""Every way to name a task makes the same environment, and what the user's own code raises is what is reported."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.spaces import Box
from gymnasium.wrappers import NormalizeObservation, RepeatAction, TimeLimit

import delayrl
import own_tasks
from delayrl.envs.making import delay_of, make
from delayrl.envs.task import Part, Task, as_task, closing_quietly, stored_task
from delayrl.errors import DelayRLError, DelayWarning
from delayrl.play import stepping
from delayrl.run.condition import resolve
from delayrl.wrappers import layers
from delayrl.wrappers.layers import limit_of, seconds_of
from own_tasks import LIMIT, Arm, Camera, make_arm, write_module

# ------------------------------------------------------------------------------------------------ the text


@pytest.mark.parametrize(
    ("text", "task"),
    [
        ("Pendulum-v1", Task(Part("Pendulum-v1"))),
        ("Pendulum-v1()", Task(Part("Pendulum-v1"))),
        (" a:B ( y=2 , x=[{}] )|m:W|flatten ", Task(Part("a:B", {"x": [{}], "y": 2}), (Part("m:W"), Part("flatten")))),
        ('a:B(text=")|(=, b=1", no=null)', Task(Part("a:B", {"text": ")|(=, b=1", "no": None}))),
        ("<lambda>(gain=2) | m:W(on=true)", Task(Part("<lambda>", {"gain": 2}), (Part("m:W", {"on": True}),))),
    ],
)  # fmt: skip
def test_a_text_is_read_and_written(text: str, task: Task) -> None:
    assert as_task(text) == task
    assert as_task(str(task)) == task
    assert " ".join(str(as_task(str(task))).split()) == str(task)


@pytest.mark.parametrize("text", ["", " ", "a(", "a(b)", "a(b=c)", "a |", "|a", "a)b", "a(b=1", "a(b=1)c", "a(b=1 2)"])
def test_texts_of_no_task(text: str) -> None:
    with pytest.raises(DelayRLError, match="cannot read the task"):
        as_task(text)


def test_an_id_without_a_version_gets_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs and rows name it: in another release of Gymnasium the newest may be another task."""
    named = {name: gym.registry["Pendulum-v1"] for name in ("Arm-v9", "Arm-v10", "Arm-view", "Arms-v11", "my/Arm-v12")}
    monkeypatch.setattr(gym, "registry", named | {"Leg": gym.registry["Pendulum-v1"], "Leg-v0": None})
    assert str(as_task("Arm(g=5) | flatten")) == "Arm-v10(g=5) | flatten"
    assert str(as_task("my/Arm")) == "my/Arm-v12"
    assert str(as_task("Leg")) == "Leg"
    with pytest.raises(DelayRLError, match="unknown task 'Ar'"):
        as_task("Ar").make()


def test_the_order_of_arguments_does_not_matter() -> None:
    assert str(as_task("a:B(y=1)", {"x": 2})) == str(as_task("a:B", {"x": 2, "y": 1})) == "a:B(x=2, y=1)"
    assert str(as_task("a:B(x=1)", {"x": 2})) == "a:B(x=2)"


def test_names_of_objects_and_specs() -> None:
    class Local(Arm):
        pass

    usual = gym.spec("Pendulum-v1")
    other = gym.envs.registration.EnvSpec("Mine-v0", entry_point=PendulumEnv, max_episode_steps=7)
    names = {
        "own_tasks:Arm": Arm,
        "own_tasks:make_arm": make_arm,
        "<Local>": Local,
        "<lambda>": lambda: Arm(),
        "Pendulum-v1": usual,
        "Pendulum-v1(g=3.0)": gym.make("Pendulum-v1", g=3.0).spec,
        "<Mine-v0>": other,
    }
    assert {name: str(as_task(thing)) for name, thing in names.items()} == {name: name for name in names}
    assert delayrl.make(other, 1).spec.max_episode_steps == 7
    assert str(as_task(Arm, wrappers=[Camera], flatten=True)) == "own_tasks:Arm | own_tasks:Camera | flatten"
    assert str(as_task("X-v0 | flatten", flatten=True)) == "X-v0 | flatten"


# ------------------------------------------------------------------------------------------------ making


def played(env: Any) -> np.ndarray:
    """The position after each of three actions, from one start."""
    env.reset(seed=3)
    return np.array([env.step(np.array([a], np.float32))[0] for a in (0.5, -1.0, 0.25)])


@pytest.mark.parametrize(
    "env",
    [
        "own_tasks:Arm",
        "own_tasks:make_arm",
        Arm,
        make_arm,
        lambda **kwargs: Arm(**kwargs),
        gym.envs.registration.EnvSpec("Arm-v0", entry_point=Arm, max_episode_steps=20),
        gym.envs.registration.EnvSpec("Arm-v0", entry_point="own_tasks:Arm"),
    ],
)
def test_all_names_make_one_environment(env: Any) -> None:
    """With the keyword arguments: positions are start + gain · (sum of the actions)."""
    start = Arm().reset(seed=3)[0]
    for gain in (1, 2.5):
        expected = start + gain * np.cumsum([0.5, -1.0, 0.25])[:, None]
        np.testing.assert_allclose(played(delayrl.make(env, env_kwargs={"gain": gain})), expected)
        np.testing.assert_allclose(played(delayrl.make(env, gain=gain)), expected)
    late = played(delayrl.make(env, 2))
    np.testing.assert_allclose(late, np.array([start, start, start + 0.5]))


def test_arguments_are_what_a_loaded_run_gets() -> None:
    """A tuple is a list already before it is stored."""
    task = as_task(Arm, {"names": ("a", 1)})
    assert task.make().names == as_task(str(task)).make().names == ["a", 1]


def test_wrappers_and_flat_observations() -> None:
    """Innermost first, each with its arguments; flattening equals Gymnasium's, outside all of them."""
    with pytest.raises(DelayRLError, match=r"flat vectors; got Dict.*--flatten"):
        delayrl.make(Arm, wrappers=[Camera])
    env = delayrl.make(Arm, 1, wrappers=[LIMIT, "own_tasks:Camera(offset=7)"], flatten=True)
    obs, _ = env.reset(seed=3)
    x = float(Arm().reset(seed=3)[0][0])
    np.testing.assert_allclose(obs, [2 * x, 2 * x, x, 7])
    nested = Camera(Arm(), 7)
    np.testing.assert_array_equal(obs, gym.spaces.flatten(nested.observation_space, nested.reset(seed=3)[0]))
    assert isinstance(env.env.env, Camera)
    assert isinstance(env.env.env.env, TimeLimit)
    ends = [env.step(env.action_space.sample())[3] for _ in range(20)]
    assert ends == [False] * 19 + [True]


def test_one_wrapper_needs_no_list() -> None:
    assert as_task(Arm, wrappers=Camera) == as_task(Arm, wrappers=[Camera]) == as_task(Arm, wrappers="own_tasks:Camera")


def test_an_option_of_make_in_other_letters() -> None:
    line = r"TypeError: .*unexpected keyword argument 'normalize'; did you mean normalise\?$"
    with pytest.raises(DelayRLError, match=line) as error:
        delayrl.make(Arm, 1, normalize=True)
    assert isinstance(error.value.__cause__, TypeError)


def test_normalised_observations() -> None:
    """As Gymnasium's wrapper between task and delay, outside of flattening; its moments can be read and stopped."""
    ours = delayrl.make(Arm, 2, wrappers=[LIMIT, Camera], flatten=True, normalise=True)
    theirs = delayrl.Delayed(NormalizeObservation(as_task(Arm, {}, [LIMIT, Camera], True).make()), 2)
    shown = []
    for env in (ours, theirs):
        env.action_space.seed(0)
        shown.append([env.reset(seed=0)[0], *(env.step(env.action_space.sample())[0] for _ in range(9))])
    np.testing.assert_array_equal(*shown)
    moments = ours.get_wrapper_attr("obs_rms")
    assert (moments.mean.shape, round(moments.count)) == ((4,), 10)
    ours.set_wrapper_attr("update_running_mean", False)
    ours.step(ours.action_space.sample())
    assert round(moments.count) == 10


def test_the_least_time_limit_counts() -> None:
    longer = TimeLimit(gym.make("Pendulum-v1"), 1000)
    assert limit_of(longer) == limit_of(TimeLimit(longer, 2000)) == 200
    assert limit_of(TimeLimit(longer, 50)) == 50


def test_the_limit_of_an_environment_without_a_spec() -> None:
    """A late termination waits no longer than the time limit, and no delay is longer than an episode."""

    class Ends(Arm):
        def step(self, action: np.ndarray) -> Any:
            obs, reward, _, truncated, info = super().step(action)
            return obs, reward, True, truncated, info

    env = delayrl.make(Ends, "1+reward=10")
    env.reset(seed=0)
    assert [any(env.step(env.action_space.sample())[2:4]) for _ in range(11)] == [False] * 10 + [True]
    limited = "gymnasium.wrappers:TimeLimit(max_episode_steps=12)"
    env = delayrl.make(Ends, "1+reward=12", wrappers=[limited])
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(12)]
    assert ends == [(False, False)] * 11 + [(True, True)]
    with pytest.raises(DelayRLError, match="13 steps is longer than an episode of Ends \\(12 steps\\)"):
        delayrl.make(Ends, 13, wrappers=[limited])


def test_another_limit_than_the_registered_one() -> None:
    """Gymnasium's own keyword argument: longer episodes allow longer delays, and shorter ones do not."""
    assert delay_of("Pendulum-v1(max_episode_steps=300)", 250).maximum == 250
    assert resolve("bpql", "Pendulum-v1(max_episode_steps=300)", 250, "small", "corrected", {}).delay.maximum == 250
    with pytest.raises(DelayRLError, match=r"longer than an episode of Pendulum-v1 \(50 steps\)"):
        delayrl.make("Pendulum-v1", 51, max_episode_steps=50)


# ------------------------------------------------------------------------------------------------ errors


def test_an_instance_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_tasks, "READY", Arm(), raising=False)
    words = r"an instance of Arm\): give its class, a function that makes it, or its id"
    for env in (Arm(), TimeLimit(Arm(), 3), gym.vector.SyncVectorEnv([Arm]), "own_tasks:READY"):
        with pytest.raises(DelayRLError, match="this is one"):
            delayrl.make(env)  # type: ignore[arg-type]
    with pytest.raises(DelayRLError, match=words):
        delayrl.train("random", TimeLimit(Arm(), 3))  # type: ignore[arg-type]
    only = Arm()
    delayrl.make(lambda: only)
    with pytest.raises(DelayRLError, match="<lambda> returned the same environment twice"):
        delayrl.make(lambda: TimeLimit(only, 3))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Nowhere-v3", "unknown task 'Nowhere-v3'"),
        (
            "my_arm",
            "`delayrl tasks` lists tasks; one of your own is MODULE:NAME, or MODULE:ID if the module registers it$",
        ),
        ("my_arm:Broken(how=1)", "cannot be made here: ValueError: the serial port is closed$"),
        ('my_arm:Broken(how="id")', r"'my_arm:Broken\(how=\"id\"\)' cannot be made here: NameNotFound: .*Nowhere"),
        ("my_arm:Broken", "cannot be made here: TypeError: .*missing 1 required positional argument: 'how'"),
        ("my_arm:make(gani=2)", "TypeError: .*unexpected keyword argument 'gani'"),
        ("my_arm:Amr", "module 'my_arm' has no class or function 'Amr', .*did you mean Arm"),
        ("my_arm:Broken-v7", "has no class or function 'Broken-v7', and registers no such task"),
        ("my_arm:Camera.nothing", "has no class or function 'Camera.nothing'"),
        ("my_raising:Arm", "cannot import 'my_raising': ZeroDivisionError: division by zero"),
        ("my_raising:Arm-v0", "cannot import 'my_raising': ZeroDivisionError: division by zero"),
        ("my_ending:Arm", "cannot import 'my_ending': SystemExit: 3"),
        ("my_arm.py:make", "a module is named as in an import, such as my_arm; got 'my_arm.py'"),
        ("./my_arm.py:make", "a module is named as in an import, such as my_arm; got './my_arm.py'"),
        ("not_there:Arm", "cannot import 'not_there': ModuleNotFoundError: No module named 'not_there'"),
        (":Arm", "cannot import ''"),
        ("my_registered:My-v0", "task 'my_registered:My-v0' cannot be made here: OSError: no such robot"),
        ("My-v0", "task 'My-v0' cannot be made here: OSError: no such robot"),
        ("My", "task 'My-v0' cannot be made here: OSError: no such robot"),
        ("builtins:dict", "must return a Gymnasium environment; got dict"),
        ("my_arm:Arm | my_arm:Broken(how=1)", "wrapper 'my_arm:Broken.*cannot be put around my_arm:Arm: TypeError"),
        ("my_arm:Arm | builtins:print", "builtins:print must return a Gymnasium environment; got NoneType"),
        ("my_arm:Arm | flattn", "a wrapper is named module:Class, or flatten; got flattn"),
    ],
)
def test_errors_are_those_of_the_users_code(text: str, words: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(write_module(tmp_path, "my_arm"))
    write_module(tmp_path, "my_raising", "1 / 0")
    write_module(tmp_path, "my_ending", "raise SystemExit(3)")
    registered = "import gymnasium\ndef fail():\n    raise OSError('no such robot')\n"
    write_module(tmp_path, "my_registered", registered + "gymnasium.register('My-v0', entry_point=fail)")
    if text.startswith("My"):
        monkeypatch.setitem(gym.registry, "My-v0", gym.envs.registration.EnvSpec("My-v0", "my_registered:fail"))
        monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DelayRLError, match=words) as error:
        delayrl.make(text)
    assert "\n" not in str(error.value)
    gym.registry.pop("My-v0", None)
    for name in ("my_arm", "my_raising", "my_ending", "my_registered"):
        sys.modules.pop(name, None)


def test_wrappers_have_names_and_arguments_fit_in_json() -> None:
    with pytest.raises(DelayRLError, match="got <lambda>: apply any other in a function"):
        delayrl.make(Arm, wrappers=[lambda env: env])
    with pytest.raises(DelayRLError, match=r"what JSON can hold .*ndarray"):
        delayrl.make(Arm, env_kwargs={"gain": np.ones(2)})
    assert delayrl.make(Arm, names=np.ones(2)).unwrapped.names.shape == (2,)  # not recorded, so it may be anything
    with pytest.raises(DelayRLError, match="a task is an id, module:function, a class or a function; got 3"):
        delayrl.make(3)  # type: ignore[arg-type]
    with pytest.raises(DelayRLError, match="a wrapper is module:Class, a class or a function; got 3"):
        delayrl.make(Arm, wrappers=[3])  # type: ignore[list-item]


# ------------------------------------------------------------------------------------------------ stored runs


def test_what_a_run_folder_may_name(tmp_path: Path, monkeypatch) -> None:
    """Environments, wrappers, ids, and functions of one's own; functions that are installed could do anything."""
    monkeypatch.chdir(write_module(tmp_path, "my_stored"))
    folder, witness = tmp_path / "runs" / "mine", tmp_path / "witness"
    folder.mkdir(parents=True)
    for text in (
        "Pendulum-v1(g=2.0)",
        "gymnasium.envs.classic_control:PendulumEnv",
        "gymnasium:Pendulum-v1",
        f"my_stored:make(gain=2) | {LIMIT} | flatten",
        f"my_stored:Arm | {LIMIT}",
    ):
        stored_task(text, folder).make()
    for text in (
        f'os:mkdir(path="{witness}")',
        f'subprocess:run(args=["mkdir", "{witness}"])',
        f'pathlib:Path.touch(self="{witness}")',
        f"Pendulum-v1 | numpy:savetxt(X=[1], fname='{witness}')".replace("'", '"'),
        "gymnasium:make",
        "antigravity:fly_to",
        "idlelib.idle:idlelib",  # importing these two opens windows
    ):
        with pytest.raises(DelayRLError, match=r"came with a task that could run any code, .*give it as env"):
            stored_task(text, folder)
    assert not witness.exists()
    assert not {"antigravity", "idlelib.idle"} & sys.modules.keys()


@pytest.mark.parametrize("name", ["runs.evil", "runs.mine.evil", "evil"])
def test_code_that_came_with_a_run_folder_is_not_imported(name: str, tmp_path: Path, monkeypatch) -> None:
    """Neither beside the run nor in it, whether or not these folders are packages."""
    folder, witness = tmp_path / "runs" / "mine", tmp_path / "witness"
    folder.mkdir(parents=True)
    text = f"open({str(witness)!r}, 'w')\nfrom own_tasks import Arm"
    for place in (tmp_path / "runs", folder):
        write_module(place, "evil", text)
    monkeypatch.chdir(tmp_path)
    for package in (False, True):
        if package:
            write_module(tmp_path / "runs", "__init__", text)
        with pytest.raises(DelayRLError):
            stored_task(f"{name}:Arm", folder)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "linked_runs").symlink_to(tmp_path / "runs")
    monkeypatch.chdir(tmp_path / "elsewhere")
    with pytest.raises(DelayRLError, match="could run any code"):
        stored_task("linked_runs.evil:Arm", Path("linked_runs") / "mine")
    monkeypatch.chdir(folder)
    with pytest.raises(DelayRLError, match="could run any code"):
        stored_task("evil:Arm", Path())
    assert not witness.exists()


def test_another_environment_for_a_stored_run() -> None:
    """It gets the arguments and wrappers of the run, unless it has its own."""
    folder, given = Path("nowhere"), lambda **kwargs: make_arm(**kwargs)
    with pytest.raises(DelayRLError, match="<lambda> has no name that it could be imported by: give it again, as env"):
        stored_task("<lambda>(gain=3)", folder)
    task = stored_task("<lambda>(gain=3) | own_tasks:Camera(offset=2) | flatten", folder, given)
    assert str(task) == "<lambda>(gain=3) | own_tasks:Camera(offset=2) | flatten"
    assert task.make().unwrapped.gain == 3
    assert str(stored_task("own_tasks:Arm(gain=3)", folder, None, {"gain": 4})) == "own_tasks:Arm(gain=4)"
    mine = stored_task("<Arm>(gain=3, names=1) | m:W", folder, "own_tasks:Arm(gain=5) | flatten", {"names": 2})
    assert str(mine) == "own_tasks:Arm(gain=5, names=2) | flatten"


def test_safe_path_is_respected(tmp_path: Path) -> None:
    write_module(tmp_path, "my_safe", "print('imported')")
    code = "import delayrl\ntry: delayrl.make('my_safe:Arm')\nexcept delayrl.DelayRLError as error: print(error)"
    for flags, words in (["-P"], "No module named"), ([], "imported"):
        command = [
            sys.executable,
            "-W",
            "ignore",
            *flags,
            "-c",
            "import sys; sys.path[:] = [p for p in sys.path if p]\n" + code,
        ]
        assert words in subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout


def test_rounding_brings_no_action_beyond_its_range() -> None:
    """In single precision 0.1 + (0.3 - 0.1) is above 0.3."""

    class Valve(Arm):
        action_space = Box(0.1, 0.3, (1,), np.float32)

        def step(self, action: np.ndarray) -> Any:
            assert self.action_space.contains(action), action
            return super().step(action)

    with closing_quietly(make(Valve, 0, wrappers=[LIMIT], rescale=True)) as env:
        env.reset(seed=0)
        for action in np.linspace(-1, 1, 9, dtype=np.float32):
            env.step(np.full(1, action))


@pytest.mark.parametrize(("dt", "words"), [("20ms", "'20ms'"), (0, "0"), (-0.02, "-0.02"), (lambda: 0.02, "a method")])
def test_a_dt_that_is_no_time_is_told(dt: Any, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Timed(Arm):
        pass

    monkeypatch.setattr(layers, "_warned", set())
    env = TimeLimit(Timed(), 20)
    env.unwrapped.dt = dt  # type: ignore[attr-defined]
    with pytest.warns(DelayWarning, match=f"Timed: its dt is {words}, not seconds above 0, and is not used"):
        assert seconds_of(env) is None


def test_torques_are_no_times() -> None:
    env = TimeLimit(Arm(), 20)
    env.unwrapped.tau = np.zeros(2)  # type: ignore[attr-defined]
    assert seconds_of(env) is None


def test_errors_name_the_last_line_of_the_users_code() -> None:
    """Not that of a library which it calls, or of a wrapper around it."""

    class Broken(Arm):
        def step(self, action: Any) -> Any:
            return np.linalg.inv(np.zeros((2, 2)))

    env = make(lambda: TimeLimit(Broken(), 20), 0)
    stepping.reset(env, 0)
    with pytest.raises(DelayRLError, match=r"Broken failed in step: LinAlgError: Singular matrix \(test_task.py, line"):
        stepping.step(env, np.zeros(1, np.float32))


def test_an_environment_that_ends_the_process_is_told() -> None:
    class Ending(Arm):
        def step(self, action: Any) -> Any:
            sys.exit(3)

    env = make(lambda: TimeLimit(Ending(), 20), 0)
    stepping.reset(env, 0)
    with pytest.raises(DelayRLError, match=r"Ending failed in step: SystemExit: 3 \(test_task.py, line"):
        stepping.step(env, np.zeros(1, np.float32))


def test_a_task_without_actions_is_refused() -> None:
    class Idle(Arm):
        action_space = Box(-1, 1, (0,))

    with pytest.raises(DelayRLError, match="there must be an action"):
        make(lambda: TimeLimit(Idle(), 20), 0)


def test_a_step_of_repeated_actions_is_longer_and_an_episode_of_them_shorter() -> None:
    env = gym.make("Pendulum-v1")  # 200 steps of 50 ms
    for repeats in (1, 3):
        repeated = RepeatAction(env, num_repeats=repeats)
        assert seconds_of(repeated) == pytest.approx(0.05 * repeats)
        assert limit_of(repeated) == -(-200 // repeats)
    assert limit_of(TimeLimit(RepeatAction(env, num_repeats=3), 40)) == 40
