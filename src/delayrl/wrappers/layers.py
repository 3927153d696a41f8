"""Questions to an environment and to what it wraps: names, spaces, the length of a step and of an episode."""

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit

from delayrl.delays import Delay
from delayrl.errors import DelayRLError, DelayWarning

PACKAGE = str(Path(__file__).parents[1])
_warned: set[str] = set()
REPEATS = {"RepeatAction": "num_repeats", "MaxAndSkipObservation": "_skip"}
"""Gymnasium's wrappers of which a step is several steps of what they wrap, and where they keep how many."""


def name_of(env: Any) -> str:
    """Return the id of an environment, or the name of its class if it has none."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def seconds_of(env: Any) -> float | None:
    """Return the length of a step in seconds: the `dt` of the outermost layer that has one, or the task's `tau`."""
    for layer, steps in _layers_with_steps(env):
        for seconds in (getattr(layer, "dt", None), getattr(layer, "tau", None) if layer is env.unwrapped else None):
            if isinstance(seconds, int | float | np.number) and seconds > 0:
                _check_unit(env, layer, float(seconds))
                return float(seconds) * steps
        if (dt := getattr(layer, "dt", None)) is not None:
            shown = "a method" if callable(dt) else f"{dt!r:.60}"
            warn_once(f"{name_of(env)}: its dt is {shown}, not seconds above 0, and is not used")
    return None


def task_steps_of(env: Any) -> float:
    """Return how many steps of the task itself are a step of an environment: more than 1 if a wrapper repeats them."""
    own, task = seconds_of(env), seconds_of(env.unwrapped)
    *_, (_, repeats) = _layers_with_steps(env)
    return own / task if own and task else repeats


def _check_unit(env: Any, layer: Any, dt: float) -> None:
    """Warn of a step that is far longer than the frames of the environment are apart: it may be in milliseconds."""
    frames = (getattr(layer, "metadata", None) or {}).get("render_fps")
    if isinstance(frames, int | float | np.number) and dt > 1 and 100 <= dt * frames < np.inf:
        line = f"a step of {name_of(env)} takes {dt:g} s by its dt or tau, and its render_fps says {1 / frames:.2g} s"
        warn_once(f"{line}: a step is given in seconds")


def layers_of(env: Any) -> Iterator[Any]:
    """Yield an environment, and what it wraps, layer by layer."""
    yield env
    while isinstance(env, gym.Wrapper):
        env = env.env
        yield env


def _layers_with_steps(env: Any) -> Iterator[tuple[Any, int]]:
    """Yield each layer, and how many of its steps are one step of the environment."""
    steps = 1
    for layer in layers_of(env):
        yield layer, steps
        kept = next((REPEATS[kind.__name__] for kind in type(layer).__mro__ if kind.__name__ in REPEATS), "")
        steps *= int(getattr(layer, kept, 1))


def check_spaces(name: str, observations: gym.Space[Any], actions: gym.Space[Any]) -> None:
    """Raise a DelayRLError unless observations are flat, and actions flat, continuous and bounded."""
    if not isinstance(observations, Box) or len(observations.shape) != 1:
        got, hint = " ".join(str(observations).split())[:200], ""
        if isinstance(observations, Box) and observations.dtype == np.uint8 and len(observations.shape) > 1:
            hint = ": nothing here learns from images; observe the pose that is computed from them"
        elif getattr(observations, "is_np_flattenable", False):
            hint = ": gymnasium.wrappers.FlattenObservation, or flatten=True (--flatten) here, makes one of it"
        raise DelayRLError(f"{name}: observations must be a Box of flat vectors; got {got}{hint}")
    if not isinstance(actions, Box) or len(actions.shape) != 1 or not np.issubdtype(actions.dtype, np.floating):
        hint = "let the environment take a Box of floats, and round inside"
        raise DelayRLError(f"{name}: actions must be a flat, continuous Box; got {actions}: {hint}")
    if not actions.shape[0]:
        raise DelayRLError(f"{name}: there must be an action; got {actions}")
    if not (np.isfinite(actions.low) & np.isfinite(actions.high) & (actions.low < actions.high)).all():
        raise DelayRLError(
            f"{name}: actions must be bounded, with low < high; got {actions}: give the actuators' limits"
        )


def limit_of(env: Any) -> int | None:
    """Return the time limit of an environment in steps, the least of its spec's and its layers'; None without one."""
    layers = _layers_with_steps(env)
    limits = [-(-layer._max_episode_steps // steps) for layer, steps in layers if isinstance(layer, TimeLimit)]
    if env.spec is not None and env.spec.max_episode_steps is not None:
        limits.append(env.spec.max_episode_steps)
    return min(map(int, limits), default=None)


def check_limit(env: Any, name: str) -> None:
    """Raise DelayRLError if an environment has no time limit: nobody could wait for the end of its episodes."""
    if limit_of(env) is None:
        hint = "add the wrapper 'gymnasium.wrappers:TimeLimit(max_episode_steps=1000)', or write it behind a | "
        raise DelayRLError(f"{name} has no time limit, so an episode may never end; {hint}in the task")


def check_length(delay: Delay, name: str, limit: int | None) -> None:
    """Raise DelayRLError if a delay is longer than an episode of this task, whose time limit may be unknown."""
    longest = max(delay.maximum, delay.reward.maximum)
    if limit is not None and longest > limit:
        raise DelayRLError(f"a delay of {longest} steps is longer than an episode of {name} ({limit} steps)")


def warn_once(line: str) -> None:
    """Warn of the task that a user makes. Training makes the same task many times."""
    if line not in _warned:
        _warned.add(line)
        if sys.version_info >= (3, 12):
            warnings.warn(line, DelayWarning, skip_file_prefixes=(PACKAGE,))
        else:
            warnings.warn(line, DelayWarning, stacklevel=4)
