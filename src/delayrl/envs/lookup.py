"""From names to the code that they stand for, and back; with the errors of that code as one line."""

import contextlib
import difflib
import importlib
import importlib.util
import os
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym

from delayrl.errors import DelayRLError, described


def is_registered(name: str) -> bool:
    """Return whether Gymnasium knows an id, which may leave out its version."""
    return name in gym.registry or any(known.rpartition("-v")[0] == name for known in gym.registry)


def find_id(name: str) -> str:
    """Return an id of Gymnasium's registry unchanged. Raises DelayRLError, with the nearest ids, if it has none."""
    if is_registered(name):
        return name
    near = difflib.get_close_matches(name, gym.registry, n=3, cutoff=0.5)
    hint = f"did you mean {', '.join(near)}?" if near else "`delayrl tasks` lists tasks to choose from"
    raise DelayRLError(f"unknown task {name!r}; {hint}")


def find_object(name: str) -> Any:
    """Import what `module:object` names: a class or function, or the id of a task that the module registers.

    The working folder is searched too, as `python -m` does.

    Raises:
        DelayRLError: the module cannot be imported, or has no such object.
    """
    source, _, path = name.partition(":")
    _search_working_folder()
    with one_line(f"cannot import {source!r}"):
        module = importlib.import_module(source)
    found = attribute(module, path)
    if callable(found):
        return found
    if is_registered(path):
        return path
    known = [name for name, value in vars(module).items() if callable(value)]
    near = difflib.get_close_matches(path, [*known, *gym.registry], n=3, cutoff=0.5)
    hint = f"; did you mean {', '.join(near)}?" if near else ""
    raise DelayRLError(f"module {source!r} has no class or function {path!r}, and registers no such task{hint}")


def _search_working_folder() -> None:
    if not sys.flags.safe_path and not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())


def name_of_object(thing: Any) -> str:
    """Return the `module:object` by which a class or function can be imported, or `<object>` if there is none."""
    module = getattr(thing, "__module__", None) or "__main__"
    path = getattr(thing, "__qualname__", type(thing).__name__)
    if module != "__main__" and attribute(sys.modules.get(module), path) is thing:
        return f"{module}:{path}"
    return f"<{path.rpartition('.')[2].strip('<>')}>"


def attribute(thing: Any, path: str) -> Any:
    """Return what a dotted path leads to, or None."""
    for name in path.split("."):
        thing = getattr(thing, name, None)
    return thing


def find_stored(name: str, folder: Path) -> Any:
    """Import what a run folder names as `module:object`, if a folder from elsewhere could do no harm by that.

    It may name classes of environments and of wrappers, ids that a module registers, and functions of the user's own
    code. It may not name code that came with it, nor a function of Python or of an installed package: with keyword
    arguments of its choice that may do anything.

    Raises:
        DelayRLError: it may not name this, or `find_object` does not find it.
    """
    _search_working_folder()
    source = name.partition(":")[0]
    refusal = DelayRLError(f"{folder} came with a task that could run any code, {name}: if you mean it, give it as env")
    with one_line(f"cannot import {source!r}"):
        spec = importlib.util.find_spec(source.partition(".")[0])  # of the package: imports nothing
    places = [spec.origin or "", *(spec.submodule_search_locations or [])] if spec is not None else []
    if any(Path(place).resolve().is_relative_to(top) for place in places for top in _tops(folder)):
        raise refusal
    found = find_object(name)
    if isinstance(found, str) or (isinstance(found, type) and issubclass(found, gym.Env)) or _is_own(found):
        return found
    raise refusal


def _tops(folder: Path) -> Iterator[Path]:
    """Yield the highest folder below the working folder that holds a run: what was downloaded is not above it."""
    here = Path.cwd().resolve()
    for path in (Path(os.path.abspath(folder)), folder.resolve()):  # they differ if one of the folders is a link
        top = here.joinpath(*path.relative_to(here).parts[:1]) if path.is_relative_to(here) else path
        yield top.resolve()


def _is_own(thing: Any) -> bool:
    """Return whether code is neither of Python itself nor in a folder of installed packages."""
    module = sys.modules.get(getattr(thing, "__module__", None) or "")
    file = getattr(module, "__file__", None)
    if file is None:
        return False
    path = Path(file).resolve()
    python = [Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib")]
    return not {"site-packages", "dist-packages"} & set(path.parts) and not any(map(path.is_relative_to, python))


@contextlib.contextmanager
def one_line(what: str) -> Iterator[None]:
    """Raise whatever code of the user raises as a DelayRLError: `what`, and the error's own type and message."""
    try:
        yield
    except DelayRLError:
        raise
    except (Exception, SystemExit) as error:  # a script without a guard may end the process when it is imported
        raise DelayRLError(f"{what}: {described(error)}") from error
