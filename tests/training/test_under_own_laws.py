"""Laws of delays of a user are trained under, resumed, evaluated and exported."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import delayrl
from delayrl.bench.grid import load_grid
from delayrl.delays import PerEpisode, as_delay
from delayrl.deploy import export_run
from delayrl.errors import DelayRLError
from delayrl.lookup import contents
from delayrl.play.evaluation import evaluate, sweep
from delayrl.run.condition import resolve
from own_laws import Burst
from short_runs import SHRINK, assert_same_networks, killed_and_resumed, train

BURST = "own_laws:Burst(length=2, rate=0.3, steps=3)"


def test_a_named_law(tmp_path: Path) -> None:
    """Instance and text are one condition, in a grid too. The run is loaded by the text alone."""
    run = train("random", tmp_path / "run", delay=Burst(0.3))
    assert run.config["delay"] == BURST
    assert {row["delay"] for row in run.rows()} == {BURST}
    assert train("random", tmp_path / "run", delay="own_laws:Burst(rate=0.3)").path == run.path
    with pytest.raises(DelayRLError, match="holds a run with another delay"):
        train("random", tmp_path / "run", delay=Burst(0.4))
    assert evaluate(run.path, 2)["delay"] == BURST
    assert delayrl.load(run.path).spec.delay == 3
    file = tmp_path / "mine.toml"
    file.write_text('agents = ["bpql"]\ntasks = ["Pendulum-v1"]\ndelays = ["own_laws:Burst(rate=0.3)"]\n')
    (cell,) = load_grid(file).cells
    assert cell.condition.delay == BURST
    assert cell.id == resolve("bpql", "Pendulum-v1", Burst(0.3), "paper", "corrected", {}).cell_id([0])
    assert cell.condition.folder_name == "Pendulum-v1-delayown_laws:Burst(length=2, rate=0.3, steps=3"


def test_a_law_without_a_name_is_given_again(tmp_path: Path, monkeypatch) -> None:
    """Trained, killed and resumed with it, a run is the same as under the law's name; only playing needs it again."""

    @dataclass(frozen=True)
    class Local(Burst):
        pass

    run: Any = killed_and_resumed(SHRINK, tmp_path / "local", monkeypatch, delay=Local(0.3))
    named = train(SHRINK, tmp_path / "named", delay=Burst(0.3))
    assert run.config["delay"] == "<Local:3>"
    assert_same_networks(named, run)
    assert delayrl.load(run.path).spec == delayrl.load(named.path).spec
    with pytest.raises(DelayRLError, match="<Local:3> has no name that it could be imported by: give it again, as del"):
        evaluate(run.path, 1)
    assert evaluate(run.path, 2, delay=Local(0.3))["returns"] == evaluate(named.path, 2)["returns"]
    assert len(list(sweep(run.path, 1))) == 4
    assert export_run(run.path, tmp_path / "bundle")["ages"] == [0, 3]


def test_a_law_of_ones_own_in_each_episode() -> None:
    """By its text and by an instance: the same delay, drawn once for an episode."""
    text = "episode:own_laws:Burst(rate=0.5, steps=4)"
    delay = as_delay(text)
    assert delay == as_delay(PerEpisode(Burst(rate=0.5, steps=4)))
    assert as_delay(delay.plain()) == delay
    assert delay.maximum == 4
    law, random = delay.observation.law, np.random.default_rng(0)
    drawn = set()
    for _ in range(20):
        travel, state = law.draw(0, random)
        drawn.add(travel)
        assert {(law.draw(state, random)[0]) for _ in range(5)} == {travel}
    assert drawn == {1, 4}


def test_two_laws_without_a_name_are_two_runs(tmp_path: Path) -> None:
    """Also within another law, and a changed spec of a task; what no one can compare is taken as it comes."""

    @dataclass(frozen=True)
    class Local(Burst):
        pass

    train("random", tmp_path / "law", delay=Local(0.3))
    assert train("random", tmp_path / "law", delay=Local(0.3)).config["unnamed"].keys() == {"delay"}
    with pytest.raises(DelayRLError, match="holds a run with another delay"):
        train("random", tmp_path / "law", delay=Local(0.9))
    spec = gym.spec("Pendulum-v1")
    train("random", tmp_path / "spec", env=dataclasses.replace(spec, max_episode_steps=20))
    with pytest.raises(DelayRLError, match="holds a run with another env"):
        train("random", tmp_path / "spec", env=dataclasses.replace(spec, max_episode_steps=60))
    assert contents(lambda: 0) is contents([object()]) is contents({"a": object()}) is None

    @dataclass(frozen=True)
    class Held:
        scale: float
        activation: Any = math.tanh
        shape: Any = contents
        other: Any = lambda: 0

    assert contents(Held(1.0)) == {
        "": Held.__qualname__,
        "scale": 1.0,
        "activation": "math:tanh",
        "shape": "delayrl.lookup:contents",
    }
