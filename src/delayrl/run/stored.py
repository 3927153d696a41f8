"""Conditions and configurations as rows, cells and run folders store them, read back."""

from collections.abc import Mapping
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.run.agents import find_agent
from delayrl.run.condition import Condition, following
from delayrl.run.configuration import OLDER, override, values_of
from delayrl.run.rows import CONDITION

KINDS = CONDITION | {"overrides": dict, "steps": int}


def condition_of(values: Mapping[str, Any]) -> Condition:
    """Make a condition of its stored fields. Raises DelayRLError if one is missing or of another type."""
    wrong = [name for name, kind in KINDS.items() if not isinstance(values.get(name), kind)]
    if wrong:
        raise DelayRLError(f"no good {', '.join(wrong)}")
    return Condition(**{name: values[name] for name in KINDS})


def overrides_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a run's configuration that differ from its preset's; none if we do not know the preset.

    Nothing is imported because a configuration names it: agents given as `module:object` count as unknown.
    """
    try:
        if ":" in config["agent"]:
            return {}
        registration = find_agent(config["agent"])
        preset, chosen = registration.presets[config["preset"]], registration.protocol(config["protocol"])
    except (KeyError, DelayRLError):
        return {}
    habits = {**following(registration, config["preset"], config["schedule"]["steps"]), **chosen.overrides}
    usual = {k: v for part in preset for k, v in values_of(override(part, habits)).items()}
    implied = {name: value for name, value in OLDER.items() if name in usual}
    options = {**implied, **config["hyperparameters"], **config["schedule"]}
    return {name: value for name, value in options.items() if name not in usual or usual[name] != value}
