"""From a run to a robot: bundles of a policy, what runs them, and what keeps the history right around them.

Nothing here imports JAX until a run is exported. `load_bundle` needs NumPy and safetensors, `Controller` NumPy alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from delayrl.deploy.bundle import Bundle as Bundle
    from delayrl.deploy.bundle import load_bundle as load_bundle
    from delayrl.deploy.export import export_run as export_run
    from delayrl.deploy.runtime.controller import ClockError as ClockError
    from delayrl.deploy.runtime.controller import Controller as Controller
    from delayrl.deploy.runtime.controller import OverrunError as OverrunError
    from delayrl.deploy.runtime.controller import Policy as Policy
    from delayrl.deploy.runtime.statistics import Statistics as Statistics

_HOME = {
    "Bundle": "bundle",
    "ClockError": "runtime.controller",
    "Controller": "runtime.controller",
    "OverrunError": "runtime.controller",
    "Policy": "runtime.controller",
    "Statistics": "runtime.statistics",
    "export_run": "export",
    "load_bundle": "bundle",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"delayrl.deploy.{_HOME[name]}"), name)
    raise AttributeError(f"module 'delayrl.deploy' has no attribute {name!r}")
