"""From a run to a robot: bundles of a policy, and what runs them. Nothing here imports JAX until a run is exported.

`load_bundle` reads a bundle that `delayrl export` wrote; it needs NumPy and safetensors alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from delayrl.deploy.bundle import Bundle as Bundle
    from delayrl.deploy.bundle import load_bundle as load_bundle
    from delayrl.deploy.export import export_run as export_run

_HOME = {"Bundle": "bundle", "export_run": "export", "load_bundle": "bundle"}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"delayrl.deploy.{_HOME[name]}"), name)
    raise AttributeError(f"module 'delayrl.deploy' has no attribute {name!r}")
