"""Agents as users name them: those of the registry, of installed packages, and their own.

An agent's name is that in the registry, that of an entry point in the group `delayrl.agents`, or `module:object` for
a class, an instance, or a `Registration` that has presets. In Python the class or an instance may be given itself. A
run keeps the name beside the hyperparameters; what no name leads back to, such as a class in a script, is `<object>`.
"""

import contextlib
import difflib
import hashlib
import inspect
import sys
import warnings
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from delayrl.agents.base import Agent, Schedule
from delayrl.agents.normalised import NormalisedObservations
from delayrl.agents.registry import AGENTS, Registration, registered
from delayrl.envs.lookup import file_of, is_users
from delayrl.errors import DelayRLError, DelayWarning, did_you_mean, one_line
from delayrl.lookup import entry_points, find_object, is_unsafe, name_of_object, public_name
from delayrl.run.configuration import OLDER, TAKEN, check_names, options, override, values_of
from delayrl.run.folder import versions_in

GROUP = "delayrl.agents"
AgentLike = str | Agent | type[Agent]
"""How users give an agent: its name, its class, or an instance with hyperparameters of its own."""
PARTS = ("privileged", "ahead", "phases", "init", "act", "deterministic")
"""What the protocol `Agent` asks for."""


class Named(NamedTuple):
    """An agent with its name."""

    name: str
    registration: Registration


def as_agent(agent: AgentLike) -> Named:
    """Return the name and the presets of what a user gave. Raises DelayRLError if it is no agent, or unknown."""
    if isinstance(agent, str):
        name = public_name(agent, GROUP) if ":" in agent else agent
        return Named(name, find_agent(name))
    if not isinstance(agent, type) and not is_dataclass(agent):
        line = "an agent is a name (`delayrl agents`), MODULE:NAME, a class or an instance"
        hint = ": name its variable, as text" if isinstance(agent, Registration) else ""
        raise DelayRLError(f"{line}; got {agent!r:.80}{hint}")
    kind = agent if isinstance(agent, type) else type(agent)
    name, made = name_of_object(kind), _checked(agent, kind.__name__)
    if not name.startswith("<") and not _is_made_of(name, made):
        name = f"<{kind.__name__}>"
    return Named(public_name(name, GROUP), _entry(agent, made))


def find_agent(name: str, stored: Path | None = None) -> Registration:
    """Return the entry of the agent with this name.

    Args:
        name: in the registry, of an entry point, or `module:object`.
        stored: the run folder that says so. It may not name code that came with it.

    Raises:
        DelayRLError: there is none (the message has the nearest names), or what has this name is no agent.
    """
    if name in AGENTS:
        return AGENTS[name]
    if name.startswith("<"):
        raise DelayRLError(f"{name} has no name that it could be imported by: give it again, as agent")
    source = name
    if ":" not in name:
        declared = entry_points(GROUP)
        if name not in declared:
            lower = {known.lower(): known for known in agent_names()}
            near = [lower[one] for one in difflib.get_close_matches(name.lower(), lower, n=2, cutoff=0.5)]
            usual = "`delayrl agents` lists them; one of your own is MODULE:NAME, and a run is named by its folder"
            raise DelayRLError(f"unknown agent {name!r}{did_you_mean(near, usual)}")
        source = declared[name]
    if stored is not None and is_unsafe(source, stored):
        what = f"an agent that could run any code, {source}"
        raise DelayRLError(f"{stored} came with {what}: if you mean it, give it as agent")
    found = find_object(source)
    if isinstance(found, Registration):
        if not found.presets:
            raise DelayRLError(f"{name} has no preset: give its Registration one, as docs/own-agent.md shows")
        for preset in found.presets.values():
            _checked(preset.agent, name)
        return found
    return _entry(found, _checked(found, name))


