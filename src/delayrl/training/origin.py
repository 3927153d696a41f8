"""Beginning with the networks of another run: which it was, and which of them fit."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from delayrl.agents.base import State
from delayrl.errors import DelayRLError
from delayrl.run.arrays import Arrays, flatten_tree
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.folder import RunFolder

INNER = ("auxiliary.", "reference.", "delayed.")
RENAMED = (
    *(("", inner) for inner in INNER),
    *((one, other) for one in INNER for other in INNER if one != other),
    *((inner, "") for inner in INNER),
    ("", ""),
)
"""Beginnings of names in another run, and here: agents inside agents. Where two fit as well, the later one counts."""


def source_of(run: RunFolder, begun: list[RunFolder]) -> tuple[dict[str, Any], Checkpoint]:
    """Return what the configuration says of a run whose networks others begin with, and its newest checkpoint.

    Of runs that have `begun` with it, this is what they say, although it may have been trained further since, or its
    newest checkpoint may be damaged.
    """
    try:
        config, checkpoint = run.config, run.latest()
    except DelayRLError as error:
        if not begun or not all(
            one.exists and "from" in one.config.get("origin", {}) and any(one.checkpoints()) for one in begun
        ):
            raise
        where = begun[0].path if len(begun) == 1 else begun[0].path.parent
        hint = f"`delayrl train {where} --steps {begun[0].config['schedule']['steps']}`"
        raise DelayRLError(f"{error}; what has begun in {where} goes on without it: {hint}") from error
    names = ("agent", "env", "delay", "seed", "configuration")
    now = {name: config[name] for name in names if name in config}
    now |= {"step": checkpoint.step, "networks": checkpoint.files["agent.safetensors"]}
    then = begun[0].config.get("origin", {}).get("from", {}) if begun and begun[0].checkpoints()[0] else {}
    longer = "lengths" in config.get("origin", {})  # `go_on` has changed its configuration
    same_run = bool(then) and all(then.get(name) == now.get(name) for name in (names[:-1] if longer else names))
    retrained = same_run and then["step"] == now["step"] and then["networks"] != now["networks"]
    return then if same_run and not retrained else now, checkpoint


def taken_over(agent: State, source: Checkpoint, note: Callable[[str], None]) -> State:
    """Return a fresh agent with the networks of another run that fit. Raises DelayRLError if none does."""
    stored = source.arrays("agent")
    fresh = flatten_tree(jax.tree.map(lambda x: x[0], agent))
    parts, filled = parts_of(fresh), Arrays()
    offers = [_renamed(stored, old, new) for old, new in RENAMED]
    for offered in sorted(offers, key=lambda offered: len(fitting(fresh, offered))):  # what fits best overwrites others
        filled |= {name: offered[name] for part in fitting(fresh, offered) for name in parts[part]}
    taken = [part for part, names in parts.items() if names[0] in filled]
    left = ", ".join(part for part in parts if part not in taken)
    if not parts:
        raise DelayRLError(f"there is no network to take over from {source.path.parents[1]}: this agent has none")
    if not set(taken) - measured_of(fresh):
        where, norms = source.path.parents[1], [_normalisation(arrays) for arrays in (stored, fresh)]
        line = f"{where} has no network that fits: it lacks {left}, or has them in other sizes"
        hint = "; its observation_norm is {}, and that of the new run {}".format(*norms) if len(set(norms)) > 1 else ""
        raise DelayRLError(line + hint)
    note(f"taken over: {', '.join(taken)}; new: {left or 'no network'}, and the optimisers")
    leaves, form = jax.tree.flatten(agent)
    pairs = zip(leaves, fresh, strict=True)
    return jax.tree.unflatten(form, [jnp.broadcast_to(filled.get(name, leaf), leaf.shape) for leaf, name in pairs])


def _normalisation(state: Arrays) -> str:
    """Return the observation_norm of an agent with this state."""
    return "running" if any(name.startswith("agent.") for name in state) else "none"


def _renamed(stored: Arrays, old: str, new: str) -> Arrays:
    """Return the arrays whose names begin with `old`, under names that begin with `new` instead."""
    renamed: Arrays = {}
    for name, array in stored.items():
        outer = "agent." if name.startswith("agent.") else ""  # where normalisation keeps the agent
        if name.startswith(outer + old):
            renamed[outer + new + name.removeprefix(outer + old)] = array
    return renamed


def fitting(fresh: Arrays, stored: Arrays) -> list[str]:
    """Return the parts of an agent's state that stored arrays can fill; a lone number only beside a network.

    What is measured for networks, such as the deviation of a forecast's errors, comes only with all of them. Optimisers
    and counters are in no part: they are never taken over.
    """
    parts = parts_of(fresh)
    deeper = {part_of(name) for name in stored.keys() - fresh.keys() if _in_layers(name)}

    def fits(name: str) -> bool:
        return name in stored and stored[name].shape == fresh[name].shape

    def agent_of(part: str) -> str:
        return part.rpartition(".")[0]

    taken = [part for part, names in parts.items() if part not in deeper and all(map(fits, names))]
    numbers = {part for part in taken if part in fresh and fresh[part].ndim == 0}
    alone = {part for part in measured_of(fresh) if any(o.startswith(f"{part}.") and o not in taken for o in parts)}
    begun = {agent_of(part) for part in taken if part not in numbers | alone}
    return [part for part in taken if part not in alone and (part not in numbers or agent_of(part) in begun)]


def measured_of(state: Arrays) -> set[str]:
    """Return the parts that are measured and not learned: moments of observations, and what lies beside networks."""
    parts = parts_of(state)
    flat = {part for part, names in parts.items() if all(state[n].ndim < 2 and not _in_layers(n) for n in names)}
    return {part for part in flat if part == "moments" or any(other.startswith(f"{part}.") for other in parts)}


def _in_layers(name: str) -> bool:
    return any(word.isdigit() for word in name.split("."))


def parts_of(state: Arrays) -> dict[str, list[str]]:
    """Return what an agent has learned: the leaves of each network, and of each number such as a temperature."""
    numbers = {name: leaf for name, leaf in state.items() if jnp.issubdtype(leaf.dtype, jnp.floating)}  # no counters
    learned = {name: leaf for name, leaf in numbers.items() if "opt_state" not in name}
    parts: dict[str, list[str]] = {}
    for name in sorted(learned, key=lambda name: learned[name].ndim == 0):  # numbers last
        part = part_of(name)
        lone = learned[name].ndim == 0 and part not in parts
        parts.setdefault(name if lone else part, []).append(name)
    return parts


def part_of(leaf: str) -> str:
    """Return the network that an array is in: "reference.critic" of "reference.critic.0.1.w"."""
    names = leaf.split(".")
    first = next((i for i, name in enumerate(names) if name.isdigit()), max(len(names) - 1, 1))
    return ".".join(names[:first])
