"""What a GPU learns is what the processor learns, up to rounding. Skipped without a GPU."""

from pathlib import Path

import jax
import numpy as np
import pytest

from delayrl.play.run import Run
from delayrl.run.folder import RunFolder
from short_runs import train


def has_gpu() -> bool:
    """Whether JAX finds a GPU."""
    try:
        return bool(jax.devices("gpu"))
    except RuntimeError:
        return False


@pytest.mark.skipif(not has_gpu(), reason="JAX finds no GPU")
@pytest.mark.parametrize("agent", ["sac", "bpql", "any-age", "dcac", "ad-sac", "vdpo"])
def test_a_gpu_learns_what_the_processor_learns(agent: str, tmp_path: Path) -> None:
    """Sixty updates at most: later, differences of rounding reach the environment's states and grow."""
    one, other = (
        networks(train(agent, tmp_path / device, device=device, env="Pendulum-v1", steps=160, evaluate_every=160))
        for device in ("cpu", "gpu")
    )
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert np.linalg.norm(value - other[name]) <= 1e-3 * np.linalg.norm(value) + 1e-6, name


def networks(run: Run) -> dict[str, np.ndarray]:
    """Return what the agent of a run has learned, by name."""
    return RunFolder(run.path).latest().arrays("agent")
