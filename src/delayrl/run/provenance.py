"""What a result depends on besides the configuration: versions of the libraries, and the hardware."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax.numpy as jnp


def commit() -> str | None:
    """The commit of the checkout that the package lies in, marked where it has been changed; None outside of one.

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
    """Versions of Python and of the libraries that results depend on, and the device in words."""
    found: dict[str, Any] = {"python": platform.python_version()}
    for package in ("delayrl", "gymnasium", "jax", "jaxlib", "mujoco", "numpy", "optax"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    found["commit"] = commit()
    (device,) = jnp.zeros(()).devices()  # where arrays are made now, which `--device cpu` changes
    found["device"] = device.device_kind
    found["cores"] = os.cpu_count()
    found["machine"] = f"{platform.system()} {platform.machine()}"
    return found
