"""Tasks by id, delays in their steps, and errors that name the nearest task."""

from typing import Any

import pytest

import delayrl
from delayrl.delays import as_delay
from delayrl.envs import making


def test_times_in_seconds() -> None:
    assert delayrl.make("HalfCheetah-v5", "80ms").delay == as_delay(2)  # 50 ms a step
    assert delayrl.make("Pendulum-v1", "0.1s+action=60ms").delay == as_delay("2+action=2")
    with pytest.raises(delayrl.DelayRLError, match="no `dt`"):
        delayrl.make("delayrl/Walk-v0", "80ms")


def test_a_task_is_made_only_for_the_length_of_its_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def make(name: str, **options: Any) -> Any:
        made.append(name)
        return gym_make(name, **options)

    gym_make = making.gym.make
    monkeypatch.setattr(making.gym, "make", make)
    for delay in (5, "uniform:1:5", as_delay("walk:3"), "recorded:1,2,"):
        assert making.delay_of("Pendulum-v1", delay) == as_delay(delay)
    assert not made
    assert making.delay_of("Pendulum-v1", "uniform:60ms:0.1s+action=40ms") == as_delay("uniform:2:2+action=1")
    assert made == ["Pendulum-v1"]
    with pytest.raises(delayrl.DelayRLError, match="did you mean Pendulum-v1"):
        making.delay_of("Pendulm-v1", "80ms")


@pytest.mark.parametrize("delay", [201, "walk:201", "2+reward=201", "151+action=50"])
def test_no_delay_is_longer_than_an_episode(delay: int | str) -> None:
    """Rewards too, which training moves to no environment."""
    with pytest.raises(delayrl.DelayRLError, match="201 steps is longer than an episode of Pendulum-v1"):
        making.delay_of("Pendulum-v1", delay)
    making.delay_of("delayrl/unknown-v0", delay)  # whoever makes it says so


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("CartPole-v1", "continuous"),
        ("FrozenLake-v1", "must be a Box"),
        ("Invertedpendulum-v5", "did you mean InvertedPendulum-v5"),
        ("nonsense", "delayrl tasks"),
    ],
)
def test_bad_tasks(task: str, words: str) -> None:
    with pytest.raises(delayrl.DelayRLError, match=words):
        delayrl.make(task, 1)


def test_a_task_that_does_not_say_how_long_a_step_is() -> None:
    with pytest.raises(delayrl.DelayRLError, match=r"\(no `dt`\): give steps, or the task an attribute `dt` in"):
        delayrl.make("delayrl/Counter-v0", "80ms")
    assert delayrl.make("delayrl/Counter-v0", "80ms", step_seconds=0.02).delay.maximum == 4