def agent_of(config: Mapping[str, Any], folder: Path, given: AgentLike | None = None) -> Agent:
    """Make the agent that a run's configuration describes.

    Args:
        config: of the run.
        folder: of the run, which may not name code that came with it.
        given: the agent instead, for example where the configuration has no name to import it by. It gets the run's
            hyperparameters.

    Raises:
        DelayRLError: an unknown agent, preset or hyperparameter.
    """
    registration = find_agent(config["agent"], folder) if given is None else as_agent(given).registration
    if config["preset"] not in registration.presets:
        raise DelayRLError(f"the run's configuration names an unknown preset, {config['preset']!r}")
    preset = registration.presets[config["preset"]]
    agent = preset.agent
    check_names(config["hyperparameters"], agent)
    agent = override(agent, {**(OLDER if config["agent"] in AGENTS else {}), **config["hyperparameters"]})
    return as_trained(agent, override(preset.schedule, {**OLDER, **config["schedule"]}))


def code_of(name: str, agent: Agent) -> str | None:
    """Return a checksum of the modules that an agent's name, its classes and those of its dataclasses are in.

    Of classes without a module's file, as in a notebook, it takes their functions. What those modules import is not in
    it, nor are bases in installed packages. None for agents of this package, and where no code can be read.
    """
    source = name if ":" in name else entry_points(GROUP).get(name, "")
    own: Any = agent.agent if isinstance(agent, NormalisedObservations) else agent
    parts = [own, *filter(is_dataclass, (getattr(own, field.name) for field in fields(own)))]
    classes = list(dict.fromkeys(kind for part in parts for kind in type(part).__mro__))
    named = {source.partition(":")[0], type(own).__module__}
    code = []
    for module in sorted({*named, *(kind.__module__ for kind in classes)} - {""}):
        file = file_of(module)
        ours = module.partition(".")[0] in {"delayrl", *sys.stdlib_module_names}
        if ours or (module not in named and file and not is_users(file)):
            continue
        if Path(file).is_file():
            code.append(Path(file).read_bytes())
        else:
            code += [_source(kind) for kind in classes if kind.__module__ == module]
    return hashlib.sha256(b"".join(code)).hexdigest()[:12] if any(code) else None


def _source(kind: type) -> bytes:
    """Return the source of a class's own functions, as far as it can be read."""
    text = ""
    for value in vars(kind).values():
        function = inspect.unwrap(getattr(value, "__func__", None) or getattr(value, "fget", None) or value)
        if inspect.isfunction(function) and function.__module__ == kind.__module__:
            with contextlib.suppress(OSError):  # generated, or typed where nothing keeps it
                text += inspect.getsource(function)
    return text.encode()


def warn_of_other_code(config: Mapping[str, Any], folder: Path, agent: Agent) -> None:
    """Warn if the modules of an agent differ from those that a run was last trained with."""
    known = [used["agent_code"] for used in versions_in(config) if used.get("agent_code")]
    if known and code_of(config["agent"], agent) not in (None, known[-1]):
        line = f"the code of {config['agent']} has changed since {folder} was trained"
        warnings.warn(line, DelayWarning, stacklevel=3)


def as_trained(agent: Agent, schedule: Schedule) -> Agent:
    """Return an agent as a run with this schedule trains and plays it."""
    agent = _for_run(agent, schedule)
    return NormalisedObservations(agent) if schedule.observation_norm == "running" else agent


def _for_run(agent: Any, schedule: Schedule) -> Any:
    """Return an agent for a run of this schedule, with those that it holds in fields."""
    for field in fields(agent):
        held = getattr(agent, field.name)
        if field.init and is_dataclass(held) and (made := _for_run(held, schedule)) is not held:
            agent = replace(agent, **{field.name: made})
    for_run = getattr(agent, "for_run", None)
    return agent if for_run is None else for_run(schedule)


def agent_names() -> list[str]:
    """Return the names of the agents of the registry and of installed packages. Imports none of the latter."""
    return [*AGENTS, *entry_points(GROUP)]


def known_agents() -> dict[str, Registration]:
    """Return the agents of the registry and of installed packages. One that cannot be loaded says why."""
    known = dict(AGENTS)
    for name in sorted(entry_points(GROUP)):
        try:
            known[name] = find_agent(name)
        except DelayRLError as error:
            known[name] = Registration(f"cannot be loaded: {error}", "-", {})
    return known


