"""Reset and step environments whose code is the user's: what it raises becomes one line that says where."""

import traceback
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.envs.lookup import is_users
from delayrl.envs.making import name_of
from delayrl.errors import DelayRLError, described


def reset(env: Any, seed: int) -> tuple[Any, dict[str, Any]]:
    """Start an episode. Raises DelayRLError for whatever the environment raises, and for what no environment gives."""
    try:
        obs, info = env.reset(seed=seed)
    except DelayRLError:
        raise
    except (Exception, SystemExit) as error:  # a try for each step costs nothing, a context manager would
        raise _one_line(env, "reset", error) from error
    _check_shape(env, info["truth"])
    return obs, info


def step(env: Any, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Take a step. Raises DelayRLError for whatever the environment raises, and for what no environment gives."""
    try:
        obs, reward, terminated, truncated, info = env.step(action)
    except DelayRLError:
        raise
    except (Exception, SystemExit) as error:
        raise _one_line(env, "step", error) from error
    _check_shape(env, info["truth"])
    try:
        return obs, float(reward), bool(terminated), bool(truncated), info
    except (TypeError, ValueError):
        given = f"the reward {reward!r}, terminated = {terminated!r} and truncated = {truncated!r}"
        raise DelayRLError(f"{name_of(env)} gave {given}: they must be a number and two truth values") from None


def _check_shape(env: Any, truth: Any) -> None:
    if np.shape(truth) != env.observation_space.shape:
        declared = f"its observation_space has {env.observation_space.shape}"
        raise DelayRLError(f"{name_of(env)} gave an observation of shape {np.shape(truth)}, but {declared}")


def _one_line(env: Any, method: str, error: BaseException) -> DelayRLError:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if is_users(frame.filename)]
    place = (own or frames)[-1]
    file = Path(place.filename).parts[-1 if own else -3 :]  # of a library, such as gymnasium/wrappers/common.py
    where = f"{'/'.join(file)}, line {place.lineno}"
    return DelayRLError(f"{name_of(env)} failed in {method}: {described(error)} ({where})")
