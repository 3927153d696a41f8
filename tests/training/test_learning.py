"""Learning, with budgets and margins that held on seeds 0, 1 and 2. The slow ones run with `pytest -m slow`."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import delayrl
from conftest import quick
from delayrl.agents.registry import AGENTS
from delayrl.play.evaluation import evaluate
from own_tasks import Wind

QUICK = {
    "preset": "small",
    "progress": False,
    "random_steps": 500,
    "evaluate_every": 1500,
    "hidden": [32, 32],
    "batch_size": 64,
}


def mean_return(path: Path, **options) -> float:
    runs = delayrl.train(out=path, **options)
    return float(
        np.mean([evaluate(run.path, 20)["mean_return"] for run in (runs if isinstance(runs, list) else [runs])])
    )


@pytest.mark.slow
def test_memory_pays(tmp_path: Path) -> None:
    """s' = s + a, reward -s², Δ = 4: x_t is enough to stand still; the last observation alone is not (three seeds)."""
    options = QUICK | {"env": "delayrl/Walk-v0", "delay": 4, "steps": 3000, "seeds": 3}
    augmented = mean_return(tmp_path / "augmented", agent="a-sac", **options)
    memoryless = mean_return(tmp_path / "memoryless", agent="sac-memoryless", **options)
    assert augmented > -25
    assert memoryless < 2 * augmented - 10


ALIKE = ("sac-memoryless", "a-sac", "any-age", "lifting", "ad-sac", "dcac")  # they learn from one phase, as bpql does


@pytest.mark.parametrize("agent", quick([name for name in AGENTS if name not in ("random", "sac")], "bpql", slow=ALIKE))
def test_nobody_guesses_a_coin(agent: str, tmp_path: Path) -> None:
    """The state is a fresh coin, the reward a·s: the mean of 1,000 steps stays within 4 standard errors of 0."""
    own = {
        "vdpo": {"width": 16, "layers": 1, "clone_every": 250, "clone_updates": 100},
        "dida": {"expert_steps": 750, "round_steps": 50, "imitation_updates": 50},
        "lifting": {"lifting_hold": 250, "lifting_end": 750},
    }
    options = QUICK | {"env": "delayrl/Coin-v0", "delay": 1, "steps": 1000} | own.get(agent, {})
    assert abs(mean_return(tmp_path / "run", agent=agent, **options)) < 4 * np.sqrt(50 / 20)


def test_the_coin_is_seen_without_delay(tmp_path: Path) -> None:
    """So that the test above can fail: with the current state the same budget earns 20 of 50 or more."""
    options = QUICK | {"env": "delayrl/Coin-v0", "delay": 0, "steps": 1000}
    assert mean_return(tmp_path / "run", agent="sac", **options) > 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_vdpo_balances_the_pendulum(seed: int, tmp_path: Path) -> None:
    """InvertedPendulum-v5, Δ = 5, 15,000 steps: at least 950 of 1000 on unseen start states."""
    options = {"env": "InvertedPendulum-v5", "delay": 5, "preset": "small", "seed": seed, "progress": False}
    assert mean_return(tmp_path / "run", agent="vdpo", **options) >= 950


@pytest.mark.slow
def test_memoryless_does_not(tmp_path: Path) -> None:
    """The same budget without memory stays under 500."""
    options = {"env": "InvertedPendulum-v5", "delay": 5, "preset": "small", "progress": False}
    assert mean_return(tmp_path / "run", agent="sac-memoryless", **options) < 500


@pytest.mark.slow
@pytest.mark.parametrize(("encoder", "least", "most"), [("forecast", -3, 3), ("mlp", 20, 25), ("transformer", 20, 25)])
def test_a_mean_hides_the_wind(encoder: str, least: float, most: float, tmp_path: Path) -> None:
    """One step late, any-age earns nothing by its forecast, and nearly all of 25 by an encoder that sees x_t."""

    def task() -> gymnasium.Env:
        return gymnasium.wrappers.TimeLimit(Wind(), 50)

    options = QUICK | {"env": task, "delay": 1, "steps": 4000, "evaluate_every": 2000, "hidden": [64, 64]}
    runs = delayrl.train("any-age", out=tmp_path / "run", seeds=3, encoder=encoder, **options)
    for run in runs:
        assert least < np.mean([row["return"] for row in run.rows() if row["step"] == 4000]) < most


@pytest.mark.slow
@pytest.mark.parametrize(("task", "delay"), [("HalfCheetah-v5", 5), ("Humanoid-v5", 50)])
def test_paper_preset_runs(task: str, delay: int, tmp_path: Path) -> None:
    """200 updates of the preset `paper` at its full size."""
    options = {"env": task, "delay": delay, "random_steps": 300, "steps": 500, "evaluate_every": 500, "progress": False}
    run = delayrl.train("vdpo", out=tmp_path / "run", replay_capacity=2000, evaluation_episodes=1, **options)
    assert all(np.isfinite(row["return"]) for row in run.rows())
