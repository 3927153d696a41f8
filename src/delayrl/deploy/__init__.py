"""From a run to a robot: policy bundles, the backends that compute them, and the controller that keeps the history.

Importing this package does not import JAX; only `export_run` and the backend `jax` do. `load_bundle` needs NumPy and
safetensors, `Controller` NumPy alone.
"""

from typing import TYPE_CHECKING, Any

from delayrl.deploy.runtime.controller import Controller as Controller
from delayrl.deploy.runtime.controller import ControlPolicy as ControlPolicy
from delayrl.deploy.runtime.controller import OverrunError as OverrunError
from delayrl.deploy.runtime.episode import ClockError as ClockError
from delayrl.deploy.runtime.telemetry import Statistics as Statistics
from delayrl.errors import import_later

if TYPE_CHECKING:
    from delayrl.deploy.adapter import AdaptedPolicy as AdaptedPolicy
    from delayrl.deploy.adapter import adapt as adapt
    from delayrl.deploy.adapter import export_layers as export_layers
    from delayrl.deploy.adapter import stable_baselines_layers as stable_baselines_layers
    from delayrl.deploy.bundle import Bundle as Bundle
    from delayrl.deploy.bundle import load_bundle as load_bundle
    from delayrl.deploy.export import export_run as export_run

LATER = {"Bundle": "bundle", "load_bundle": "bundle", "export_run": "export"} | dict.fromkeys(
    ("AdaptedPolicy", "adapt", "export_layers", "stable_baselines_layers"), "adapter"
)
"""Names that are imported when they are asked for, and their modules."""


def __dir__() -> list[str]:
    return sorted([*globals(), *LATER])


if not TYPE_CHECKING:  # else a checker takes every name for one of ours

    def __getattr__(name: str) -> Any:
        return import_later(__name__, LATER, name)
