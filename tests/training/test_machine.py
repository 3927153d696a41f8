"""What this machine has, and how seeds are shared between its cores."""

import os
from pathlib import Path

import pytest

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
    monkeypatch.setattr(machine, "control_group", says.get)
    assert machine.cores() == min(whole, 2)
    assert machine.free_memory() == 2**29 + 1024
    says["cpu.max"] = "50000 100000"
    assert machine.cores() == 1
    says |= {"cpu.max": "max 100000", "memory.max": "max"}
    assert machine.cores() == whole
    assert machine.free_memory() > free / 2


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system does not pin processes")
def test_several_seeds_are_told_how_they_would_be_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "entry_points", lambda group: [])
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {4, 6})
    monkeypatch.setattr(machine, "control_group", lambda name: "")
    assert machine.shared(5, device="cpu").startswith("seeds: 5 share one process; 2 processes of one core each")
    assert machine.shared(1, device=None) == ""
    monkeypatch.setattr(machine, "entry_points", lambda group: ["cuda"])
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    assert machine.shared(2, device=None) == machine.shared(2, device="gpu") == ""
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # the plugin is installed, and not used
    assert machine.shared(2, device=None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {4})
    assert machine.shared(2, device="cpu") == ""
