"""What a result depends on besides its configuration: versions of libraries, the commit, the hardware."""

import os
import platform
import re
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax.numpy as jnp


def commit() -> str | None:
    """Return the commit of the package's own checkout, marked if files of the package differ from it; else None."""
    package = Path(__file__).parents[1]

    def git(*words: str) -> str:
        command = ["git", "-C", str(package), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", __file__)  # else it is somebody else's checkout
        changed = git("status", "--porcelain", "--", str(package))
        return git("rev-parse", "--short=12", "HEAD") + ("-changed" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def versions() -> dict[str, Any]:
    """Return the versions of Python and of the libraries that results depend on, and the device in words."""
    used: dict[str, Any] = {"python": platform.python_version()}
    for package in ("delayrl", "gymnasium", "jax", "jaxlib", "mujoco", "numpy", "optax"):
        try:
            used[package] = version(package)
        except PackageNotFoundError:
            used[package] = None
    (device,) = jnp.zeros(()).devices()  # where arrays are made now, which `--device cpu` changes
    machine = f"{platform.system()} {platform.machine()}"
    hardware = {"cores": os.cpu_count(), "machine": machine, "processor": processor()}
    return used | {"commit": commit(), "device": device.device_kind} | hardware


def processor() -> str | None:
    """Return what the system calls the processor, if it says."""
    about = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*:\s*(.+)$", about.read_text(), re.MULTILINE) if about.exists() else None
    return found[1] if found else platform.processor() or None
