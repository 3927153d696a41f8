"""The UDP demonstration: packets arrive, the history is right, and both processes end."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wire
from demo import ROUGH, Scenario, play
from hypothesis import example, given
from hypothesis import strategies as st
from link import Link, Travelling

DEMO = Path(__file__).parents[2] / "examples" / "udp_demo"


def run(controller: str, link: Link, steps: int, real_time: bool = False) -> tuple[list[dict], dict]:
    return play(Scenario("test", link, controller, real_time), "predictor", episodes=2, seed=3, steps=steps)


def test_the_history_holds_the_pole_and_without_it_falls() -> None:
    """The predictor stands only if age and actions are right: see the controls below."""
    episodes, statistics = run("delayed", replace(ROUGH, missed=0.2), 150)
    assert [episode["return"] for episode in episodes] == [150, 150]
    assert statistics["decisions"] == 300
    assert statistics["duplicate"] + statistics["late"] > 10
    assert 2 < statistics["age_mean"] < 5
    again, same = run("delayed", replace(ROUGH, missed=0.2), 150)
    assert (again, same) == (episodes, statistics)  # whatever else the machine does
    blind, _ = run("blind", ROUGH, 150)
    assert max(episode["return"] for episode in blind) < 60


def test_by_the_clock() -> None:
    """The returns depend on the machine; that packets arrive and both processes end does not."""
    episodes, statistics = run("delayed", Link(1, 3), 40, real_time=True)
    assert len(episodes) == 2
    assert all(0 < episode["length"] <= 40 for episode in episodes)
    assert statistics["decisions"] > 0
    assert statistics["new"] > 0
    assert statistics["invalid"] == statistics["future"] == 0


def test_a_late_start() -> None:
    """The first observation is late too: the plant was idle for four steps, which the history contains."""
    link = Link(4, 5, first=4)
    episodes, statistics = run("delayed", link, 150)
    assert [episode["return"] for episode in episodes] == [150, 150]
    assert (statistics["missed"], statistics["decisions"]) == (8, 292)
    assert statistics["age_max"] <= 5
    _, statistics = run("delayed", link, 40, real_time=True)
    assert statistics["missed"] >= 6  # the fourth command is only late; more are missed on a busy machine
    assert statistics["invalid"] == statistics["future"] == 0


@pytest.mark.parametrize("wrong", ["one action more", "half of them", "newest first", "zeros"])
def test_the_predictor_falls_on_a_wrong_history(wrong: str) -> None:
    """The control: what the tests above rely on."""
    import gymnasium as gym
    from policies import Predictor

    from delayrl.wrappers import Delayed

    env, policy = Delayed(gym.make("InvertedPendulum-v5", max_episode_steps=300), 5), Predictor()

    def total(change: Any) -> float:
        obs, info = env.reset(seed=0)
        result, done = 0.0, False
        while not done:
            obs, reward, terminated, truncated, info = env.step(policy(obs, *change(info["actions"], info["age"])))
            result, done = result + float(reward), terminated or truncated
        return result

    changes: dict[str, Any] = {
        "one action more": lambda a, age: (np.concatenate([a[:age], a[max(0, age - 1) : age]]), min(age + 1, 2 * age)),
        "half of them": lambda a, age: (a, age // 2),
        "newest first": lambda a, age: (a[:age][::-1], age),
        "zeros": lambda a, age: (0 * a, age),
    }
    assert total(lambda a, age: (a, age)) == 300
    assert total(changes[wrong]) < 250


@given(st.binary(max_size=80))
@example(wire.encode(wire.ACTION, 1, 2, 0.5, np.float64([1, 2]))[:-1])
@example(wire.HEAD.pack(wire.MAGIC, wire.ACTION, 0, 0, 0.0, 65535))
def test_garbage_is_dropped(data: bytes) -> None:
    packet = wire.decode(data)
    assert packet is None or wire.encode(*packet) == data


def test_packets_come_back() -> None:
    packet = wire.decode(wire.encode(wire.OBSERVATION, 7, 8, 0.25, np.float32([1.5, -2.0])))
    assert packet is not None
    assert packet[:4] == (wire.OBSERVATION, 7, 8, 0.25)
    np.testing.assert_array_equal(packet.values, [1.5, -2.0])


def test_the_link_does_what_it_says() -> None:
    travelling = Travelling(Link(2, 5, loss=0.2, double=0.1), [0, 0])
    arrivals: dict[int, list[int]] = {}
    for step in range(20_000):
        travelling.send(step)
        for k in travelling.due(step):
            arrivals.setdefault(k, []).append(step - k)
    assert arrivals.pop(0)[0] == 0  # the first one comes at once
    travels = np.concatenate([travels for travels in arrivals.values()])
    assert sorted(set(travels)) == [2, 3, 4, 5]
    np.testing.assert_allclose(np.bincount(travels)[2:] / len(travels), 0.25, atol=0.02)
    assert len(arrivals) / 20_000 == pytest.approx(0.8, abs=0.02)
    assert np.mean([len(t) > 1 for t in arrivals.values()]) == pytest.approx(0.1, abs=0.02)


def test_a_missing_policy_is_one_line() -> None:
    command = [sys.executable, str(DEMO / "demo.py"), "--policy", "nothing-there"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_rows_and_picture(tmp_path: Path) -> None:
    from picture import draw

    rows = [
        {"scenario": name, "controller": who, "return": 10.0, "trace": [[0.0, 0.1], [0.0, 0.2]]}
        for name in ("no delay", "late")
        for who in ("delayed", "blind", "deaf")
    ]
    draw(json.loads(json.dumps(rows)), tmp_path / "udp.png")
    assert (tmp_path / "udp.png").stat().st_size > 1000
