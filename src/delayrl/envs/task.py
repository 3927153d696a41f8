"""Tasks: how users name them, the one text that names them, and how their environments are made.

A task is what makes an environment, its keyword arguments, and the wrappers around it. Its text holds all of that, so
a run, a row of results and a grid need no other field for it:

    Pendulum-v1
    Pendulum-v1(g=5.0)
    arm:Arm(gain=2, model="arm.xml") | gymnasium.wrappers:TimeLimit(max_episode_steps=200) | flatten

The first part is an id of Gymnasium's registry, `module:id`, or `module:object` for a class or function. An id without
a version gets the newest. Each part behind a bar names a wrapper as `module:object`; `flatten` joins nested
observations to one vector. Values are JSON. What cannot be imported by a name, such as a lambda, is written `<lambda>`.
"""

import contextlib
import json
import re
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import FlattenObservation

from delayrl.envs.lookup import find_id, find_maker, find_stored, refuse_instance, with_version
from delayrl.errors import DelayRLError, one_line
from delayrl.lookup import name_of_object, parse_arguments, with_arguments

Env = gym.Env[Any, Any]
FLATTEN = "flatten"
_made: weakref.WeakValueDictionary[int, Env] = weakref.WeakValueDictionary()  # by functions of users


@dataclass(frozen=True)
class Part:
    """One part of a task's text.

    Attributes:
        name: an id, `module:object`, `flatten`, or `<object>` for what cannot be imported by a name.
        kwargs: its keyword arguments, which JSON can hold.
        found: what the name stands for, if that is known already.
    """

    name: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    found: Any = field(default=None, compare=False)

    def find(self) -> Any:
        """Return the id, spec, class or function. Raises DelayRLError if nothing has this name."""
        if self.found is not None:
            return self.found
        if self.name == FLATTEN:
            return FlattenObservation
        if self.name.startswith("<"):
            raise DelayRLError(f"{self.name} has no name that it could be imported by: give it again, as env")
        return find_maker(self.name) if ":" in self.name else find_id(self.name)

    def __str__(self) -> str:
        return with_arguments(self.name, self.kwargs)


@dataclass(frozen=True)
class Task:
    """What makes an environment, and the wrappers around it, innermost first."""

    env: Part
    wrappers: tuple[Part, ...] = ()

    def __str__(self) -> str:
        return " | ".join(map(str, (self.env, *self.wrappers)))

    @property
    def limit(self) -> int | None:
        """The time limit in steps, if it is known without making the task."""
        spec = gym.registry.get(self.env.name)
        return None if spec is None or "max_episode_steps" in self.env.kwargs else spec.max_episode_steps

    def make(self, **options: Any) -> Env:
        """Make a fresh environment.

        Args:
            **options: more keyword arguments for what makes it, e.g. `render_mode`.

        Raises:
            DelayRLError: nothing has this name, or the code that it names raises: the message is that of its error.
        """
        maker, arguments = self.env.find(), {**self.env.kwargs, **options}
        with one_line(f"task {str(self.env)!r} cannot be made here"), quiet():
            by_id = isinstance(maker, str | EnvSpec)
            env = gym.make(maker, disable_env_checker=True, **arguments) if by_id else maker(**arguments)
        _check_env(self.env, env)
        if not by_id:
            _check_fresh(self.env, env.unwrapped)
        for part in self.wrappers:
            wrapper = part.find()
            with one_line(f"wrapper {str(part)!r} cannot be put around {self.env}"):
                env = wrapper(env, **part.kwargs)
            _check_env(part, env)
        return env


TaskLike = str | EnvSpec | Callable[..., Env] | Task
"""How users give a task: its text, a spec of Gymnasium, or a class or function that makes an environment."""
WrapperLike = str | Callable[..., Env]


def as_task(
    env: TaskLike,
    kwargs: Mapping[str, Any] | None = None,
    wrappers: WrapperLike | Sequence[WrapperLike] = (),
    flatten: bool = False,
) -> Task:
    """Return the task that a user gave.

    Args:
        env: as `TaskLike` says.
        kwargs: more keyword arguments for what makes the environment.
        wrappers: one more wrapper, or several, innermost first: classes or functions, or their names `module:object`.
        flatten: whether observations are joined to one vector, outside all wrappers.

    Raises:
        DelayRLError: an environment instead of what makes one, a text that is no task's, arguments that JSON cannot
            hold, a wrapper without a name.
    """
    task = env if isinstance(env, Task) else _parse(env) if isinstance(env, str) else Task(_named(env))
    first = replace(task.env, name=with_version(task.env.name), kwargs={**task.env.kwargs, **_plain(kwargs or {})})
    around = list(task.wrappers)
    for wrapper in [wrappers] if isinstance(wrappers, str) or callable(wrappers) else wrappers:
        if not isinstance(wrapper, str) and not callable(wrapper):
            raise DelayRLError(f"a wrapper is module:Class, a class or a function; got {wrapper!r}")
        more = _parse(wrapper) if isinstance(wrapper, str) else Task(_named(wrapper))
        around += [more.env, *more.wrappers]
    if not isinstance(flatten, bool):
        raise DelayRLError(f"flatten is True or False; got {flatten!r}")
    if flatten and around[-1:] != [Part(FLATTEN)]:
        around.append(Part(FLATTEN))
    for part in around:
        if ":" not in part.name and part.name != FLATTEN:
            hint = "apply any other in a function that makes the environment"
            raise DelayRLError(f"a wrapper is named module:Class, or flatten; got {part.name}: {hint}")
    return Task(first, tuple(around))


