"""Workers on this machine: how many, and which cores each has."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from delayrl.bench.backends import local
from delayrl.bench.grid import load_grid
from delayrl.training import machine


def test_as_many_workers_as_cores_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "cores", lambda: 8)
    monkeypatch.setattr(machine, "entry_points", lambda group: [])
    for gigabytes, replay, expected in ((64, 0, 8), (64, 10, 5), (8, 0, 5), (1, 10, 1)):
        monkeypatch.setattr(local, "free_memory", lambda gigabytes=gigabytes: gigabytes * 2**30)
        assert local.default_workers(None, replay * 2**30) == expected
    monkeypatch.setattr(machine, "entry_points", lambda group: ["cuda"])
    assert [local.default_workers(device, 0) for device in (None, "gpu", "cpu")] == [1, 1, 1]
    monkeypatch.setattr(local, "free_memory", lambda: 2**62)
    assert local.default_workers("cpu", 0) == 8


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not pin processes")
def test_a_worker_stays_on_its_cores(tmp_path: Path) -> None:
    core = max(os.sched_getaffinity(0))
    code = """
import os
from delayrl.bench import worker
worker.work = lambda folder, device: worker.Outcome("done", f"{folder.name} {device} {sorted(os.sched_getaffinity(0))}")
worker.main()
"""
    words = [sys.executable, "-c", code, str(tmp_path / "cell"), "--device", "cpu", "--core", str(core)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as worker:
        assert json.loads(worker.stdout.readline()) == ["done", f"cell cpu [{core}]"]  # type: ignore[union-attr]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not pin processes")
def test_the_core_with_the_fewest_workers(monkeypatch) -> None:
    """Of this runner and of others, here without those that this machine may have."""
    available = sorted(os.sched_getaffinity(0))
    processes: list[Path] = []
    monkeypatch.setattr(Path, "glob", lambda folder, pattern: iter(processes))
    own: dict[int, int | None] = {}
    for number in range(2 * len(available)):
        own[-number] = local.free_core(own)
    assert list(own.values()) == 2 * available
    sleep = [sys.executable, "-c", "print(flush=True); input()", "delayrl.bench.worker", "--core", str(available[0])]
    with subprocess.Popen(sleep, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()  # type: ignore[union-attr]
        processes.append(Path("/proc", str(other.pid)))
        assert local.free_core({}) == available[1 % len(available)]
        assert local.free_core({other.pid: available[-1]}) == available[0]
        other.kill()


def test_the_size_of_a_replay(tmp_path: Path) -> None:
    file = tmp_path / "grid.toml"
    shared = 'tasks = ["Pendulum-v1"]\ndelays = [0]\npreset = "small"\n'
    lists = '[[product]]\nagents = ["sac"]\nseeds = 3\n[[product]]\nagents = ["random"]\nseeds = 1\n'
    file.write_text(shared + lists + "overrides = { replay_capacity = 1000 }\n")
    grid = load_grid(file)
    row = 4 * (3 + 1) + 17  # Pendulum's observation and action, and five more numbers
    assert grid.replay_bytes == 3 * (20_000 * row + 12)
