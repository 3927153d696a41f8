"""What a video shows: the robot, and what is written above it."""

import contextlib
import json
import subprocess
import sys
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.wrappers import RepeatAction, TimeLimit
from PIL import Image, ImageSequence

import delayrl.play.video as video
from delayrl.delays import as_delay
from delayrl.envs.making import make
from delayrl.envs.task import as_task
from delayrl.errors import DelayRLError
from delayrl.play.evaluation import HELD_OUT, reset_seed
from delayrl.play.picture import GAP, aim, beside, caption, moving_base
from delayrl.play.video import Moment, _episode, _few_colours, _repeated, _together
from own_tasks import Arm, failing

STILL = SimpleNamespace(act=lambda obs, info: np.zeros_like(info["actions"][0]))
SIZE = (480, 480, 3)

RENDERED = """
import json, os, sys
from pathlib import Path
from types import SimpleNamespace

os.environ["MUJOCO_GL"] = "egl"
import gymnasium as gym
import numpy as np
from gymnasium.envs.mujoco.ant_v5 import AntEnv
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

from delayrl.envs.making import make
from delayrl.play.picture import close, render
from delayrl.play.video import _episode

def runaway(base):
    class Runaway(base):
        def step(self, action):
            result = super().step(action)
            self.data.qpos[0] += 6  # metres
            return result
    return Runaway

ant = next(Path(gym.envs.mujoco.__file__).parent.glob("assets/ant.xml")).read_text()
model = Path(sys.argv[1]) / "ant.xml"
model.write_text("\\n".join(line for line in ant.splitlines() if "<camera" not in line))
gym.register("Track-v0", runaway(HalfCheetahEnv), max_episode_steps=15)
gym.register("Camera-v0", runaway(AntEnv), max_episode_steps=15, kwargs={"xml_file": str(model)})
policy = SimpleNamespace(act=lambda obs, info: np.zeros_like(info["actions"][0]))

def robot(picture):
    "Pixels of the robots' colour, a light brown. Sky and floor are grey and green."
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    return int(((red > green) & (red - blue > 40)).sum())

found = {}
for name in ("Track-v0", "Camera-v0"):
    env = make(name, 1, render_mode="rgb_array")
    first, *_, last = _episode(env, policy, 0, None, 5, 1)
    env.unwrapped.mujoco_renderer.camera_id = -1  # Gymnasium's own
    cam = env.unwrapped.mujoco_renderer.viewer.cam
    cam.lookat[:] = 0, 0, 0
    found[name] = [robot(first.picture), robot(last.picture), robot(render(env))]
    found[name] += [float(moment.picture[-60:].std()) for moment in (first, last)]
    close(env)
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[float]]:
    """Pixels of robots that run 90 metres: in the first frame, the last, and one of a camera that stays behind.

    Then the contrast of the floor, in the first frame and in the last.
    """
    folder = tmp_path_factory.mktemp("video")
    done = subprocess.run([sys.executable, "-c", RENDERED, str(folder)], capture_output=True, text=True)
    if "cannot be rendered here" in done.stderr:
        pytest.skip("no EGL here")
    assert done.stderr == ""  # OpenGL's exceptions at exit would be here
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", ["Track-v0", "Camera-v0"])
def test_the_robot_is_in_a_late_frame(found: dict[str, list[float]], name: str) -> None:
    """Of a model with a camera `track`, and of one without cameras. Both are rendered in one process."""
    first, last, behind, floor, floor_there = found[name]
    assert first > 2000
    assert last > first / 2
    assert behind < first / 20
    assert floor_there > floor / 2 > 10


def test_the_camera_changes_no_physics() -> None:
    seen = []
    for moved in (False, True):
        env = make("HalfCheetah-v5", 0, render_mode="rgb_array")
        env.reset(seed=3)
        if moved:
            aim(env, None)
        seen.append([env.step(np.ones(6, np.float32))[0] for _ in range(50)])
    np.testing.assert_array_equal(*seen)


BODIES = {
    "free": '<body><freejoint/><geom size="1"/></body>',
    "planar": '<body><joint type="slide"/><joint type="slide" axis="1 0 0"/><joint/><geom size="1"/></body>',
    "cart": '<body><joint type="slide"/><geom size="1"/></body>',
    "arm": '<body><joint/><geom size="1"/><body><joint/><geom size="1"/></body></body>',
    "cube": '<body><freejoint/><geom size=".1"/></body>',
}


@pytest.mark.parametrize(
    ("bodies", "wanted"),
    [
        ("free", 1),
        ("planar", 1),
        ("cart", None),
        ("arm", None),
        ("arm cube", None),
        ("cube arm", None),
        ("cube free", 2),
    ],
)
def test_moving_base(bodies: str, wanted: int | None) -> None:
    """What the camera follows: the heaviest mechanism, if it can leave its place."""
    text = "".join(BODIES[name] for name in bodies.split())
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    assert moving_base(model) == wanted


def test_no_such_camera() -> None:
    env = make("HalfCheetah-v5", 1, render_mode="rgb_array")
    with pytest.raises(DelayRLError, match="HalfCheetah-v5 has no camera 'top'; it has track"):
        aim(env, "top")
    with pytest.raises(DelayRLError, match="a MuJoCo model; delayrl/Walk-v0 is not made of one"):
        aim(make("delayrl/Walk-v0", 1), "top")
    aim(make("delayrl/Walk-v0", 1), None)


def test_caption() -> None:
    """Text fits its column, is in a band at the top, and leaves the rest of the picture as it is."""
    picture = np.full(SIZE, 255, np.uint8)
    empty = caption(picture, "", ["", "", ""])
    assert (empty[:50] < 128).all()
    assert (empty[65:] == 255).all()
    for column, word in enumerate(("ended at 10,000", "age 50", "return -12,345.6")):
        words = ["", "", ""]
        words[column] = word
        _, drawn = np.nonzero((caption(picture, "", words) != empty).any(2))
        assert column * 160 <= drawn.min() < drawn.max() < (column + 1) * 160
    rows, _ = np.nonzero((caption(picture, "Mg", ["", "", ""]) != empty).any(2))
    assert np.ptp(rows) >= 12  # pixels: legible


@pytest.mark.parametrize("letters", [1, 30, 60, 90])
def test_a_long_title_fits(letters: int) -> None:
    """All of it is in the picture, as large as a short one if there is room."""
    picture = np.full(SIZE, 255, np.uint8)
    heights = {}
    for title in ("M", "M" * letters):
        rows, columns = np.nonzero((caption(picture, title, [""]) != caption(picture, "", [""])).any(2))
        assert columns.max() < 480 - 5
        heights[title] = np.ptp(rows)
    assert (columns.max() > 350) == (letters >= 30)
    assert (heights["M" * letters] < heights["M"]) == (letters >= 30)


def test_beside() -> None:
    left, right = np.full((5, 6, 3), 1, np.uint8), np.full((5, 7, 3), 2, np.uint8)
    both = beside([left, right])
    assert both.shape == (4, 16, 3)
    assert both[0, :, 0].tolist() == [1] * 6 + [0] * GAP + [2] * 6
    assert (beside([left]) == 1).all()


def test_moments_of_an_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every fourth step and the last, with the age that the policy was shown and the return until then."""
    monkeypatch.setattr(video, "render", lambda env: np.zeros(SIZE, np.uint8))
    env = make("delayrl/Walk-v0", 3)
    moments = list(_episode(env, STILL, 5, None, 4, 1))
    assert env.spec is not None
    length = env.spec.max_episode_steps
    assert [moment.step for moment in moments] == sorted({*range(0, length + 1, 4), length})
    assert [moment.age for moment in moments[:3]] == [0, 3, 3]
    assert [moment.over for moment in moments] == [False] * (len(moments) - 1) + [True]
    env.reset(seed=reset_seed(5, HELD_OUT, 0))
    rewards = [float(env.step(np.zeros(1, np.float32))[1]) for _ in range(8)]
    assert [moment.total for moment in moments[:3]] == pytest.approx([0, sum(rewards[:4]), sum(rewards)])


