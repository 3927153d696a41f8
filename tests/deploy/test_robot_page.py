"""The page on a robot: its code runs, and what it shows is what the commands print."""

import re
import runpy
import shlex
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bundles import bundle_of

from conftest import TINY
from delayrl.cli.main import main
from delayrl.core.types import Spec
from delayrl.deploy.runtime.telemetry import served
from delayrl.envs.making import delay_of
from delayrl.play.policy import Policy
from random_states import random_state

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "robot.md").read_text()
TASK = "InvertedPendulum-v5"


def test_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The page shows what `measure` prints of the example's log, and step 3 trains for what it recommends."""
    monkeypatch.chdir(tmp_path)
    make, measure = re.findall(r"^\$ (?:python|delayrl) (.*arm\.csv.*)$", PAGE, re.MULTILINE)
    script, *words = shlex.split(make)
    monkeypatch.setattr(sys, "argv", [script, *words])
    runpy.run_path(str(ROOT / script), run_name="__main__")
    main(shlex.split(measure))
    printed = capsys.readouterr().out
    assert f"{measure}\n{printed}```" in PAGE
    (trained,) = re.findall(rf"^delayrl train vdpo --env {TASK} --delay (\S+)", PAGE, re.MULTILINE)
    assert f"--delay {delay_of(TASK, trained)} " in printed


def test_the_delays() -> None:
    """Each text of the table is one, and they are as long as the table says."""
    table = PAGE[PAGE.index("| your robot |") : PAGE.index("If unsure")]
    texts = [text for text in re.findall(r"\| `(.*?)` \|", table) if text not in ("--delay", "recorded:delays.txt")]
    assert [delay_of(TASK, text).maximum for text in texts] == [3, 4, 2, 4, 4]


@pytest.mark.parametrize("late", [0, 3, 4])
def test_the_rehearsal(late: int, tmp_path: Path, monkeypatch, capsys) -> None:
    """A policy of ages 0..3 meets an overrun in every step from the fourth on, if observations are four steps late."""
    spec, push = Spec(4, 1, 3), np.full(1, 0.01, np.float32)  # so weak that the pole falls by itself
    policy = Policy(TINY["bpql"], random_state(TINY["bpql"], spec), spec, -push, push)
    monkeypatch.chdir(tmp_path)
    bundle_of(tmp_path / "pendulum", policy, env=TASK, dt=0.04, action_delay=1)  # which this plant does not have
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.setattr(sys, "argv", ["rehearse.py", str(late)])
    exec(compile(code, "rehearse.py", "exec"), {})
    steps, overruns, decisions = map(int, re.findall(r"(\d+)(?: steps;| of | decisions)", capsys.readouterr().out))
    assert steps == decisions > 4
    assert overruns == (steps - 4 if late == 4 else 0)


def test_what_the_bundle_serves() -> None:
    assert f"  serves                   {served(0, 3, 0, 0.04)}\n" in PAGE


def test_the_loop_on_a_robot(tmp_path: Path, monkeypatch, capsys) -> None:
    """It runs as it stands beside what is the reader's own, pauses after a stall, and ends with the safe command."""
    spec = Spec(4, 1, 3)
    policy = Policy(TINY["bpql"], random_state(TINY["bpql"], spec), spec, -np.ones(1), np.ones(1))
    monkeypatch.chdir(tmp_path)
    bundle_of(tmp_path / "my-bundle", policy, env=TASK, dt=0.02)
    page = (ROOT / "docs" / "runtime.md").read_text()
    code = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    times: list[float] = []
    sent: list[float] = []

    def subscribe(deliver: Any) -> None:
        def sensor() -> None:
            while len(sent) < 12:  # then it is silent, and every decision is an overrun
                deliver(SimpleNamespace(values=np.zeros(4), stamp=time.monotonic()))
                time.sleep(0.005)

        threading.Thread(target=sensor, daemon=True).start()

    def send(command: Any) -> None:
        sent.append(float(np.ravel(command)[0]))
        times.append(time.monotonic())
        if len(sent) == 6:
            time.sleep(0.3)  # a stall of 15 periods

    own = {"subscribe": subscribe, "send": send, "running": lambda: len(sent) < 30, "safe_command": np.full(1, 0.75)}
    exec(compile(code, "loop.py", "exec"), own | {"standing": np.zeros(1)})
    assert sent[-1] == 0.75
    assert set(sent[-10:]) == {0.75} != set(sent)
    assert (np.diff(times[5:29]) < 0.005).sum() < 3  # no period of the stall is made up for; a busy machine oversleeps
    assert "overruns=" in capsys.readouterr().out
