"""Tasks with a delay: any id of Gymnasium's registry, ours under `delayrl/` included."""

import contextlib
import difflib
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import RescaleAction

from delayrl.delays import Delay, DelayLike, as_delay
from delayrl.envs import paper
from delayrl.errors import DelayRLError, first_line
from delayrl.wrappers import Delayed, check_spaces
from delayrl.wrappers.single import check_length
from delayrl.wrappers.single import seconds_of as seconds_of
from delayrl.wrappers.transit import Fill


def make(
    env: str,
    delay: DelayLike = 0,
    *,
    rescale: bool = False,
    history: int | None = None,
    fill: Fill = "first",
    **options: Any,
) -> Delayed:
    """Make a Gymnasium task with a delay.

    Args:
        env: an id of Gymnasium's registry, e.g. "InvertedPendulum-v5".
        delay: steps, a text ("uniform:1:5@fifo", "80ms+action=2"), a law, or a `Delay`; no longer than an episode.
        rescale: whether actions, in `info` too, are in [-1, 1] instead of the task's own range.
        history: rows of the action history, as `Delayed`.
        fill: what is shown before anything has arrived, as `Delayed`.
        **options: passed to `gymnasium.make`, e.g. `render_mode="rgb_array"`.

    Raises:
        DelayRLError: an unknown task (the message names similar ones), unsuitable spaces, a bad delay.
    """
    try:
        with quiet():
            task = gym.make(env, disable_env_checker=True, **options)
    except Exception as error:  # a task's own constructor may raise anything
        if env in gym.registry:
            raise DelayRLError(f"task {env!r} cannot be made here: {first_line(error)}") from error
        near = difflib.get_close_matches(env, gym.registry, n=3, cutoff=0.5)
        hint = f"did you mean {', '.join(near)}?" if near else "`delayrl tasks` lists tasks to choose from"
        raise DelayRLError(f"unknown task {env!r}; {hint}") from error
    check_spaces(env, task.observation_space, task.action_space)
    idle = None
    if rescale:
        low, high = task.action_space.low, task.action_space.high  # type: ignore[attr-defined]
        idle = 2 * (np.clip(0, low, high) - low) / (high - low) - 1
        task = RescaleAction(task, np.float32(-1), np.float32(1))
    return Delayed(task, delay, history, fill, idle)


def delay_of(env: str, delay: DelayLike) -> Delay:
    """Convert a delay to steps of a task, which is made only if its step length is needed. Raises DelayRLError."""

    def step_seconds() -> float | None:
        task = make(env)
        task.close()
        return seconds_of(task)

    parsed = as_delay(delay, step_seconds)
    check_length(parsed, gym.registry.get(env))
    return parsed


def physics(env: gym.Env[Any, Any]) -> dict[str, str | None]:
    """Return the versions of Gymnasium and MuJoCo and the model's fingerprint; the last two are None without MuJoCo."""
    simulated = hasattr(env.unwrapped, "model") and hasattr(env.unwrapped, "frame_skip")
    return {
        "gymnasium": version("gymnasium"),
        "mujoco": version("mujoco") if simulated else None,
        "physics": paper.fingerprint(env) if simulated else None,
    }


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress notes on deprecated models and versions, which MuJoCo would also log to a file in the current folder."""
    import mujoco

    mujoco.set_mju_user_warning(lambda message: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        mujoco.set_mju_user_warning(None)


def tasks() -> Iterator[tuple[str, Any, float | None]]:
    """Make the papers' nine tasks, small ones to try, and ours. Yields id, task and seconds of a step; closes each."""
    small = ["InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Pendulum-v1"]
    ours = sorted(name for name in gym.registry if name.startswith("delayrl/"))
    for name in [f"{task}-v5" for task in paper.TASKS] + small + ours:
        env = make(name)
        yield name, env, seconds_of(env)
        env.close()
