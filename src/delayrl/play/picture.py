"""Pictures of an episode: where the camera looks, and what is written into a frame."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from delayrl.envs.making import name_of
from delayrl.errors import DelayRLError

Picture = NDArray[np.uint8]
"""[height, width, 3]"""
GAP = 4  # pixels between two pictures
FREE, SLIDE = 0, 2  # MuJoCo's mjtJoint
PLANE = 0  # MuJoCo's mjtGeom


def aim(env: Any, camera: str | None) -> None:
    """Choose the camera of a task that has been reset; leave tasks without MuJoCo as they are.

    Without a name this is the model's camera `track`, or one that follows the robot if its base moves, or the task's
    own. Raises DelayRLError for a camera that the model does not have.
    """
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is None:
        if camera is not None:
            raise DelayRLError(f"--camera names a camera of a MuJoCo model; {name_of(env)} is not made of one")
        return
    model = env.unwrapped.model
    names = [model.camera(number).name for number in range(model.ncam)]
    if camera is not None and camera not in names:
        known = ", ".join(filter(None, names)) or "none"
        raise DelayRLError(f"{name_of(env)} has no camera {camera!r}; it has {known}")
    if camera or "track" in names:
        _extend_floor(model)
        renderer.camera_id = names.index(camera or "track")
    elif (body := moving_base(model)) is not None:
        import mujoco

        _extend_floor(model)
        env.render()  # makes the viewer
        renderer.camera_id = None  # a number would undo the type that is set here
        renderer.viewer.cam.type, renderer.viewer.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, body


def _extend_floor(model: Any) -> None:
    """Draw the floor of a MuJoCo model 25 times as far. Contacts know no end of it anyway."""
    floors = np.flatnonzero((model.geom_type == PLANE) & (model.geom_bodyid == 0))
    model.geom_size[floors, :2] *= 25
    stretched = [material for material in set(model.geom_matid[floors]) - {-1} if not model.mat_texuniform[material]]
    model.mat_texrepeat[stretched] *= 25


def moving_base(model: Any) -> int | None:
    """Return the body from which the heaviest mechanism of a MuJoCo model hangs, if it can leave its place.

    It can with a free joint or with two slides, as planar walkers have. A cart on a rail and an arm cannot.
    """
    bases = np.flatnonzero(model.body_parentid == 0)[1:]  # the first is the world itself
    if not len(bases):
        return None
    base = bases[np.argmax(model.body_subtreemass[bases])]
    joints = model.jnt_type[model.jnt_bodyid == base]
    return int(base) if FREE in joints or (joints == SLIDE).sum() >= 2 else None


def render(env: Any) -> Picture:
    """Render a frame of an environment beside which others may be rendered too. Raises DelayRLError if it is none."""
    _current_viewer(env)  # OpenGL draws into the last one that was
    picture = np.asarray(env.render())
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4) or min(picture.shape) < 2:
        alone = picture.dtype == object and picture.ndim == 0
        kind = type(picture.item()).__name__.removesuffix("Type") if alone else ""  # None for NoneType
        gave = kind or f"{picture.dtype} {list(picture.shape)}"
        what = "an array of uint8 [height, width, 3 or 4], of 2 pixels or more each way"
        raise DelayRLError(f"the render() of {name_of(env)} must return {what}; it returned {gave}")
    return picture


def close(env: Any) -> None:
    """Close an environment, and what OpenGL keeps of it.

    MuJoCo's part of it must go while its context is current. Later it would delete pictures of other environments, or
    print an exception when the process ends.
    """
    if (viewer := _current_viewer(env)) is not None:
        viewer.con.free()
    env.close()


def _current_viewer(env: Any) -> Any:
    """Return the viewer of a MuJoCo environment, with its OpenGL context made the current one; None if it has none."""
    viewer = getattr(getattr(env.unwrapped, "mujoco_renderer", None), "viewer", None)
    if viewer is not None:
        viewer.make_context_current()
    return viewer


def caption(picture: Picture, title: str, words: Sequence[str]) -> Picture:
    """Write a title, and below it words in columns, on a dark band at the top of a picture.

    A title that is wider than the picture gets smaller letters.
    """
    height, width, _ = picture.shape
    size = max(11, round(min(height, width) / 26))
    image = Image.fromarray(picture).convert("RGB")
    band = (0, 0, width, round(3.4 * size))
    image.paste(Image.blend(image.crop(band), Image.new("RGB", band[2:]), 0.65), band)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size)
    larger = (ImageFont.load_default(pixels) for pixels in range(round(1.25 * size), 5, -1))
    fitting = next((font for font in larger if font.getlength(title) <= width - size), font)
    draw.text((size / 2, size), title, "white", fitting, anchor="lm")
    for column, word in enumerate(words):  # columns, so that growing numbers move nothing
        left = size / 2 + column * width / len(words)
        draw.text((left, 2.55 * size), word, "white", font, anchor="lm")
    return np.asarray(image)


def beside(pictures: Sequence[Picture]) -> Picture:
    """Put pictures of one height side by side. The sizes become even, as video codecs need them."""
    gap = np.zeros((len(pictures[0]), GAP, 3), np.uint8)
    row = np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1)
    return row[: len(row) // 2 * 2, : row.shape[1] // 2 * 2]
