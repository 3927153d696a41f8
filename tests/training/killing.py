"""A process that dies at a chosen moment: its n-th environment step or call that changes the disk.

As a program (`python killing.py N AGENT OUT`) it trains, and sends itself SIGKILL at the moment.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from delayrl.training.actor import Actor

DISK = ("fsync", "rename", "unlink", "rmdir", "mkdir")
TINY = {
    "env": "Reacher-v5",
    "preset": "small",
    "steps": 240,
    "random_steps": 100,
    "replay_capacity": 150,
    "evaluate_every": 60,
    "evaluation_episodes": 1,
    "hidden": [8, 8],
    "batch_size": 8,
    "seeds": 2,
    "progress": False,
}
OWN = {"vdpo": {"width": 8, "layers": 1, "clone_every": 50, "clone_updates": 3}}


class KilledError(BaseException):
    """No handler for errors stops it."""


def options(agent: str) -> dict:
    return {**TINY, **OWN.get(agent, {}), "delay": 0 if agent == "sac" else 3}


@contextmanager
def moments(at: Callable[[int, str, str], None]) -> Iterator[None]:
    """Call `at(number, what, path)` before every environment step and every call that changes the disk."""
    count = 0

    def before(what, call):
        def wrapped(*args, **kwargs):
            nonlocal count
            count += 1
            at(count, what, str(args[0]))
            return call(*args, **kwargs)

        return wrapped

    kept = {name: getattr(os, name) for name in DISK}
    step = Actor.step
    for name, call in kept.items():
        setattr(os, name, before(name, call))
    Actor.step = before("step", step)
    try:
        yield
    finally:
        for name, call in kept.items():
            setattr(os, name, call)
        Actor.step = step


if __name__ == "__main__":
    from delayrl import train

    def kill(number: int, *_: str) -> None:
        if number == int(sys.argv[1]):
            os.kill(os.getpid(), signal.SIGKILL)

    with moments(kill):
        train(sys.argv[2], out=Path(sys.argv[3]), **options(sys.argv[2]))
