"""Render episodes of trained policies to a file, without a screen."""

import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain, count, islice, pairwise, repeat
from pathlib import Path
from typing import Any, NamedTuple

import imageio
from PIL import Image
from tqdm import tqdm

from delayrl.delays import Delay, DelayLike
from delayrl.envs.making import check_limit, make, name_of, task_steps_of
from delayrl.envs.task import Task, TaskLike, stored_task
from delayrl.errors import DelayRLError, one_line
from delayrl.play import stepping
from delayrl.play.evaluation import HELD_OUT, check_fits, check_seed, reset_seed, servable
from delayrl.play.picture import Picture, aim, beside, caption, close, render
from delayrl.play.policy import Policy, load
from delayrl.play.run import Run
from delayrl.run.agents import AgentLike
from delayrl.run.disk import disk_errors, draft
from delayrl.run.folder import RunLike, path_of

FASTEST = {".mp4": 60, ".gif": 15}
"""Frames per second by kind of file, about. Of tasks with shorter steps not every step is shown."""
PAUSE = 0.5  # seconds that the end of an episode is shown
COLOURS = 64  # of a .gif file


class Moment(NamedTuple):
    """An episode up to one of its steps."""

    picture: Picture
    episode: int  # from 1
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
    seconds: float | None = None,
    *,
    env: TaskLike | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    agent: AgentLike | None = None,
) -> list[Moment]:
    """Play an episode of a run's policy, and write it to an .mp4 or .gif file.

    Step, age and return are written into the picture, of several episodes also which it is. The camera follows a robot
    that moves away.

    Args:
        run: the run folder.
        out: the file.
        delay: any delay that the policy can serve; None for the one it was trained for.
        seed: of the start state.
        camera: a camera of the MuJoCo model; None for `track`, or one that follows as it does.
        compare: a second run on the same task, shown beside the first, from the same start states.
        seconds: the length of the file; an episode that ends before is followed by another one. None for one episode.
        env: what makes the environment, as `load`.
        env_kwargs: keyword arguments of the environment that replace or complete the run's.
        agent: as `load`; of both runs if they name the same agent, else of the first.

    Returns:
        The last moment of the run's last episode, and of that of `compare`.

    Raises:
        DelayRLError: another kind of file, no length, no run, runs of two tasks, a delay longer than in training, no
            such camera, no way to render.
    """
    out = Path(out)
    if out.suffix not in FASTEST:
        raise DelayRLError(f"--out must end in .mp4 or .gif; got {out}")
    check_seed(seed)
    if seconds is not None and not (isinstance(seconds, int | float) and 0 < seconds < math.inf):
        raise DelayRLError(f"--seconds is a length above 0, such as 8; got {seconds!r}")
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # what pygame draws with
    paths = [path_of(one) for one in ([run] if compare is None else [run, compare])]
    configs = [Run(path).config for path in paths]
    if configs[0]["env"] != configs[-1]["env"]:
        raise DelayRLError(f"--compare takes a run on {configs[0]['env']}; got one on {configs[-1]['env']}")
    with ExitStack() as stack:
        titles, episodes = [], []
        for path, config in zip(paths, configs, strict=True):
            task = stored_task(config["env"], path, env, env_kwargs)
            own = agent if config["agent"] == configs[0]["agent"] else None
            policy = load(path, task, agent=own)
            served = servable(task, policy.delay if delay is None else delay, policy.spec)
            played = _rendering(task, served)
            stack.callback(close, played)
            check_fits(played, policy.spec)
            check_limit(played, str(task))
            rate = _rate(played)
            stride = max(1, round(rate / FASTEST[out.suffix]))
            titles.append(f"{config['agent']}, delay {served.label()}")
            episodes.append(partial(_episode, played, policy, seed, camera, stride))
        if len(paths) == 2:
            titles = _apart(titles, paths)
        if seconds is None:
            moments = _together([begin(1) for begin in episodes])
        else:
            pause, frames = (max(1, round(time * rate / stride)) for time in (PAUSE, seconds))
            moments = islice(_repeated(episodes, pause), frames)
        last = next(moments)  # before there is a file, because the first frame fails where nothing can be rendered
        moments = chain([last], moments)
        with _video(out, rate / stride) as add:
            for last in tqdm(moments, unit="frame", leave=False, disable=None):
                add(beside([_titled(m, title, seconds is not None) for m, title in zip(last, titles, strict=True)]))
    return last


