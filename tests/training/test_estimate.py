"""How long a run will take, said before it starts."""

from types import SimpleNamespace
from typing import Any

import pytest

from delayrl.envs.making import make
from delayrl.play.policy import spec_of
from delayrl.run.condition import resolve
from delayrl.training import estimate as module
from delayrl.training.cost import cost_of
from delayrl.training.estimate import UTILISATION, estimate

RATE = 8 * 1024**3
"""Operations a second of a device whose clock says that all of the products took one second."""


def words(monkeypatch: pytest.MonkeyPatch, agent: str, delay: int, step: int = 0, **values: Any) -> str:
    """The estimate of two seeds; the clock of the device is given."""
    group, state = _group(agent, delay, **values), SimpleNamespace(step=step)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=iter([0.0, 1.0]).__next__))
    return estimate(group, state)  # type: ignore[arg-type]


def _group(agent: str, delay: int, **values: Any) -> Any:
    setup = resolve(agent, "Reacher-v5", delay, "small", "corrected", values)
    spec = spec_of(make("Reacher-v5", delay))
    return SimpleNamespace(setup=setup, spec=spec, seeds=[0, 1], program=SimpleNamespace(phases=setup.agent.phases()))


@pytest.mark.parametrize(("agent", "delay", "updates"), [("bpql", 3, 1), ("dcac", 3, 1), ("vdpo", 3, 2)])
def test_by_hand(agent: str, delay: int, updates: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds of steps, of arithmetic at a share of the measured rate, and of starting updates; each seed learns."""
    steps, first, step = 8_000_000, 1_000_000, 2_000_000
    values = {"steps": steps, "random_steps": first, "replay_capacity": 1_000_000}
    group = _group(agent, delay, **values)
    flops = cost_of(group.setup.agent, group.spec, group.setup.schedule).flops
    hours = ((steps - step) * (2e-4 + 2 * (flops / (UTILISATION * RATE) + updates * 3e-4))) / 3600
    said = words(monkeypatch, agent, delay, step, **values)
    assert said.startswith(f"about {hours:.1f} h for 6,000,000 steps"), said


def test_nothing_is_learned_before_the_first_update(monkeypatch: pytest.MonkeyPatch) -> None:
    said = words(monkeypatch, "bpql", 3, steps=300_000, random_steps=299_999)
    assert said == "about 1 min for 300,000 steps on this device"
    few = words(monkeypatch, "bpql", 3, steps=30_000, random_steps=29_999)
    assert few == "less than a minute for 30,000 steps on this device"


def test_an_unknown_cost_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "cost_of", lambda *_: SimpleNamespace(flops=float("nan")))
    assert words(monkeypatch, "bpql", 3).startswith("none for ")


def test_the_paper_preset_names_the_small_one(monkeypatch: pytest.MonkeyPatch) -> None:
    group = _group("bpql", 3)
    group.setup = resolve("bpql", "Reacher-v5", 3, "paper", "corrected", {})
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=iter([0.0, 1e3]).__next__))
    assert estimate(group, SimpleNamespace(step=0)).endswith("; --preset small takes minutes")  # type: ignore[arg-type]
