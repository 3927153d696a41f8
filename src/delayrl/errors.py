"""The exceptions that people see, as a single line."""

import contextlib
import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any


class DelayRLError(Exception):
    """Bad input or a broken file: what was given, what is allowed, what to try, in one line."""


class StoppedError(DelayRLError):
    """A run stopped when asked to. Its newest step is stored; the same call resumes it."""


class MissingExtraError(DelayRLError, ImportError):
    """An optional library is not installed: which extra brings it."""


STOPPED = 75
"""Exit status of a stopped run or an unfinished grid, which the same command resumes (EX_TEMPFAIL)."""


class DelayWarning(UserWarning):
    """Something that works, but is probably not meant: one line."""


EXTRAS = {
    "train": ("imageio", "jax", "jaxlib", "jaxtyping", "matplotlib", "mujoco", "optax", "PIL", "scipy"),
    "deploy": ("onnx", "onnxruntime"),
    "hub": ("huggingface_hub",),
    "parquet": ("pyarrow",),
    "brax": ("brax",),
    "ray": ("ray",),
    "examples": ("stable_baselines3",),
}
"""Modules that each extra brings."""


def needs_extra(error: BaseException) -> MissingExtraError | None:
    """Return the error that says which extra brings a missing module; None if no module of ours is missing."""
    both = (error, error.__cause__)  # Gymnasium raises an error of its own from that of the import
    names = [one.name or "" for one in both if isinstance(one, ModuleNotFoundError)]
    module = "".join(names[:1]).partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if module in modules), None)
    return MissingExtraError(f"this needs {module}: pip install 'delayrl[{extra}]'") if extra else None


def import_later(package: str, homes: Mapping[str, str], name: str) -> Any:
    """Return a name of a package from the module that has it, for `__getattr__`: `homes` says which."""
    if name not in homes:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{package}.{homes[name]}"), name)
    except ModuleNotFoundError as error:
        raise (needs_extra(error) or error) from error


ELSEWHERE = {
    "gamma": "discount",
    "tau": "target_rate",
    "net_arch": "hidden",
    "buffer_size": "replay_capacity",
    "learning_starts": "random_steps",
    "total_timesteps": "steps",
    "normalise": "observation_norm",
    "normalize": "observation_norm",
    "from": "start_from",
    "from_": "start_from",
    "quiet": "progress",
    "verbose": "progress",
}
"""Options of other libraries and functions, and what they are called here."""


def near_names(name: str, known: Iterable[str]) -> list[str]:
    """Return up to three known names that may be meant: by their name elsewhere, by initials, or by spelling."""
    known, letters = list(dict.fromkeys(known)), name.strip("-").lower()
    ours = ELSEWHERE.get(letters.replace("-", "_"))
    if same := [other for other in known if ours and other.strip("-").replace("-", "_") == ours]:
        return same
    initials = {other: "".join(word[0] for word in re.findall(r"[^\W_]+", other)) for other in known}
    abbreviated = [other for other in sorted(known, key=len) if initials[other].endswith(letters)]
    if len(letters) > 1 and abbreviated:
        return abbreviated[:3]
    return difflib.get_close_matches(name, known, n=3, cutoff=0.6)


def did_you_mean(near: Sequence[str], otherwise: str = "") -> str:
    """Write the end of an error's message: the nearest names, or what to do where there are none."""
    hint = f"did you mean {', '.join(near)}?" if near else otherwise
    return f"; {hint}" if hint else ""


def count(number: int, noun: str) -> str:
    """Write a number of things, in the plural unless there is one."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or the name of its type where the message is empty."""
    printable = "".join(c if c.isprintable() or c in "\r\n" else " " for c in str(error)).strip()
    return printable.splitlines()[0] if printable else type(error).__name__


def described(error: BaseException) -> str:
    """Return the type of an error and the first line of its message, if it has one."""
    name, line = type(error).__name__, first_line(error)
    return name if line == name else f"{name}: {line}"


@contextlib.contextmanager
def one_line(what: str, longest: int | None = None) -> Iterator[None]:
    """Raise what other code raises as a DelayRLError: `what`, and the type and message, cut at `longest` characters."""
    try:
        yield
    except DelayRLError:
        raise
    except (Exception, SystemExit) as error:  # a script without a guard may end the process when it is imported
        raise (needs_extra(error) or DelayRLError(f"{what}: {described(error)[:longest]}")) from error
