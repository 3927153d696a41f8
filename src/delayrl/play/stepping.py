"""Reset and step environments whose code is the user's: what it raises becomes one line that says where."""

import traceback
from pathlib import Path
from typing import Any

from delayrl.envs.making import name_of
from delayrl.errors import DelayRLError, described


def reset(env: Any, seed: int) -> tuple[Any, dict[str, Any]]:
    """Start an episode. Raises DelayRLError for whatever the environment raises, with its traceback attached."""
    try:
        return env.reset(seed=seed)  # type: ignore[no-any-return]
    except DelayRLError:
        raise
    except Exception as error:  # a try for each step costs nothing, a context manager would
        raise _one_line(env, "reset", error) from error


def step(env: Any, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
    """Take a step. Raises DelayRLError for whatever the environment raises, with its traceback attached."""
    try:
        return env.step(action)  # type: ignore[no-any-return]
    except DelayRLError:
        raise
    except Exception as error:
        raise _one_line(env, "step", error) from error


def _one_line(env: Any, method: str, error: Exception) -> DelayRLError:
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}, line {place.lineno}"
    return DelayRLError(f"{name_of(env)} failed in {method}: {described(error)} ({where})")
