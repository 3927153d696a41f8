"""Options of dataclasses: named, checked, rebuilt."""

import numpy as np
import pytest

from delayrl.agents.registry import AGENTS
from delayrl.errors import DelayRLError
from delayrl.run.configuration import OLDER, override, values_of


def test_options_round_trip() -> None:
    """What a run writes down rebuilds its agent."""
    for entry in AGENTS.values():
        for preset in entry.presets.values():
            assert override(preset.agent, values_of(preset.agent)) == preset.agent


def test_zero_is_allowed_whatever_the_preset() -> None:
    """BPQL's preset `paper` has 1,000; 0 means the end of the random steps."""
    preset = AGENTS["bpql"].presets["paper"]
    assert override(preset.schedule, {"update_after": 0}).first_update == preset.schedule.random_steps


def test_older_runs_of_every_preset() -> None:
    """What an option means where a configuration does not mention it is allowed, whatever the preset's own value."""
    for entry in AGENTS.values():
        for preset in entry.presets.values():
            older = {name: value for name, value in OLDER.items() if name in values_of(preset.agent)}
            assert values_of(override(preset.agent, OLDER)) == values_of(preset.agent) | older
    numbers = {"tokens": np.int64(3), "learning_rate": np.float32(0.5)}
    changed = values_of(override(AGENTS["vdpo"].presets["small"].agent, numbers))
    assert (changed["tokens"], changed["learning_rate"]) == (3, 0.5)
    with pytest.raises(DelayRLError, match=r"^tokens must be at least 0; got -1$"):
        override(AGENTS["vdpo"].presets["small"].agent, {"tokens": -1})
