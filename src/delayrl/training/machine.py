"""What this machine has for training: cores, memory, an accelerator; and how seeds are shared between the cores."""

import os
import re
from importlib.metadata import entry_points
from pathlib import Path


def cores() -> int:
    """Return how many cores this process may keep busy: those that it may run on, or a container's share of them."""
    number = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = control_group("cpu.max").partition(" ")
    return max(1, min(number, int(quota) // int(period))) if quota.isdigit() and period.isdigit() else number


def free_memory() -> int:
    """Return the bytes that new processes can take, in a container too; where nobody says, as if there was enough."""
    about = Path("/proc/meminfo")
    found = re.search(r"^MemAvailable:\s+(\d+) kB", about.read_text(), re.MULTILINE) if about.exists() else None
    free = int(found[1]) * 1024 if found else 2**62
    most, used = control_group("memory.max"), control_group("memory.current")
    if not (most.isdigit() and used.isdigit()):
        return free
    # given back when memory is short
    cached = re.search(r"^inactive_file (\d+)$", control_group("memory.stat"), re.MULTILINE)
    return min(free, int(most) - int(used) + (int(cached[1]) if cached else 0))


def control_group(name: str) -> str:
    """Return what a file of the control group of a container says; nothing where there is none."""
    try:
        return Path("/sys/fs/cgroup", name).read_text().strip()
    except OSError:
        return ""


def uses_accelerator(device: str | None) -> bool:
    """Whether workers on this device compute elsewhere than on the processor."""
    chosen = device or os.environ.get("JAX_PLATFORMS")
    return chosen != "cpu" and bool(entry_points(group="jax_plugins"))


def shared(seeds: int, device: str | None) -> str:
    """Return in words how seeds would learn faster than in one process, or "" if that is best.

    Processes of one core each learn more in an hour than one that has all cores (docs/performance.md).
    """
    number = min(cores(), seeds)
    if number == 1 or uses_accelerator(device) or not hasattr(os, "sched_getaffinity"):
        return ""
    faster = f"{number} processes of one core each learn more in an hour, and `delayrl bench run` starts them"
    return f"seeds: {seeds} share one process; {faster}"