def test_episodes_of_two_lengths() -> None:
    """The last moment of the shorter one stays."""

    def episode(name: str, length: int) -> Any:
        return iter([Moment(name, 1, step, 0, 0.0, step == length) for step in range(length + 1)])

    pairs = [(a.step, b.step) for a, b in _together([episode("a", 1), episode("b", 3)])]
    assert pairs == [(0, 0), (1, 1), (1, 2), (1, 3)]


def test_episodes_one_after_another() -> None:
    """Each side begins its next one by itself, after the end of the last has been shown for two frames."""

    def side(length: int) -> Any:
        return lambda number: (Moment("", number, step, 0, 0.0, step == length) for step in range(length + 1))

    pairs = [[(m.episode, m.step) for m in both] for both in islice(_repeated([side(1), side(3)], 2), 7)]
    left, right = zip(*pairs, strict=True)
    assert left == ((1, 0), (1, 1), (1, 1), (2, 0), (2, 1), (2, 1), (3, 0))
    assert right == ((1, 0), (1, 1), (1, 2), (1, 3), (1, 3), (2, 0), (2, 1))


def test_episodes_are_those_of_evaluate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second starts as the second of `evaluate` with the same seed; the camera is chosen once, before the first."""
    aimed = []
    monkeypatch.setattr(video, "aim", lambda env, camera: aimed.append(camera))
    monkeypatch.setattr(video, "render", lambda env: env.unwrapped.state.copy())
    env = make("Pendulum-v1", 3)
    starts = [next(_episode(env, STILL, 5, "top", 4, number)).picture for number in (1, 2)]
    for number, start in enumerate(starts):
        env.reset(seed=reset_seed(5, HELD_OUT, number))
        np.testing.assert_array_equal(start, env.unwrapped.state)
    assert aimed == ["top"]


def test_frames_of_a_gif_share_their_colours() -> None:
    """What is the same in two frames stays the same number, and colours that the first lacks become its nearest."""
    first = np.zeros((4, 4, 3), np.uint8)
    first[:2] = 200, 100, 50
    second = first.copy()
    second[0, 0] = 190, 110, 50
    one = _few_colours(first, [])
    two = _few_colours(second, [one])
    assert one.getpalette() == two.getpalette()
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(np.asarray(one.convert("RGB")), first)


@pytest.mark.parametrize("seconds", [0, -1, float("nan"), float("inf")])
def test_a_length_of_nothing(tmp_path: Path, seconds: float) -> None:
    with pytest.raises(DelayRLError, match="--seconds is a length above 0, such as 8; got"):
        video.watch(tmp_path, tmp_path / "x.gif", seconds=seconds)


@pytest.mark.parametrize("rate", [30 / 2, 125 / 8, 50 / 3, 22.0, 60.0])
def test_frames_of_a_gif_take_their_time(tmp_path: Path, rate: float) -> None:
    """Each is whole hundredths of a second, and all of them together are as long as they should be."""
    halves = np.repeat(np.array([0, 200], np.uint8), 4)[:, None, None] * np.ones((8, 8, 3), np.uint8)
    with video._video(tmp_path / "x.gif", rate) as add:
        for frame in range(41):
            add(np.roll(halves, 4 * frame, axis=0))
    with Image.open(tmp_path / "x.gif") as file:
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(file)]
    assert len(times) == 41
    np.testing.assert_allclose(np.cumsum(times), 1000 * np.arange(1, 42) / rate, atol=5 + 1e-9)
    with video._video(tmp_path / "one.gif", rate) as add:
        add(halves)
    assert (tmp_path / "one.gif").stat().st_size > 0


def test_an_episode_of_repeated_actions_takes_its_real_time() -> None:
    """A step of it is several of the task's frames; a wrapper of one's own says so by its `dt`."""
    task, twice = gym.make("Pusher-v5"), gym.Wrapper(gym.make("Pusher-v5"))
    twice.dt = 2 * task.unwrapped.dt
    silent = gym.Wrapper(make(lambda: TimeLimit(Arm(), 20)))  # says neither dt nor render_fps
    assert video._rate(task) == 20
    assert video._rate(RepeatAction(task, num_repeats=4)) == pytest.approx(5)
    assert video._rate(twice) == pytest.approx(10)
    assert (video._rate(silent), video._rate(RepeatAction(silent, num_repeats=3))) == (30, 10)


def test_titles_of_two_runs_differ() -> None:
    paths = [Path("runs/a/bpql-small/seed0"), Path("runs/a/bpql-paper/seed0")]
    named = ["bpql, delay 3, bpql-small/seed0", "bpql, delay 3, bpql-paper/seed0"]
    assert video._apart(["bpql, delay 3"] * 2, paths) == named
    assert video._apart(["bpql, delay 3", "bpql, delay 2"], paths) == ["bpql, delay 3", "bpql, delay 2"]
    assert video._apart(["bpql, delay 3"] * 2, [paths[0]] * 2) == ["bpql, delay 3"] * 2


def test_a_task_without_render_mode() -> None:
    line = "a video needs an environment that takes render_mode, and own_tasks:Arm does not: docs/own-task.md shows one"
    with pytest.raises(DelayRLError, match=f"^{line}$"):
        video._rendering(as_task(Arm), as_delay(1))


@pytest.mark.parametrize("method", ["reset", "step"])
def test_an_environment_that_fails_is_not_blamed_on_rendering(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "render", lambda env: np.zeros(SIZE, np.uint8))
    env = make(failing(method), 1)
    line = rf"^Failing failed in {method}: ZeroDivisionError: division by zero \(own_tasks.py, line \d+\)$"
    with pytest.raises(DelayRLError, match=line) as error:
        list(_episode(env, STILL, 5, None, 4, 1))
    assert isinstance(error.value.__cause__, ZeroDivisionError)


def test_a_renderer_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(env: gym.Env) -> None:
        raise RuntimeError("no pictures\ntoday")

    monkeypatch.setattr(video, "render", fail)
    with pytest.raises(DelayRLError, match=r"^delayrl/Walk-v0 cannot be rendered here: RuntimeError: no pictures$"):
        next(_episode(make("delayrl/Walk-v0", 3), STILL, 5, None, 4, 1))


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (None, "None"),
        (np.zeros((4, 4), np.uint8), r"uint8 \[4, 4\]"),
        (np.zeros((4, 4, 1), np.uint8), r"uint8 \[4, 4, 1\]"),
        (np.zeros((4, 4, 3)), r"float64 \[4, 4, 3\]"),
        ([[[0, 0, 0]]], r"int64 \[1, 1, 3\]"),
        (np.zeros((1, 4, 3), np.uint8), r"uint8 \[1, 4, 3\]"),
    ],
)
def test_what_is_no_picture(given: Any, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make("delayrl/Walk-v0", 3)
    monkeypatch.setattr(type(env.unwrapped), "render", lambda env: given)
    with pytest.raises(DelayRLError, match=rf"^the render\(\) of delayrl/Walk-v0 must .*; it returned {line}$"):
        next(_episode(env, STILL, 5, None, 4, 1))


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_a_video_that_fails_keeps_the_file_that_was_there(tmp_path: Path, kind: str) -> None:
    out = tmp_path / f"x.{kind}"
    with video._video(out, 15) as add:
        add(np.full((32, 32, 3), 200, np.uint8))
    kept = out.read_bytes()
    with contextlib.suppress(Exception), video._video(out, 15) as add:
        add(np.full((32, 32, 3), 100, np.uint8))
        raise ValueError
    assert out.read_bytes() == kept
    assert len(kept) > 100
    assert list(tmp_path.iterdir()) == [out]
