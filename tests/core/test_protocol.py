"""The default protocol by value, and the lengths of openings."""

import pytest

from delayrl.core.protocol import CORRECTED, opening_length


def test_corrected() -> None:
    """Nothing of an episode is fixed, dropped or chosen by anyone but the agent."""
    assert (CORRECTED.start_states, CORRECTED.time_limit) == ("own", "bootstraps")
    assert (CORRECTED.opening, CORRECTED.evaluation_opening, CORRECTED.opening_steps) == ("agent", "agent", "kept")
    assert (CORRECTED.last_starts, CORRECTED.capacity, dict(CORRECTED.overrides)) == ("kept", "rows", {})


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_opening_length(delay: int) -> None:
    lengths = [opening_length(opening, delay) for opening in ("agent", "one-random", "random", "zeros")]  # type: ignore
    assert lengths == [0, min(delay, 1), delay, delay]
