"""A sensor that runs on its own clock: the ages that a controller sees are those that `80ms~` trains."""

import heapq
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from delayrl.delays import any_phase, as_delay
from delayrl.deploy import Controller
from delayrl.measure import from_log

DT = 1 / 32
"""Times are multiples of 1/4096 s, which floating point holds exactly."""
TICK = 1 / 4096


class Ages:
    """A policy that serves ages up to `max_age` and keeps those that it was shown."""

    obs_size = action_size = 1
    low, high, dt = np.array([-1.0]), np.array([1.0]), DT

    def __init__(self, max_age: int) -> None:
        self.max_age, self.seen = max_age, list[int]()

    def __call__(self, obs: Any, actions: Any, age: int) -> Any:
        self.seen.append(age)
        return np.zeros(1, np.float32)


def play(
    max_age: int, phase: int, delay: int, jitter: int = 0, late: int = 0, steps: int = 60
) -> tuple[Any, list[int]]:
    """Run a loop with a sensor of the same period, `phase` after it; all in ticks of 1/128 of a period."""
    random, policy = np.random.default_rng(phase), Ages(max_age)
    now = 0.0
    controller = Controller(policy, stamps="seconds", clock=lambda: now)
    events: list[tuple[float, int, float]] = []  # when, whether it is a decision, the stamp
    for k in range(steps):
        made = k * DT + phase * TICK
        heapq.heappush(events, (made + (delay + int(random.integers(jitter + 1))) * TICK, 0, made))
        heapq.heappush(events, (k * DT + int(random.integers(late + 1)) * TICK, 1, 0.0))
    controller.reset(0.0)
    while events:
        now, decides, stamp = heapq.heappop(events)
        if now > steps * DT:
            break
        if not decides:
            controller.observe([0.0], stamp)
        elif controller.ready:
            controller.act()
    return controller.statistics, policy.seen[1:]  # without the call that compiles


@pytest.mark.parametrize("delay", [0, 32, 64, 100, 128, 256, 300, 320, 350])
def test_ages_at_every_phase(delay: int) -> None:
    """Without jitter: no age beyond the bounds, and both occur at some phase; each phase has one age."""
    low, high = any_phase(delay / 128, delay / 128)
    ages = set()
    for phase in range(0, 128, 4):
        statistics, _ = play(high, phase, delay)
        assert statistics.overruns == 0
        assert statistics.age_std == 0
        ages.add(statistics.age_max)
    assert ages == set(range(low, high + 1))


def test_80_ms_at_40_ms_a_step() -> None:
    """As on the arm: trained for `80ms` each decision is an overrun at a phase of a quarter step, for `80ms~` none."""
    for text, phases in (("80ms", range(1, 64)), ("80ms~", [])):
        longest = as_delay(text, 0.04).maximum
        for phase in range(0, 128):
            statistics, seen = play(longest, phase, 256)
            assert (statistics.overruns > 50) == (phase in phases)
            assert bool(statistics.overruns) == (phase in phases)
            assert not seen or max(seen) <= longest


@pytest.mark.parametrize(("delay", "jitter", "late"), [(256, 60, 0), (200, 0, 20), (90, 200, 25), (256, 127, 31)])
def test_jitter_of_messages_and_of_the_loop(delay: int, jitter: int, late: int) -> None:
    """How late a decision may be is added to the jitter."""
    longest = as_delay(f"{delay / 128}~{(jitter + late) / 128}").maximum
    played = [play(longest, phase, delay, jitter, late) for phase in range(0, 128, 5)]
    assert [statistics.overruns for statistics, _ in played] == [0] * len(played)
    assert max(itertools.chain(*(seen for _, seen in played))) in (longest - 1, longest)


@pytest.mark.parametrize(("delay", "jitter"), [(256, 0), (200, 60), (90, 200)])
def test_what_measure_recommends(delay: int, jitter: int, tmp_path: Path) -> None:
    """From a log with the stamps of such a sensor: trained with that, no decision is an overrun at any phase."""
    made = DT * np.arange(400)
    arrived = made + (delay + jitter * (np.arange(400) % 2)) * TICK
    (tmp_path / "log.csv").write_text(
        "stamp,received\n" + "".join(f"{m},{a}\n" for m, a in zip(made, arrived, strict=True))
    )
    recommended = from_log(tmp_path / "log.csv", DT).train_with
    assert recommended == as_delay(f"{delay / 128}~{jitter / 128}").plain()
    longest = as_delay(recommended).maximum
    played = [play(longest, phase, delay, jitter)[0].overruns for phase in range(0, 128, 5)]
    assert played == [0] * len(played)


def test_the_delays_that_a_policy_serves() -> None:
    """What it says is what any_phase asks for: two ticks more are an overrun at some phase."""
    in_step, any_of = "late in step with the control loop", "at any phase"
    controller = Controller(Ages(3), stamps="seconds", action_delay=1)
    assert controller.serves == f"a sensor up to 62.5 ms {in_step}, up to 46.88 ms {any_of}"
    assert any_phase(0, 1.5)[1] == 2 < any_phase(0, 1.5 + 1 / 128)[1]
    assert Controller(Ages(3)).serves == f"a sensor up to 3 steps {in_step}, up to 2.5 steps {any_of}"
    assert "none at another phase" in Controller(Ages(1), action_delay=1).serves
    for delay, overrun in ((320, False), (322, True)):  # 320 ticks are 2.5 steps
        assert any(play(3, phase, delay)[0].overruns for phase in range(128)) == overrun
