"""The benchmark of `delayrl measure` measures logs that it makes."""

from pathlib import Path

import measure_accuracy
import numpy as np
import pytest


@pytest.mark.parametrize("delay", [0, 4])
def test_a_log_without_noise_shows_its_delay(delay: int, tmp_path: Path) -> None:
    plant, kind = next(iter(measure_accuracy.PLANTS)), next(iter(measure_accuracy.COMMANDS))
    rows = measure_accuracy.synthetic(plant, kind, 0.0, delay, np.random.default_rng(0))
    measure_accuracy.write(tmp_path / "log.csv", rows, 1)
    row = measure_accuracy.measure(tmp_path / "log.csv", delay)
    assert "error" not in row
    assert abs(row["dead time"] - delay) <= 1
    assert np.isfinite(row["levels"])
