"""Render an episode to a file, without a screen."""

import os
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from delayrl.errors import DelayRLError, first_line

if TYPE_CHECKING:
    from delayrl.envs.task import TaskLike


def watch(
    run: Path,
    out: Path,
    delay: int | str | None = None,
    seed: int = 0,
    *,
    env: "TaskLike | None" = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> tuple[int, float]:
    """Play one episode of a run's policy, and write it to an .mp4 or .gif file. Returns the frames and the return.

    Raises DelayRLError for another kind of file, no run, a delay longer than in training, or no way to render.
    """
    if out.suffix not in (".mp4", ".gif"):
        raise DelayRLError(f"--out must end in .mp4 or .gif; got {out}")
    from delayrl.play.evaluation import HELD_OUT, check_seed, reset_seed, servable

    check_seed(seed)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported
    import imageio

    from delayrl.envs import make
    from delayrl.play.policy import load, task_of
    from delayrl.run.folder import Run

    config = Run(run).config
    task = task_of(run, env, env_kwargs)
    policy = load(run, task)
    served = servable(task, config["delay"] if delay is None else delay, policy.spec)
    played = make(task, served, render_mode="rgb_array")
    obs, info = played.reset(seed=reset_seed(seed, HELD_OUT, 0))
    frames, total, done = [], 0.0, False
    try:
        while not done:
            frames.append(np.asarray(played.render()))
            obs, reward, terminated, truncated, info = played.step(policy.act(obs, info))
            total += float(reward)
            done = terminated or truncated
    except DelayRLError:
        raise
    except Exception as error:  # a renderer may raise anything
        raise DelayRLError(
            f"{task} cannot be rendered here: {first_line(error)}; Linux without a screen needs EGL (package libegl1)"
        ) from error
    rate = float(played.metadata.get("render_fps") or 30)
    try:
        if out.suffix == ".gif":  # viewers show at most 50 frames per second
            stride = max(1, round(rate / 25))
            imageio.mimsave(out, frames[::stride], duration=1000 * stride / rate, loop=0)
        else:
            with warnings.catch_warnings():  # the encoder is forked while JAX's idle threads exist
                warnings.simplefilter("ignore", RuntimeWarning)
                imageio.mimsave(out, frames, fps=rate, macro_block_size=None)
    except OSError as error:
        raise DelayRLError(f"cannot write {out}: {error.strerror or error}") from error
    return len(frames), total