def _checked(thing: Any, name: str) -> Agent:
    """Return an agent: the given one, or one of the given class. Raises DelayRLError if it is none, or not usable."""
    page = "docs/own-agent.md shows one"
    if not is_dataclass(thing):
        raise DelayRLError(f"{name} is no agent, because it is no dataclass: {page}")
    declared = {field.name for field in fields(thing)}
    if lacks := [part for part in PARTS if not hasattr(thing, part) and part not in declared]:
        raise DelayRLError(f"{name} is no agent, because it lacks {', '.join(lacks)}: {page}")
    agent: Any = thing
    if isinstance(thing, type):
        with one_line(f"agent {name} cannot be made without arguments, so its fields need defaults"):
            agent = thing()
    with one_line(f"agent {name} must be a frozen dataclass, with tuples for lists"):
        hash(agent)
    with one_line(f"the types of the fields of agent {name} cannot be read"):
        own = list(options(agent))
    for option in own:
        if any(option.name == other.name and option.default != other.default for other in own):
            line = f"agent {name} has two options {option.name} with different values, and one name sets both"
            raise DelayRLError(f"{line}: give one another name, or leave out its Annotated")
        if option.name in values_of(Schedule()):
            raise DelayRLError(f"agent {name} has an option {option.name}, as every run has: give it another name")
        option.check(option.default)
    return agent  # type: ignore[no-any-return]


def check_not_taken(name: str, agent: Agent) -> None:
    """Raise DelayRLError if an option is named like a parameter of `train`, which would take its value."""
    if taken := sorted(TAKEN & {option.name for option in options(agent)}):
        raise DelayRLError(f"{name} has an option {taken[0]}, and so has delayrl.train: give it another name")


def _entry(given: Any, made: Agent) -> Registration:
    """Return an entry for an own agent, whose presets differ in the schedule alone.

    If its class derives from one of ours, its protocols are that agent's. If it is given as a class, without values,
    its presets are that agent's too, as far as it takes their values.
    """
    own = registered(_summary(made), made)._replace(given=not isinstance(given, type))
    ours = next(filter(None, map(_agent_with_defaults_of, type(made).__mro__)), None)
    if ours is None:
        return own
    own = own._replace(official=ours.official)
    if not isinstance(given, type):
        return own
    try:
        presets = {name: preset._replace(agent=_as(preset.agent, made)) for name, preset in ours.presets.items()}
    except Exception:  # whatever its own code raises for values that it does not take
        return own
    return own._replace(presets=presets)


def _as(preset: Any, made: Any) -> Any:
    """Return an agent with a preset's values, but for fields that its class declares or has another default of."""
    base, kinds = type(preset), type(made).__mro__
    decorated = [kind for kind in kinds[: kinds.index(base)] if "__dataclass_fields__" in vars(kind)]
    declared = {name for kind in decorated for name in inspect.get_annotations(kind)}
    usual = base()
    values = {}
    for name in {field.name for field in fields(base)} - declared:
        if getattr(made, name) == getattr(usual, name) != getattr(preset, name):
            values[name] = getattr(preset, name)
    return replace(made, **values)


def _agent_with_defaults_of(kind: type) -> Registration | None:
    """Return the agent of ours whose preset `paper` is the class with its defaults: of SAC's, `sac`."""
    papers = ((entry, entry.presets["paper"].agent) for entry in AGENTS.values())
    return next((entry for entry, agent in papers if type(agent) is kind and agent == kind()), None)


def _is_made_of(name: str, agent: Agent) -> bool:
    """Return whether the class with this name and the agent's hyperparameters make the agent again."""
    try:
        usual = find_agent(name).presets["paper"].agent
    except DelayRLError:
        return False
    return bool(override(usual, values_of(agent)) == agent)


def _summary(agent: Agent) -> str:
    return (inspect.getdoc(type(agent)) or "").partition("\n")[0]
