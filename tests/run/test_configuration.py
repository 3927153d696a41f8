"""Options of dataclasses: named, checked, rebuilt."""

from dataclasses import dataclass
from typing import Annotated, Literal

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


@dataclass(frozen=True)
class Own:
    """Options as an agent of one's own may have them (docs/own-agent.md)."""

    shift: Annotated[int, "may be negative", (-5, 5)] = -1
    rates: Annotated[tuple[float, ...], "each within the bounds", (0.0, 1.0)] = (0.5,)
    layers: Annotated[Literal[1, 2, 4], "a number of a list"] = 2


def test_bounds_and_words_of_ones_own_options() -> None:
    assert override(Own(), {"shift": -3, "rates": [0, 1], "layers": 4}) == Own(-3, (0.0, 1.0), 4)
    for wrong, words in (
        ({"shift": -6}, r"shift must lie in -5 \.\. 5; got -6"),
        ({"shift": 0.5}, r"shift must be a whole number, at least -5; got 0\.5"),
        ({"rates": [0.5, 7]}, r"rates must lie in 0 \.\. 1; got 7"),
        ({"layers": 3}, r"layers must be one of 1, 2, 4; got 3"),
    ):
        with pytest.raises(DelayRLError, match=f"^{words}$"):
            override(Own(), wrong)


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
