"""Tasks with a delay."""

import inspect
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import NormalizeObservation, RescaleAction

from delayrl.delays import Delay, DelayLike, as_delay
from delayrl.envs import paper
from delayrl.envs.task import Task, TaskLike, WrapperLike, as_task, closing_quietly
from delayrl.errors import DelayRLError, did_you_mean, near_names
from delayrl.wrappers import Delayed, check_spaces
from delayrl.wrappers.layers import check_length
from delayrl.wrappers.layers import check_limit as check_limit
from delayrl.wrappers.layers import name_of as name_of
from delayrl.wrappers.layers import seconds_of as seconds_of
from delayrl.wrappers.layers import task_steps_of as task_steps_of
from delayrl.wrappers.transit import Fill


def make(
    env: TaskLike,
    delay: DelayLike = 0,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: WrapperLike | Sequence[WrapperLike] = (),
    flatten: bool = False,
    normalise: bool = False,
    rescale: bool = False,
    history: int | None = None,
    fill: Fill = "first",
    step_seconds: float | None = None,
    **options: Any,
) -> Delayed:
    """Make a task with a delay.

    Args:
        env: an id of Gymnasium's registry, `module:id` or `module:object` ("arm:Arm"), a spec, or a class or function
            that makes an environment.
        delay: steps, a text ("uniform:1:5@fifo", "80ms+action=2"), a law, or a `Delay`; no longer than an episode.
        env_kwargs: keyword arguments for what makes the environment, e.g. {"gain": 2}.
        wrappers: one or several between the environment and the delay, innermost first: classes, or names such as
            "filters:LowPass".
        flatten: join nested observations (Dict, Tuple, images) to one vector.
        normalise: show deviations from a running mean, in units of the running standard deviation. Both belong to this
            environment; an agent keeps its own (`observation_norm`), and is trained on the task as it is.
        rescale: whether actions, in `info` too, are in [-1, 1] instead of the task's own range.
        history: rows of the action history, as `Delayed`.
        fill: what is shown before anything has arrived, as `Delayed`.
        step_seconds: the length of a step, for delays given as times; None to ask the task.
        **options: more keyword arguments, which no name or text records, e.g. `render_mode="rgb_array"`.

    Raises:
        DelayRLError: an unknown task (the message names similar ones), an environment whose own code fails (the message
            is that of its error), unsuitable spaces, a bad delay.
    """
    named = as_task(env, env_kwargs, wrappers, flatten)
    task: Any = _made(named, options)
    spaces: Any = [getattr(task, name, None) for name in ("observation_space", "action_space")]
    check_spaces(str(named), *spaces)
    if normalise:
        task = NormalizeObservation(task)
    idle = None
    if rescale:
        low, high = task.action_space.low, task.action_space.high
        idle = 2 * (np.clip(0, low, high) - low) / (high - low) - 1
        task = RescaleAction(task, np.float32(-1), np.float32(1))
        rescaled = task.func
        task.func = lambda action: np.clip(rescaled(action), low, high)  # rounding may have brought it beyond
    return Delayed(task, delay, history, fill, idle, step_seconds)


def _made(task: Task, options: dict[str, Any]) -> Any:
    try:
        return task.make(**options)
    except DelayRLError as error:
        own = [p.name for p in inspect.signature(make).parameters.values() if p.kind is p.KEYWORD_ONLY]
        near = [ours for name in options for ours in near_names(name, own)]
        if near and isinstance(error.__cause__, TypeError):
            raise DelayRLError(f"{error}{did_you_mean(near)}") from error.__cause__
        raise


def delay_of(env: TaskLike, delay: DelayLike) -> Delay:
    """Convert a delay to steps of a task, which is made only if its step length is needed. Raises DelayRLError."""

    def step_seconds() -> float | None:
        with closing_quietly(task.make()) as made:
            return seconds_of(made)

    task = as_task(env)
    parsed = as_delay(delay, step_seconds)
    check_length(parsed, str(task), task.limit)
    return parsed


def physics(env: gym.Env[Any, Any]) -> dict[str, str | None]:
    """Return the versions of Gymnasium and MuJoCo and the model's fingerprint; the last two are None without MuJoCo."""
    model = type(getattr(env.unwrapped, "model", None)).__module__  # of an environment of a user, it may be anything
    simulated = model.partition(".")[0] == "mujoco" and hasattr(env.unwrapped, "frame_skip")
    return {
        "gymnasium": version("gymnasium"),
        "mujoco": version("mujoco") if simulated else None,
        "physics": paper.fingerprint(env) if simulated else None,
    }


def tasks() -> Iterator[tuple[str, Any, float | None]]:
    """Make the papers' nine tasks, small ones to try, and ours. Yields id, task and seconds of a step; closes each."""
    small = ["InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Pendulum-v1"]
    ours = sorted(name for name in gym.registry if name.startswith("delayrl/"))
    for name in [f"{task}-v5" for task in paper.TASKS] + small + ours:
        with closing_quietly(make(name)) as env:
            yield name, env, seconds_of(env)
