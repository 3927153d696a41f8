"""What this machine has, and how seeds are shared between its cores."""

import functools
import os
from pathlib import Path

import pytest

from delayrl.run.folder import RunFolder
from delayrl.training import machine


def test_free_memory() -> None:
    """Some of this machine's, or unlimited where nobody says."""
    assert machine.free_memory() > 2**20
    if hasattr(os, "sysconf") and Path("/proc/meminfo").exists():
        assert machine.free_memory() < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def test_containers_have_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of a control group count, where there are any."""
    whole, free = machine.cores(), machine.free_memory()
    says = {"cpu.max": "250000 100000", "memory.max": str(2**30), "memory.current": str(2**29)}
    says["memory.stat"] = "file 7\ninactive_file 1024\nactive_file 7"
    monkeypatch.setattr(machine, "limit", says.get)
    assert machine.cores() == min(whole, 2)
    assert machine.free_memory() == 2**29 + 1024
    says["cpu.max"] = "50000 100000"
    assert machine.cores() == 1
    says |= {"cpu.max": "max 100000", "memory.max": "max"}
    assert machine.cores() == whole
    assert machine.free_memory() > free / 2


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system does not pin processes")
def test_several_seeds_are_told_how_they_would_be_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each seed is in one command, each command on a core that this process may use."""
    monkeypatch.setattr(machine, "entry_points", lambda group: [])
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {4, 6, 7, 9, 11})
    monkeypatch.setattr(machine, "limit", lambda name: "")
    folders = [RunFolder(Path(f"runs/x/seed{seed}")) for seed in (3, 4, 5, 6, 7)]
    shared = functools.partial(machine.shared, folders=folders)
    assert [line for line in shared([3, 4, 5, 6, 7], device=None).splitlines() if "taskset" in line] == [
        "  taskset -c 4 delayrl train … --seed 3 --seeds 1 --out runs/x/seed3 &",
        "  taskset -c 11 delayrl train … --seed 7 --seeds 1 --out runs/x/seed7 &",
    ]
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {4, 6})
    assert shared([3, 4, 5, 6, 7], device="cpu").splitlines()[1:3] == [
        "  taskset -c 4 delayrl train … --seed 3 --seeds 3 --out runs/x &",
        "  taskset -c 6 delayrl train … --seed 6 --seeds 2 --out runs/x &",
    ]
    assert shared([3], device=None) == shared([3, 5], device=None) == ""
    monkeypatch.setattr(machine, "entry_points", lambda group: ["cuda"])
    assert shared([3, 4], device=None) == shared([3, 4], device="gpu") == ""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {4})
    assert shared([3, 4], device="cpu") == ""
