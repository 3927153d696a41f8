"""What a user with a strict type checker writes. `make check` runs mypy on this file, as on the library."""

import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import delayrl
from delayrl.delays import Channel, Choice, Delay, Recorded, uniform
from delayrl.deploy import Controller
from delayrl.deploy.backends.network import Network
from delayrl.deploy.bundle import Bundle
from delayrl.errors import DelayRLError
from delayrl.wrappers import AugmentedObservation, Delayed


class Feedback:
    """A control policy with names of its own, plain lists, and no step in seconds."""

    obs_size, action_size, max_age = 1, 1, 2
    low, high = [-1.0], [1.0]

    def __call__(self, x: NDArray[Any], past: NDArray[np.float32], late: int) -> list[float]:
        return [float(-x[0])]


class Steady:
    """A law with a name of its own for the random numbers."""

    maximum = 2

    def draw(self, state: int, rng: np.random.Generator) -> tuple[int, int]:
        return 2, state


def test_a_policy_needs_no_more_than_the_controller_uses() -> None:
    controller = Controller(Feedback())
    controller.observe([0.25], 0)
    assert controller.act().tolist() == [-0.25]
    with pytest.raises(DelayRLError, match="no length in seconds"):
        assert controller.dt
    period: float = Controller(Feedback(), stamps="seconds", dt=0.02).dt
    assert period == 0.02


def test_delays_take_numbers_laws_and_lists() -> None:
    assert Delay(3) == delayrl.as_delay(3)
    assert Delay(observation=uniform(1, 5), action=Channel(2)) == delayrl.as_delay("uniform:1:5+action=2")
    assert Delay(Steady()).maximum == 2
    assert Choice([1, 2], [0.5, 0.5]) == Choice((1, 2), (0.5, 0.5))
    assert Recorded([1, 2, 3]).maximum == 3


def test_wrapped_environments_have_boxes() -> None:
    delayed = Delayed(gym.make("Pendulum-v1"), 2, idle=[0.5])
    augmented = AugmentedObservation(delayed)
    sizes: list[int] = [len(env.observation_space.low) for env in (delayed, augmented)]
    assert sizes == [3, 3 + 2 + 1]
    assert augmented.action_space.high.tolist() == delayed.action_space.high.tolist() == [2.0]
    with pytest.raises(DelayRLError, match=r"history is a whole number of actions; got 4\.0"):
        Delayed(gym.make("Pendulum-v1"), 2, history=4.0)  # type: ignore[arg-type]


def test_modules_are_found_and_listed() -> None:
    """Typing errors on the package are seen by a checker (`attr-defined`), completion finds what is imported late."""
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        delayrl.trian  # type: ignore[attr-defined]  # noqa: B018
    assert {"load_bundle", "adapt", "Controller"} <= set(dir(delayrl.deploy))
    code = "import delayrl; print(delayrl.deploy.Controller.__name__, delayrl.wrappers.Delayed.__name__)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.split() == [delayrl.deploy.Controller.__name__, delayrl.wrappers.Delayed.__name__]
    assert delayrl.delays.as_delay(3) == Delay(3)


def test_a_missing_extra_is_an_import_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name="jax")

    monkeypatch.setattr("delayrl.errors.import_module", missing)
    with pytest.raises(ImportError, match=r"this needs jax: pip install 'delayrl\[train\]'") as found:
        delayrl.__getattr__("train")
    assert isinstance(found.value, DelayRLError)


def test_values_can_be_shown_and_are_safe() -> None:
    network = Network(1, 1, 2, (-1.0,), (1.0,), "augmented", (4,))
    bundle = Bundle(
        network, {"agent": "bpql", "env": "Pole"}, lambda obs, actions, age: np.zeros(1, np.float32), "numpy"
    )
    assert repr(bundle) == "Bundle(bpql on Pole, ages 0..2, backend numpy)"
    with pytest.raises(ValueError, match="read-only"):
        bundle.low[0] = -99  # it clips every action
