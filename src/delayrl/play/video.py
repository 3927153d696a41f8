"""Render episodes of trained policies to a file, without a screen."""

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import imageio
from tqdm import tqdm

from delayrl.delays import DelayLike
from delayrl.envs import make
from delayrl.envs.making import check_limit, name_of
from delayrl.envs.task import TaskLike
from delayrl.errors import DelayRLError, first_line
from delayrl.play.evaluation import HELD_OUT, check_seed, reset_seed, servable
from delayrl.play.picture import Picture, aim, beside, caption, close, render
from delayrl.play.policy import Policy, load, task_of, trained_delay
from delayrl.play.run import Run
from delayrl.run.agents import AgentLike
from delayrl.run.folder import RunLike

FASTEST = {".mp4": 60, ".gif": 25}
"""Frames per second by kind of file, about. Of tasks with shorter steps not every step is shown."""


class Moment(NamedTuple):
    """An episode up to one of its steps."""

    picture: Picture
    step: int
    age: int  # of the observation that the policy is shown, in steps
    total: float  # the return so far
    over: bool


def watch(
    run: RunLike,
    out: str | Path,
    delay: DelayLike | None = None,
    seed: int = 0,
    camera: str | None = None,
    compare: RunLike | None = None,
    *,
    env: TaskLike | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    agent: AgentLike | None = None,
) -> list[Moment]:
    """Play an episode of a run's policy, and write it to an .mp4 or .gif file.

    Step, age and return are written into the picture. The camera follows a robot that moves away.

    Args:
        run: the run folder.
        out: the file.
        delay: any delay that the policy can serve; None for the one it was trained for.
        seed: of the start state.
        camera: a camera of the MuJoCo model; None for `track`, or one that follows as it does.
        compare: a second run on the same task, shown beside the first, from the same start state.
        env: what makes the environment, as `load`.
        env_kwargs: keyword arguments of the environment that replace or complete the run's.
        agent: as `load`; of both runs if they name the same agent, else of the first.

    Returns:
        The last moment of the run's episode, and of that of `compare`.

    Raises:
        DelayRLError: another kind of file, no run, runs of two tasks, a delay longer than in training, no such camera,
            no way to render.
    """
    out = Path(out)
    if out.suffix not in FASTEST:
        raise DelayRLError(f"--out must end in .mp4 or .gif; got {out}")
    check_seed(seed)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # what pygame draws with
    paths = [Path(run)] if compare is None else [Path(run), Path(compare)]
    configs = [Run(path).config for path in paths]
    if configs[0]["env"] != configs[-1]["env"]:
        raise DelayRLError(f"--compare takes a run on {configs[0]['env']}; got one on {configs[-1]['env']}")
    with ExitStack() as stack:
        titles, episodes = [], []
        for path, config in zip(paths, configs, strict=True):
            task = task_of(path, env, env_kwargs)
            own = agent if config["agent"] == configs[0]["agent"] else None
            policy = load(path, task, agent=own)
            served = servable(task, trained_delay(path) if delay is None else delay, policy.spec)
            played = make(task, served, render_mode="rgb_array")
            stack.callback(close, played)
            check_limit(played, str(task))
            rate = float(played.metadata.get("render_fps") or 30)
            stride = max(1, round(rate / FASTEST[out.suffix]))
            titles.append(f"{config['agent']}, delay {served.label()}")
            episodes.append(_episode(played, policy, reset_seed(seed, HELD_OUT, 0), camera, stride))
        moments = _together(episodes)
        last = next(moments)  # before there is a file, because the first frame fails where nothing can be rendered
        moments = chain([last], moments)
        with _video(out, rate / stride) as add:
            for last in tqdm(moments, unit="frame", leave=False, disable=None):
                add(beside([caption(m.picture, title, _words(m)) for title, m in zip(titles, last, strict=True)]))
    return last


def _episode(env: Any, policy: Policy, seed: int, camera: str | None, stride: int) -> Iterator[Moment]:
    """Play an episode. Yields every `stride`-th moment of it, and the last."""
    step, total, over = 0, 0.0, False
    try:
        obs, info = env.reset(seed=seed)
        aim(env, camera)
        yield Moment(render(env), step, info["age"], total, over)
        while not over:
            obs, reward, terminated, truncated, info = env.step(policy.act(obs, info))
            step, total, over = step + 1, total + float(reward), terminated or truncated
            if over or step % stride == 0:
                yield Moment(render(env), step, info["age"], total, over)
    except DelayRLError:
        raise
    except Exception as error:  # a renderer may raise anything
        mujoco = hasattr(env.unwrapped, "mujoco_renderer")
        hint = "; Linux without a screen needs EGL (package libegl1)" if mujoco else ""
        raise DelayRLError(f"{name_of(env)} cannot be rendered here: {first_line(error)}{hint}") from error


def _together(episodes: Sequence[Iterator[Moment]]) -> Iterator[list[Moment]]:
    """Advance several episodes at once until all are over. Of one that is over, the last moment stays."""
    moments = [next(episode) for episode in episodes]
    yield moments
    while not all(moment.over for moment in moments):
        moments = [old if old.over else next(episode) for old, episode in zip(moments, episodes, strict=True)]
        yield moments


def _words(moment: Moment) -> list[str]:
    step = f"ended at {moment.step:,}" if moment.over else f"step {moment.step:,}"
    return [step, f"age {moment.age}", f"return {moment.total:,.1f}"]


@contextmanager
def _video(out: Path, rate: float) -> Iterator[Callable[[Any], None]]:
    """Open a video file, and yield the function that adds a frame. Raises DelayRLError if it cannot be written."""
    options = {"fps": rate, "macro_block_size": None} if out.suffix == ".mp4" else {"duration": 1000 / rate, "loop": 0}
    try:
        with warnings.catch_warnings():  # the encoder is forked while JAX's idle threads exist
            warnings.simplefilter("ignore", RuntimeWarning)
            with imageio.get_writer(out, **options) as writer:
                yield writer.append_data
    except OSError as error:
        raise DelayRLError(f"cannot write {out}: {error.strerror or error}") from error
