"""From the names of tasks and wrappers to the ids, classes and functions that they stand for."""

import difflib
import re
import sys
import sysconfig
from pathlib import Path
from typing import Any

import gymnasium as gym

from delayrl.errors import DelayRLError, did_you_mean
from delayrl.lookup import attribute, find_module, is_unsafe


def with_version(name: str) -> str:
    """Return an id of Gymnasium's registry with its version, the newest if it has none; another name unchanged."""
    pattern = re.compile(rf"{re.escape(name)}-v(\d+)")
    versions = [int(match[1]) for known in gym.registry if (match := pattern.fullmatch(known))]
    return name if name in gym.registry or not versions else f"{name}-v{max(versions)}"


def find_id(name: str) -> str:
    """Return an id of Gymnasium's registry unchanged. Raises DelayRLError, with the nearest ids, for another name."""
    if name in gym.registry:
        return name
    near = difflib.get_close_matches(name, gym.registry, n=3, cutoff=0.5)
    usual = "`delayrl tasks` lists tasks; one of your own is MODULE:NAME, or MODULE:ID if the module registers it"
    raise DelayRLError(f"unknown task {name!r}{did_you_mean(near, usual)}")


def find_maker(name: str) -> Any:
    """Import what `module:object` names: a class or function, or the id of a task that the module registers.

    The working folder is searched too, as `python -m` does.

    Raises:
        DelayRLError: the module cannot be imported, or has no such object, or the object is an environment.
    """
    source, _, path = name.partition(":")
    module = find_module(source)
    found = attribute(module, path)
    refuse_instance(found)
    if callable(found):
        return found
    if (registered := with_version(path)) in gym.registry:
        return registered
    known = [name for name, value in vars(module).items() if callable(value)]
    near = difflib.get_close_matches(path, [*known, *gym.registry], n=3, cutoff=0.5)
    line = f"module {source!r} has no class or function {path!r}, and registers no such task"
    raise DelayRLError(line + did_you_mean(near))


def refuse_instance(thing: Any) -> None:
    """Raise DelayRLError for an environment where something that makes one is needed."""
    if isinstance(thing, gym.Env | gym.vector.VectorEnv):
        what = type(thing.unwrapped).__name__
        hint = "give its class, a function that makes it, or its id, because evaluation and resuming need fresh ones"
        raise DelayRLError(f"a task makes environments, and this is one (an instance of {what}): {hint}")


def find_stored(name: str, folder: Path) -> Any:
    """Import what a run folder names as `module:object`, if a folder from elsewhere could do no harm by that.

    It may name classes of environments and of wrappers, ids that a module registers, and functions of the user's own
    code. It may not name code that came with it, nor a function of an installed package: with keyword arguments of its
    choice that may do anything. The module of such a function is imported before that is known; Python's own never are.

    Raises:
        DelayRLError: it may not name this, or `find_maker` does not find it.
    """
    refusal = DelayRLError(f"{folder} came with a task that could run any code, {name}: if you mean it, give it as env")
    if is_unsafe(name, folder):
        raise refusal
    found = find_maker(name)
    if (
        isinstance(found, str)
        or (isinstance(found, type) and issubclass(found, gym.Env))
        or is_users(file_of(getattr(found, "__module__", None) or ""))
    ):
        return found
    raise refusal


def file_of(module: str) -> str:
    """Return the file of an imported module; nothing where it has none, as in a notebook."""
    return getattr(sys.modules.get(module), "__file__", None) or ""


def is_users(file: str) -> bool:
    """Return whether a file is neither Python's own, nor of this package, nor in a folder of installed packages."""
    path = Path(file).resolve()
    others = [Path(__file__).parents[1], *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib"))]
    installed = {"site-packages", "dist-packages"} & set(path.parts)
    return bool(file) and not installed and not any(path.is_relative_to(other.resolve()) for other in others)
