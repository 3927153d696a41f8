"""What the configurations of runs add to their rows: hyperparameters that differ from the preset's, and the cost."""

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.report.rows import Key, RowGroup, whole_lines
from delayrl.run.folder import RunFolder, check_more
from delayrl.run.rows import CONDITION, CONFIGURATION
from delayrl.run.stored import condition_of, overrides_of

Config = Mapping[str, Any]
"""What a run's config.json holds."""
FROM = "from"
"""The name under which results say which run's networks they began with."""


def read_configs(paths: Iterable[Path]) -> Iterator[Config]:
    """Yield the configurations beside rows.jsonl files, and those in files that `benchmarks/collect.py` wrote.

    Raises DelayRLError for a file that cannot be read, and two runs that their rows do not tell apart.
    """
    first: dict[str, Path] = {}
    for path in paths:
        if (path.parent / "config.json").is_file():
            config = RunFolder(path.parent).config
            same = json.dumps([config.get(name) for name in (*CONDITION, CONFIGURATION, "seed")])
            if other := first.get(same):
                twice = f"{other} and {path} hold runs of the same options and seed; give one of them"
                raise DelayRLError(f"{path} is given twice" if other.samefile(path) else twice)
            first[same] = path
            yield config
            continue
        try:
            with open(path, "rb") as file:
                lines = [line for _, line in whole_lines(file) if b'"config"' in line]
            configs = [line["config"] for line in map(json.loads, lines) if "config" in line]
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise DelayRLError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
        for config in configs:
            if isinstance(config, dict):  # others are refused with the number of their line, as rows are
                check_more(config, f"a configuration in {path}")
                yield config


def by_key(configs: Iterable[Config]) -> dict[Key, Config]:
    """Return configurations by the columns of their rows, without those of version 0.1, which rows do not name."""
    known: dict[Key, Config] = {}
    for config in configs:
        if "configuration" in config:
            condition = condition_of({"overrides": {}, "steps": 0, **config})
            if not isinstance(config.get("schedule"), dict) or "steps" not in config["schedule"]:
                raise DelayRLError(f"the configuration of {condition} has no schedule with its steps")
            known[*condition.columns.values(), config["configuration"]] = config
    return known


def _beginning(config: Config) -> dict[str, str]:
    """Return in words what a run began with, and how long it was planned before, if anything."""
    origin, words = config.get("origin", {}), {}
    if source := origin.get("from"):
        words[FROM] = f"{source.get('agent')}@{source.get('step')}"
    if lengths := origin.get("lengths"):
        words["went_on"] = ", ".join(map(str, lengths))
    return words


def distinct_overrides(groups: Sequence[RowGroup]) -> list[dict[str, Any]]:
    """Return overrides that tell groups of different configurations apart.

    Where the preset is not known, as of an agent of one's own, these are the options that differ between the groups,
    and where even these are not known, the hash of the configuration.
    """
    overrides = [overrides_of(group.config) | _beginning(group.config) for group in groups]
    alike: dict[str, list[RowGroup]] = defaultdict(list)
    names = []
    for group, own in zip(groups, overrides, strict=True):
        c = group.condition
        names.append(json.dumps([c.agent, c.preset, c.protocol, own], sort_keys=True))
        alike[names[-1]].append(group)
    return [own | _apart(group, alike[name]) for group, own, name in zip(groups, overrides, names, strict=True)]


def _apart(group: RowGroup, alike: Sequence[RowGroup]) -> dict[str, Any]:
    """Return what tells a group from others that have the same name, if their configurations differ."""
    if not group.configuration or len({other.configuration for other in alike}) < 2:
        return {}
    named = {"configuration": group.configuration[:8]}
    configs = [group.config, *(other.config for other in alike if other.configuration != group.configuration)]
    if not all(configs):
        return named
    own, *others = ({**one.get("hyperparameters", {}), **one.get("schedule", {})} for one in configs)
    differing = {name: value for name, value in own.items() if any(other.get(name) != value for other in others)}
    return differing | named if own in others else differing
