"""What a video shows: the robot, and what is written above it."""

import json
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import delayrl.play.video as video
from delayrl.envs import make
from delayrl.errors import DelayRLError
from delayrl.play.picture import GAP, aim, beside, caption, moving_base
from delayrl.play.video import Moment, _episode, _together

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

from delayrl.envs import make
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
    first, *_, last = _episode(env, policy, 0, None, 5)
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
    assert (empty[60:] == 255).all()
    for column, word in enumerate(("ended at 10,000", "age 50", "return -12,345.6")):
        words = ["", "", ""]
        words[column] = word
        _, drawn = np.nonzero((caption(picture, "", words) != empty).any(2))
        assert column * 160 <= drawn.min() < drawn.max() < (column + 1) * 160
    rows, _ = np.nonzero((caption(picture, "Mg", ["", "", ""]) != empty).any(2))
    assert np.ptp(rows) >= 12  # pixels: legible


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
    moments = list(_episode(env, STILL, 5, None, 4))
    assert env.spec is not None
    length = env.spec.max_episode_steps
    assert [moment.step for moment in moments] == sorted({*range(0, length + 1, 4), length})
    assert [moment.age for moment in moments[:3]] == [0, 3, 3]
    assert [moment.over for moment in moments] == [False] * (len(moments) - 1) + [True]
    env.reset(seed=5)
    rewards = [float(env.step(np.zeros(1, np.float32))[1]) for _ in range(8)]
    assert [moment.total for moment in moments[:3]] == pytest.approx([0, sum(rewards[:4]), sum(rewards)])


def test_episodes_of_two_lengths() -> None:
    """The last moment of the shorter one stays."""

    def episode(name: str, length: int) -> Any:
        return iter([Moment(name, step, 0, 0.0, step == length) for step in range(length + 1)])

    pairs = [(a.step, b.step) for a, b in _together([episode("a", 1), episode("b", 3)])]
    assert pairs == [(0, 0), (1, 1), (1, 2), (1, 3)]


def test_a_renderer_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(env: gym.Env) -> None:
        raise RuntimeError("no pictures\ntoday")

    monkeypatch.setattr(video, "render", fail)
    with pytest.raises(DelayRLError, match=r"^delayrl/Walk-v0 cannot be rendered here: no pictures$"):
        next(_episode(make("delayrl/Walk-v0", 3), STILL, 5, None, 4))
