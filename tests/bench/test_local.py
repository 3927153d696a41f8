"""Workers on this machine: how many, and which cores each has."""

import json
import os
import subprocess
import sys
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import pytest

from delayrl.bench.backends import local
from delayrl.bench.grid import load_grid
from delayrl.run.cell import Cell


@pytest.mark.parametrize(("cores", "workers", "size"), [(2, 1, 2), (2, 2, 1), (16, 5, 3), (3, 4, 0)])
def test_shares_of_the_cores(cores: int, workers: int, size: int) -> None:
    available = list(range(10, 10 + cores))
    shares = local.shares(available, workers)
    assert [len(share) for share in shares] == [size] * workers
    flat = list(chain(*shares))
    assert len(set(flat)) == len(flat)
    assert set(flat) <= set(available)


def test_as_many_workers_as_cores_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "cores", lambda: list(range(8)))
    monkeypatch.setattr(local, "entry_points", lambda group: [])
    for gigabytes, replay, expected in ((64, 0, 8), (64, 10, 5), (8, 0, 5), (1, 10, 1)):
        monkeypatch.setattr(local, "free_memory", lambda gigabytes=gigabytes: gigabytes * 2**30)
        assert local.default_workers(None, replay * 2**30) == expected
    monkeypatch.setattr(local, "entry_points", lambda group: ["cuda"])
    assert [local.default_workers(device, 0) for device in (None, "gpu", "cpu")] == [1, 1, 1]
    monkeypatch.setattr(local, "free_memory", lambda: 2**62)
    assert local.default_workers("cpu", 0) == 8


def test_free_memory() -> None:
    """Some of this machine's, or unlimited where nobody says."""
    assert local.free_memory() > 2**20
    if hasattr(os, "sysconf") and Path("/proc/meminfo").exists():
        assert local.free_memory() < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def test_a_share_is_free_again_when_its_worker_has_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[list[int]] = []

    def start(folder: Path, device: str | None, share: list[int]) -> SimpleNamespace:
        given.append(share)
        over = SimpleNamespace(poll=lambda: 0 if process.ended else None, ended=False, returncode=0)
        over.communicate = lambda: ('["done", ""]', None)
        process = over
        return over

    monkeypatch.setattr(local, "cores", lambda: [4, 5])
    monkeypatch.setattr(local, "start_worker", start)
    backend = local.LocalBackend(tmp_path, 2)
    one, two, three = (Cell(SimpleNamespace(place="x", agent="y"), (0,), name) for name in "abc")  # type: ignore
    backend.start(one)
    backend.start(two)
    assert (given, backend.room()) == ([[4], [5]], 0)
    backend.running["b"][1].ended = True
    assert [cell.id for cell, _ in backend.ended()] == ["b"]
    backend.start(three)
    assert given[-1] == [5]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not pin processes")
def test_a_worker_stays_on_its_cores(tmp_path: Path) -> None:
    core = max(os.sched_getaffinity(0))
    code = """
import os
from delayrl.bench import worker
worker.work = lambda folder, device: worker.Outcome("done", f"{folder.name} {device} {sorted(os.sched_getaffinity(0))}")
worker.main()
"""
    words = [sys.executable, "-c", code, str(tmp_path / "cell"), "--device", "cpu", "--cores", str(core)]
    done = subprocess.run(words, stdin=subprocess.PIPE, capture_output=True, text=True, input=None)
    assert json.loads(done.stdout) == ["done", f"cell cpu [{core}]"]


def test_the_size_of_a_replay(tmp_path: Path) -> None:
    file = tmp_path / "grid.toml"
    shared = 'tasks = ["Pendulum-v1"]\ndelays = [0]\npreset = "small"\n'
    lists = '[[product]]\nagents = ["sac"]\nseeds = 3\n[[product]]\nagents = ["random"]\nseeds = 1\n'
    file.write_text(shared + lists + "overrides = { replay_capacity = 1000 }\n")
    grid = load_grid(file)
    row = 4 * (3 + 1) + 17  # Pendulum's observation and action, and five more numbers
    assert grid.replay_bytes == 3 * (20_000 * row + 12)
