"""What decides a result but the seed, resolved once from what the user gave."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from delayrl.agents.base import Agent, Schedule
from delayrl.agents.registry import Registration
from delayrl.core.protocol import Protocol, opening_length
from delayrl.core.replay import Learnable
from delayrl.core.types import Spec
from delayrl.delays import Delay, DelayLike, as_delay, short_label
from delayrl.envs.making import delay_of
from delayrl.envs.task import Task, TaskLike, as_task
from delayrl.errors import DelayRLError
from delayrl.lookup import contents
from delayrl.run.agents import AgentLike, as_agent, as_trained, check_not_taken
from delayrl.run.configuration import OLDER, check_names, options, override, values_of
from delayrl.run.rows import CONDITION

GROWS: Mapping[str, Sequence[str]] = {
    "matched": ("replay_capacity", "evaluate_every"),
    "small": ("replay_capacity", "evaluate_every", "random_steps"),
}
"""Options of which a longer run than the preset's needs more."""


@dataclass(frozen=True)
class Condition:
    """One agent with its hyperparameters, on one task, under one delay and one protocol."""

    agent: str  # its name: in the registry, or what delayrl.run.agents says
    env: str  # the text of the task: an id, or what delayrl.envs.task says
    delay: int | str  # environment steps, or a delay's text
    preset: str = "paper"
    protocol: str = "corrected"
    overrides: Mapping[str, Any] = field(default_factory=dict)  # options that differ from the preset's
    steps: int = 0  # environment steps that each seed trains; 0 where that is unknown

    @property
    def short_delay(self) -> int | str:
        """The delay as rows name it: long lists of numbers are shortened."""
        return short_label(self.delay)

    @property
    def folder_name(self) -> str:
        """The task and the delay as folders are named by them: without brackets at the ends, and not too long."""
        return f"{self.env.strip('<>() ')[:100]}-delay{str(self.short_delay).strip('<>() ')}"

    @property
    def columns(self) -> dict[str, Any]:
        """What every row says of its condition."""
        return {name: getattr(self, name) for name in CONDITION} | {"delay": self.short_delay}

    def __str__(self) -> str:
        return f"{self.agent} on {self.env}, delay {self.short_delay}"


@dataclass(frozen=True)
class Setup:
    """A condition, and the objects that it stands for."""

    condition: Condition
    task: Task
    agent: Agent
    schedule: Schedule
    delay: Delay
    protocol: Protocol
    unnamed: Mapping[str, str] = field(default_factory=dict)  # checksums of what a run has no name for
    origin: Mapping[str, Any] = field(default_factory=dict)  # what training began from, if not from nothing

    @property
    def config(self) -> dict[str, Any]:
        """The configuration that a run folder keeps: every option by name, defaults included."""
        names = {name: getattr(self.condition, name) for name in ("agent", "preset", "env", "delay", "protocol")}
        options = {"hyperparameters": values_of(self.agent), "schedule": values_of(self.schedule)}
        rules = {f.name: value for f in fields(Protocol) if (value := getattr(self.protocol, f.name)) != f.default}
        habits = {name: value for name, value in rules.items() if name != "overrides"}
        more = {"habits": habits, "unnamed": dict(self.unnamed), "origin": dict(self.origin)}
        return names | {"privileged": self.agent.privileged} | options | {k: v for k, v in more.items() if v}

    def learnable(self, spec: Spec) -> Learnable:
        """Return which steps of an episode can be sampled under the protocol."""
        rules = self.protocol
        return Learnable(
            first=opening_length(rules.opening, spec.delay) if rules.opening_steps == "dropped" else 0,
            until_end=self.agent.ahead(spec) if rules.last_starts == "dropped" else 1,
            time_limit=rules.time_limit != "dropped",
        )

    def entries(self, spec: Spec) -> int:
        """Return how many units of `replay_capacity` a row of the replay takes under the protocol."""
        return self.agent.ahead(spec) if self.protocol.capacity == "entries" else 1

    def replay_rows(self, spec: Spec) -> int:
        """Return the rows of each seed's replay."""
        return self.schedule.replay_capacity // self.entries(spec)

    def cell_id(self, seeds: Sequence[int]) -> str:
        """Return the name of a group of seeds: a hash of the configuration, however the user wrote it."""
        return _digest(self._decisive | {"seeds": list(seeds)})

    @property
    def configuration(self) -> str:
        """Return a hash of all options. With their other columns, it tells rows what was trained, but for the seed."""
        options = ("hyperparameters", "schedule", "habits", "origin")
        return _digest({name: value for name, value in self._decisive.items() if name in options})

    @property
    def _decisive(self) -> dict[str, Any]:
        """The part of the configuration that ids are made of: the same as before an option was added."""
        config = {name: value for name, value in self.config.items() if name != "privileged"}
        for name in ("hyperparameters", "schedule"):
            config[name] = {key: x for key, x in config[name].items() if key not in OLDER or x != OLDER[key]}
        return config


def _digest(parts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def resolve(
    agent: AgentLike, env: TaskLike, delay: DelayLike, preset: str, protocol: str, overrides: Mapping[str, Any]
) -> Setup:
    """Resolve what a user gave into a condition and its objects. Raises DelayRLError for what does not exist or fit."""
    name, registration = as_agent(agent)
    if preset not in registration.presets:
        raise DelayRLError(f"unknown preset {preset!r} of {name}; there are {', '.join(registration.presets)}")
    base, chosen = registration.presets[preset], registration.protocol(protocol)
    check_not_taken(name, base.agent)
    check_names(overrides, base.agent, base.schedule)
    values = {**chosen.overrides, **overrides}
    values = following(registration, preset, override(base.schedule, values).steps) | values
    schedule = override(base.schedule, values)
    task = as_task(env)
    parsed = delay_of(task, delay)
    text = parsed.plain()
    if not isinstance(delay, int | float | str) and "<" not in str(text) and as_delay(text) != parsed:
        raise DelayRLError(
            f"a run keeps its delay as text, and {str(parsed)[:60]!r} cannot be read back: use delayrl.delays"
        )
    condition = Condition(name, str(task), text, preset, protocol, dict(overrides), schedule.steps)
    made = as_trained(override(base.agent, values), schedule)
    held = replace(task, wrappers=tuple(replace(part, found=None) for part in task.wrappers))  # these have names
    things = {"agent": (name, base.agent), "env": (task.env.name, held), "delay": (str(text), parsed)}
    known = {option.name for option in options(base.agent)}  # are told apart by their values
    unnamed = {part: contents(thing, known) for part, (shown, thing) in things.items() if "<" in shown}
    return Setup(condition, task, made, schedule, parsed, chosen, {k: _digest(x) for k, x in unnamed.items() if x})


def following(registration: Registration, name: str, steps: int) -> dict[str, int]:
    """Return the options of the preset called `name` that are other numbers in a run of so many steps."""
    preset = registration.presets[name]
    usual, length = {**values_of(preset.agent), **values_of(preset.schedule)}, preset.schedule.steps
    own = [option.name for option in options(preset.agent) if option.scales and not registration.given]
    names = (*own, *(GROWS.get(name, ()) if steps > length else ()))
    return {name: -(-usual[name] * steps // length) for name in names if name in usual and steps != length}