def _episode(env: Any, policy: Policy, seed: int, camera: str | None, stride: int, number: int) -> Iterator[Moment]:
    """Play the episode of this number, from 1. Yields every `stride`-th moment of it, and the last."""
    step, total, over = 0, 0.0, False
    obs, info = stepping.reset(env, reset_seed(seed, HELD_OUT, number - 1))  # as `evaluate` plays them
    if number == 1:
        aim(env, camera)
    yield Moment(_picture(env), number, step, info["age"], total, over)
    while not over:
        obs, reward, terminated, truncated, info = stepping.step(env, policy.act(obs, info))
        step, total, over = step + 1, total + reward, terminated or truncated
        if over or step % stride == 0:
            yield Moment(_picture(env), number, step, info["age"], total, over)


def _rendering(task: Task, delay: Delay) -> Any:
    """Make an environment that renders. Raises DelayRLError if it does not take `render_mode`, or cannot be made."""
    try:
        return make(task, delay, render_mode="rgb_array")
    except DelayRLError as error:
        if isinstance(error.__cause__, TypeError) and "render_mode" in str(error):
            line = f"a video needs an environment that takes render_mode, and {task} does not"
            raise DelayRLError(f"{line}: docs/own-task.md shows one") from error
        raise


def _rate(env: Any) -> float:
    """Return how many steps of an environment a second has. Its render_fps counts those of the task itself."""
    return float(env.metadata.get("render_fps") or 30) / task_steps_of(env)


def _picture(env: Any) -> Picture:
    mujoco = hasattr(env.unwrapped, "mujoco_renderer")
    hint = " (Linux without a screen needs EGL, package libegl1)" if mujoco else ""
    with one_line(f"{name_of(env)} cannot be rendered here{hint}"):
        return render(env)


def _together(episodes: Sequence[Iterator[Moment]]) -> Iterator[list[Moment]]:
    """Advance several episodes at once until all are over. Of one that is over, the last moment stays."""
    moments = [next(episode) for episode in episodes]
    yield moments
    while not all(moment.over for moment in moments):
        moments = [old if old.over else next(episode) for old, episode in zip(moments, episodes, strict=True)]
        yield moments


def _repeated(episodes: Sequence[Callable[[int], Iterator[Moment]]], pause: int) -> Iterator[list[Moment]]:
    """Play one episode after another, each side at its own pace and without end. `pause` frames show how one ended."""

    def side(begin: Callable[[int], Iterator[Moment]]) -> Iterator[Moment]:
        for number in count(1):
            for moment in begin(number):
                yield moment
            yield from repeat(moment, pause - 1)  # the loop's last

    return map(list, zip(*map(side, episodes), strict=True))


def _apart(titles: Sequence[str], paths: Sequence[Path]) -> list[str]:
    """Return the titles of two runs, with their folders behind them where they would be the same."""
    if titles[0] != titles[1] or paths[0] == paths[1]:
        return list(titles)
    home = os.path.commonpath([path.absolute() for path in paths])
    return [f"{title}, {os.path.relpath(path, home)}" for title, path in zip(titles, paths, strict=True)]


def _titled(moment: Moment, title: str, several: bool) -> Picture:
    """Write what is played, of `several` episodes which one, and how far it is, into a moment's picture."""
    episode = f", episode {moment.episode}" if several else ""
    step = f"ended at {moment.step:,}" if moment.over else f"step {moment.step:,}"
    return caption(moment.picture, title + episode, [step, f"age {moment.age}", f"return {moment.total:,.1f}"])


@contextmanager
def _video(out: Path, rate: float) -> Iterator[Callable[[Any], None]]:
    """Open a video file, and yield the function that adds a frame. Raises DelayRLError if it cannot be written.

    What fails leaves the file that was there.
    """
    with disk_errors(out), draft(out) as name, name.open("wb") as file:
        if out.suffix == ".gif":
            frames: list[Image.Image] = []
            yield lambda picture: frames.append(_few_colours(picture, frames[:1]))
            times = _frame_times(len(frames), rate)
            frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=times, loop=0)
        else:
            with warnings.catch_warnings():  # the encoder is forked while JAX's idle threads exist
                warnings.simplefilter("ignore", RuntimeWarning)
                with imageio.get_writer(file, format=".mp4", fps=rate, macro_block_size=None) as writer:
                    yield writer.append_data


def _frame_times(frames: int, rate: float) -> list[int]:
    """Return how long each frame of a .gif is shown, in ms. A file holds whole hundredths of a second, so they vary."""
    ends = [10 * round(100 * frame / rate) for frame in range(frames + 1)]
    return [end - begin for begin, end in pairwise(ends)]


def _few_colours(picture: Picture, first: Sequence[Image.Image]) -> Image.Image:
    """Reduce a frame to the colours of the first one. Colours of its own would flicker, and take twice the space."""
    image = Image.fromarray(picture)
    return image.quantize(palette=first[0], dither=Image.Dither.NONE) if first else image.quantize(COLOURS)
