"""Reinforcement learning when observations arrive late.

`make` wraps a Gymnasium task with a delay, `train` trains an agent on it, `load` gives back the policy of a
run. JAX is imported only when training or a policy is asked for: `delayrl.wrappers` needs NumPy and Gymnasium alone.
Importing delayrl registers its tasks: `gymnasium.make("delayrl/Ant-v4")`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from delayrl.envs.registration import watch_gymnasium
from delayrl.errors import import_later

if TYPE_CHECKING:
    from delayrl import delays as delays
    from delayrl import deploy as deploy
    from delayrl import wrappers as wrappers
    from delayrl.agents.registry import AGENTS as AGENTS
    from delayrl.delays import Delay as Delay
    from delayrl.delays import as_delay as as_delay
    from delayrl.deploy.export import export_run as export_run
    from delayrl.envs.making import make as make
    from delayrl.errors import DelayRLError as DelayRLError
    from delayrl.errors import DelayWarning as DelayWarning
    from delayrl.errors import StoppedError as StoppedError
    from delayrl.play.evaluation import evaluate as evaluate
    from delayrl.play.evaluation import sweep as sweep
    from delayrl.play.policy import Policy as Policy
    from delayrl.play.policy import load as load
    from delayrl.play.run import Run as Run
    from delayrl.play.run import runs as runs
    from delayrl.play.video import watch as watch
    from delayrl.training.further import go_on as go_on
    from delayrl.training.train import train as train
    from delayrl.wrappers import AugmentedObservation as AugmentedObservation
    from delayrl.wrappers import AugmentedVectorObservation as AugmentedVectorObservation
    from delayrl.wrappers import Delayed as Delayed
    from delayrl.wrappers import DelayedVector as DelayedVector

__version__ = "0.2.0.dev0"

_HOME = {
    "AGENTS": "agents.registry",
    "AugmentedObservation": "wrappers",
    "AugmentedVectorObservation": "wrappers",
    "DelayRLError": "errors",
    "DelayWarning": "errors",
    "StoppedError": "errors",
    "Delay": "delays",
    "Delayed": "wrappers",
    "DelayedVector": "wrappers",
    "as_delay": "delays",
    "Policy": "play.policy",
    "Run": "play.run",
    "evaluate": "play.evaluation",
    "export_run": "deploy.export",
    "load": "play.policy",
    "make": "envs.making",
    "runs": "play.run",
    "sweep": "play.evaluation",
    "go_on": "training.further",
    "train": "training.train",
    "watch": "play.video",
}
_PACKAGES = ("delays", "deploy", "wrappers")
"""Packages that need no import of their own."""
__all__ = sorted(_HOME)

watch_gymnasium()


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


if not TYPE_CHECKING:  # else a checker takes every name for one of ours

    def __getattr__(name: str) -> Any:
        return import_module(f"{__name__}.{name}") if name in _PACKAGES else import_later(__name__, _HOME, name)
