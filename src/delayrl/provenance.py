"""What a result depends on besides the configuration: versions of the libraries, and the hardware."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax


def versions() -> dict[str, Any]:
    """Versions of Python and of the libraries that results depend on, and the device in words."""
    found: dict[str, Any] = {"python": platform.python_version()}
    for package in ("delayrl", "gymnasium", "jax", "jaxlib", "mujoco", "numpy", "optax"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    found["device"] = jax.devices()[0].device_kind
    found["cores"] = os.cpu_count()
    found["machine"] = f"{platform.system()} {platform.machine()}"
    return found
