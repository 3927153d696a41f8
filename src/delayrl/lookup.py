"""From names to the code that they stand for, and back; with the errors of that code as one line.

A name is `module:object`, or that of an entry point: an installed package declares it, in a group such as
`delayrl.agents`, to stand for a `module:object` of its own.
"""

import difflib
import functools
import importlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from delayrl.errors import DelayRLError, described, did_you_mean, one_line


def find_object(name: str) -> Any:
    """Import what `module:object` names. Raises DelayRLError if there is no such module or object."""
    source, _, path = name.partition(":")
    module = find_module(source)
    found = attribute(module, path)
    if found is None:
        near = difflib.get_close_matches(path, vars(module), n=3, cutoff=0.5)
        raise DelayRLError(f"module {source!r} has no {path!r}{did_you_mean(near)}")
    return found


def find_module(source: str) -> ModuleType:
    """Import a module, which may lie in the working folder, as with `python -m`. Raises DelayRLError if that fails."""
    if "/" in source or source.endswith(".py"):
        name = source.removeprefix("./").removesuffix(".py").replace("/", ".")
        raise DelayRLError(f"a module is named as in an import, such as {name}; got {source!r}")
    _search_working_folder()
    with one_line(f"cannot import {source!r}"):
        try:
            return importlib.import_module(source)
        except ModuleNotFoundError as error:
            if error.name != source.partition(".")[0]:  # the module is there, and needs another that is not
                raise
            hint = f"it is looked for in the working folder, {os.getcwd()}, and among installed packages"
            raise DelayRLError(f"cannot import {source!r}: {described(error)}; {hint}") from error


def _search_working_folder() -> None:
    if not sys.flags.safe_path and not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())


def attribute(thing: Any, path: str) -> Any:
    """Return what a dotted path leads to, or None."""
    for name in path.split("."):
        thing = getattr(thing, name, None)
    return thing


def name_of_object(thing: Any) -> str:
    """Return the `module:object` by which a class or function can be imported, or `<object>` if there is none."""
    module = getattr(thing, "__module__", None) or "__main__"
    path = getattr(thing, "__qualname__", type(thing).__name__)
    if module != "__main__" and attribute(sys.modules.get(module), path) is thing:
        return f"{module}:{path}"
    return f"<{path.rpartition('.')[2].strip('<>')}>"


def entry_points(group: str) -> dict[str, str]:
    """Return what installed packages declare in a group: the `module:object` of each name."""
    return _declared(group, tuple(sys.path))


@functools.cache  # it reads a file of every installed package
def _declared(group: str, path: tuple[str, ...]) -> dict[str, str]:
    from importlib import metadata  # takes longer than all of this module, and few names need it

    return {point.name: point.value.replace(" ", "") for point in metadata.entry_points(group=group)}


def public_name(name: str, group: str) -> str:
    """Return the entry point that stands for a `module:object`, or the name itself: one thing has one name."""
    return next((short for short, source in entry_points(group).items() if source == name), name)


def is_unsafe(name: str, folder: Path) -> bool:
    """Return whether a run folder may not name the module of `module:object`. Imports nothing.

    It may not if the module lies in or beside the folder, or is Python's own: these hold nothing that a run needs, and
    some act when they are imported.
    """
    _search_working_folder()
    source = name.partition(":")[0]
    package = source.partition(".")[0]
    if package in sys.stdlib_module_names:
        return True
    with one_line(f"cannot import {source!r}"):
        spec = importlib.util.find_spec(package)
    places = [spec.origin or "", *(spec.submodule_search_locations or [])] if spec is not None else []
    return any(Path(place).resolve().is_relative_to(top) for place in places for top in _tops(folder))


def _tops(folder: Path) -> Iterator[Path]:
    """Yield the highest folder below the working folder that holds a run: what was downloaded is not above it."""
    here = Path.cwd().resolve()
    for path in (Path(os.path.abspath(folder)), folder.resolve()):  # they differ if one of the folders is a link
        top = here.joinpath(*path.relative_to(here).parts[:1]) if path.is_relative_to(here) else path
        yield top.resolve()


def with_arguments(name: str, kwargs: Mapping[str, Any]) -> str:
    """Return `name(argument=value, …)` with values as JSON, or the name alone. Raises TypeError for other values."""
    values = ", ".join(f"{key}={json.dumps(value)}" for key, value in sorted(kwargs.items()))
    return f"{name}({values})" if values else name


def parse_arguments(text: str) -> tuple[dict[str, Any], str]:
    """Return the keyword arguments that follow an opening bracket, and the text behind the closing one.

    Raises:
        ValueError: a value that is not JSON, or no closing bracket.
    """
    kwargs = {}
    while name := re.match(r"[\s,]*(\w+)\s*=\s*", text):
        kwargs[name[1]], end = json.JSONDecoder().raw_decode(text, name.end())
        text = text[end:]
    inside, bracket, rest = text.partition(")")
    if inside.strip() or not bracket:
        raise ValueError("no closing bracket")
    return kwargs, rest.strip()


def contents(thing: Any, skipped: Collection[str] = ()) -> Any:
    """Return what a dataclass holds, as JSON can, but for some fields and those that JSON cannot hold.

    A function or class stands as the name that it can be imported by. None if there is nothing to return.
    """
    if is_dataclass(thing) and not isinstance(thing, type):
        held = {field.name: getattr(thing, field.name) for field in fields(thing) if field.name not in skipped}
        inner = {name: contents(value, skipped) for name, value in held.items()}
        return {"": type(thing).__qualname__, **{name: value for name, value in inner.items() if value is not None}}
    if isinstance(thing, tuple | list):
        items = [contents(value, skipped) for value in thing if value is not None]
        return None if None in items else items
    if isinstance(thing, Mapping):
        return contents(sorted((str(key), value) for key, value in thing.items() if value is not None))
    if isinstance(thing, str | int | float):
        return thing
    module, _, path = name_of_object(thing).partition(":") if callable(thing) else ("", "", "")
    if not path:  # it cannot be imported by a name
        return None
    private = any(part.startswith("_") for part in module.split("."))  # where a library may move it
    return path if private else f"{module}:{path}"
