"""Tasks: how they are named and made, the papers' nine, and small probes.

Importing this package imports nothing but `registration`, so that `import delayrl` is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from delayrl.envs.making import delay_of as delay_of
    from delayrl.envs.making import make as make
    from delayrl.envs.making import physics as physics
    from delayrl.envs.making import tasks as tasks
    from delayrl.envs.task import quiet as quiet

_HOME = {"delay_of": "making", "make": "making", "physics": "making", "tasks": "making", "quiet": "task"}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"delayrl.envs.{_HOME[name]}"), name)
    raise AttributeError(f"module 'delayrl.envs' has no attribute {name!r}")
