"""Options of dataclasses: named, checked, rebuilt."""

from delayrl.agents.registry import AGENTS
from delayrl.run.configuration import override, values_of


def test_options_round_trip() -> None:
    """What a run writes down rebuilds its agent."""
    for entry in AGENTS.values():
        for preset in entry.presets.values():
            assert override(preset.agent, values_of(preset.agent)) == preset.agent