def stored_task(text: str, folder: Path, env: TaskLike | None = None, kwargs: Mapping[str, Any] | None = None) -> Task:
    """Return the task of a run folder, with everything looked up that its text names.

    Args:
        text: what its configuration says.
        folder: of the run.
        env: makes the environment instead, for example where the text has no name to import it by. It gets the run's
            keyword arguments, replaced or completed by its own, and the run's wrappers unless it has some.
        kwargs: keyword arguments that replace or complete the run's.

    Raises:
        DelayRLError: as `as_task`; or the folder names code that it may not name (`lookup.find_stored`).
    """
    task = as_task(text)
    given = Task(_looked_up(task.env, folder)) if env is None else as_task(env)
    maker = replace(given.env, kwargs={**task.env.kwargs, **given.env.kwargs})
    around = given.wrappers or tuple(_looked_up(part, folder) for part in task.wrappers)
    return as_task(Task(maker, around), kwargs)


def _looked_up(part: Part, folder: Path) -> Part:
    found = find_stored(part.name, folder) if ":" in part.name else part.find()
    return replace(part, found=found)


def _parse(text: str) -> Task:
    parts, rest = [], f"|{text}"
    try:
        while part := re.match(r"\s*\|\s*([^()|]*[^()|\s])\s*(\(?)", rest):
            rest = rest[part.end() :]
            kwargs, rest = parse_arguments(rest) if part[2] else ({}, rest)
            parts.append(Part(part[1], kwargs))
        if parts and not rest:
            return Task(parts[0], tuple(parts[1:]))
    except ValueError:  # no JSON, or no closing bracket
        pass
    example = 'my_module:Arm(gain=2, model="arm.xml") | flatten'
    raise DelayRLError(f"cannot read the task {text!r}; write an id, or e.g. {example}, with values as JSON")


def _plain(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return keyword arguments as JSON gives them back, so that a run is trained with what it is loaded with."""
    try:
        return dict(json.loads(json.dumps(dict(kwargs))))
    except (TypeError, ValueError) as error:
        hint = "set them in a function that makes the environment"
        raise DelayRLError(f"keyword arguments of an environment are what JSON can hold ({error}): {hint}") from error


def _named(thing: Any) -> Part:
    """Return the part that stands for a spec, class or function. Raises DelayRLError for anything else."""
    if isinstance(thing, EnvSpec):
        usual = gym.registry.get(thing.id)
        if usual is not None and replace(thing, kwargs=usual.kwargs) == usual:
            changed = {name: value for name, value in thing.kwargs.items() if usual.kwargs.get(name) != value}
            return Part(thing.id, _plain(changed))
        return Part(f"<{thing.id}>", {}, thing)
    refuse_instance(thing)
    if not callable(thing):
        raise DelayRLError(f"a task is an id, module:function, a class or a function; got {thing!r}")
    return Part(name_of_object(thing), {}, thing)


def _check_env(part: Part, env: Any) -> None:
    if not isinstance(env, gym.Env):
        raise DelayRLError(f"{part.name} must return a Gymnasium environment; got {type(env).__name__}")


def _check_fresh(part: Part, base: Env) -> None:
    """Raise DelayRLError if a function made this environment before: training and evaluation would disturb it."""
    if _made.get(id(base)) is base:
        raise DelayRLError(f"{part.name} returned the same environment twice: let it make a fresh one each time")
    _made[id(base)] = base


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress notes on deprecated models and versions, which MuJoCo would also log to a file in the current folder."""
    with warnings.catch_warnings(), contextlib.ExitStack() as stack:
        warnings.simplefilter("ignore")
        with contextlib.suppress(ModuleNotFoundError):
            import mujoco

            mujoco.set_mju_user_warning(lambda message: None)
            stack.callback(mujoco.set_mju_user_warning, None)
        yield


@contextlib.contextmanager
def closing_quietly(env: Any) -> Iterator[Any]:
    """Yield an environment, and close it at the end. What its `close` raises changes no result, and is left aside."""
    try:
        yield env
    finally:
        with contextlib.suppress(Exception):
            env.close()
