"""Agents such as users bring: a class, an instance that its class does not make again, and presets of their own."""

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from delayrl.agents.base import Deterministic, Phase, Schedule
from delayrl.agents.registry import Preset, Registration
from delayrl.core import networks
from delayrl.core.views import input_size, network_input


class State(NamedTuple):
    actor: Any
    updates: Any


@dataclass(frozen=True)
class Shrink:
    """Shrinks its actor by `factor` at each update."""

    width: Annotated[int, "units of the hidden layer"] = 8
    factor: Annotated[float, "what weights are multiplied by", (0.0, 1.0)] = 0.5
    batch_size: Annotated[int, "windows per batch"] = 4
    sees: str = "augmented"

    privileged = False

    def ahead(self, spec):
        return 1

    def phases(self):
        return (Phase(50, 1, self.batch_size, self.update),)

    def init(self, spec, key):
        sizes = (input_size(spec, self.sees), self.width, spec.action_size)
        return State(networks.mlp_init(key, sizes), jnp.zeros(()))

    def act(self, state, seen, key, *, explore):
        return jnp.tanh(networks.mlp(state.actor, network_input(seen, self.sees)))

    def update(self, state, windows, key, count):
        actor = jax.tree.map(lambda weights: self.factor * weights, state.actor)
        return State(actor, state.updates + 1), {"updates": state.updates}

    def deterministic(self, state):
        return Deterministic(self.sees, state.actor)


WIDE = Shrink(width=16)
DELAYED = Shrink(sees="delayed")  # `sees` is no option, so the class and the options do not make it again
ENTRY = Registration("Shrinks, with presets.", "Nobody, 2026", {"tiny": Preset(Shrink(width=2), Schedule(steps=120))})
BARE = Registration("Has nothing to train with.", "-", {})


@dataclass(frozen=True)
class Growing(Shrink):
    """Has a hidden unit for every 50 steps of its run."""

    units: int = 1

    def for_run(self, schedule):
        return replace(self, units=schedule.steps // 50)

    def init(self, spec, key):
        return Shrink.init(replace(self, width=self.units), spec, key)


@dataclass(frozen=True)
class Steps(Shrink):
    steps: Annotated[int, "is an option of every run"] = 3


@dataclass(frozen=True)
class Progress(Shrink):
    progress: Annotated[int, "is a parameter of train"] = 3


@dataclass(frozen=True)
class Quiet(Shrink):
    quiet: Annotated[int, "is an option of the command"] = 3


@dataclass(frozen=True)
class Percent(Shrink):
    share: Annotated[int, "% of all, 5 %s"] = 3


@dataclass(frozen=True)
class Wordy(Shrink):
    name: Annotated[str, "neither a number nor one of some words"] = "me"


@dataclass(frozen=True)
class Twice(Shrink):
    inner: Shrink = Shrink(factor=0.9)  # one name sets both


@dataclass(frozen=True)
class Spoiled(Shrink):
    """Does one thing that a run could not store, restore or log."""

    how: Annotated[
        Literal["type", "shape", "more", "key", "names", "step", "metric", "none", "act", "every", "phase"], "what"
    ] = "type"

    def phases(self):
        phase = super().phases()[0]._replace(every=0 if self.how == "every" else 50, update=self.update)
        return phase if self.how == "phase" else (phase,)

    def init(self, spec, key):
        state = super().init(spec, key)
        more = {"key": jax.random.key(0), "names": {"a.b": jnp.zeros(1), "a": {"b": jnp.zeros(1)}}}
        return state._replace(updates=more.get(self.how, state.updates))

    def update(self, state, windows, key, count):
        new, metrics = state, {"lead": windows.lead.mean()}
        spoiled = {"type": count, "shape": jnp.zeros(2), "more": {"a": jnp.zeros(())}}
        logged = {"step": {"step": 0.5 * metrics["lead"]}, "metric": {"rewards": windows.reward.mean(0)}, "none": None}
        return new._replace(updates=spoiled.get(self.how, new.updates)), logged.get(self.how, metrics)

    def act(self, state, seen, key, *, explore):
        action = super().act(state, seen, key, explore=explore)
        return action[None] if self.how == "act" else action


@dataclass
class Thawed:
    privileged = False
    ahead = phases = init = act = deterministic = None


@dataclass(frozen=True)
class Needy:
    width: Annotated[int, "has no default"]
    privileged = False
    ahead = phases = init = act = deterministic = None


@dataclass(frozen=True)
class Half:
    privileged = False


def make():
    return Shrink()
