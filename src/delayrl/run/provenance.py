"""What a result depends on besides its configuration: versions of libraries, the commit, the hardware."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax.numpy as jnp


def commit() -> str | None:
    """Return the commit of the checkout that the package lies in, marked if files differ from it; else None.

    A package that is installed into a folder of another project's checkout is not in that checkout.
    """
    here = Path(__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # else it is somebody else's checkout
        return git("rev-parse", "--short=12", "HEAD") + (
            "-changed" if git("status", "--porcelain", "--", str(here)) else ""
        )
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
    used["commit"] = commit()
    (device,) = jnp.zeros(()).devices()  # where arrays are made now, which `--device cpu` changes
    used["device"] = device.device_kind
    used["cores"] = os.cpu_count()
    used["machine"] = f"{platform.system()} {platform.machine()}"
    return used
