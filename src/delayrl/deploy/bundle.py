"""The policy of a bundle: `load_bundle` reads and checks the files, `Bundle` acts."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delayrl.deploy.backends.network import Act, Network
from delayrl.deploy.backends.numpy_policy import numpy_policy
from delayrl.deploy.files import WEIGHTS, check_files, read_files
from delayrl.deploy.runtime.episode import LONGEST_STEP, SHORTEST_STEP
from delayrl.errors import DelayRLError, one_line
from delayrl.run.arrays import age_of

BACKENDS = ("numpy", "onnx", "jax")


class Bundle:
    """A policy that was loaded from a bundle.

    Attributes:
        network: sizes, range of the actions, and architecture.
        obs_size, action_size: S and A.
        low, high: the range of the actions, [A], in the task's units.
        max_age: Δ, the longest age that it takes, in steps.
        min_age: the shortest that it learned, in steps, after the start of an episode; 0 if unknown.
        dt: seconds between two decisions; None if the task does not say.
        action_delay: the longest delay of actions in training, in steps, which is part of the age; 0 if unknown.
        idle: what acted in training before the first command, [A]; None if unknown.
        metadata: the content of bundle.json.
        backend: "numpy", "onnx" or "jax".
    """

    def __init__(self, network: Network, metadata: dict[str, Any], act: Act, backend: str) -> None:
        self.network, self.metadata, self.backend, self._act = network, metadata, backend, act
        self.obs_size, self.action_size = network.obs_size, network.action_size
        self.low, self.high = np.asarray(network.low, np.float32), np.asarray(network.high, np.float32)
        for bound in (self.low, self.high):  # they clip every action
            bound.setflags(write=False)
        self.max_age = network.max_age
        self.dt = _dt(metadata)
        self.min_age, self.action_delay = _min_age(metadata, self.max_age), _action_delay(metadata, self.max_age)
        self.idle = _idle(metadata, network.action_size)

    def __repr__(self) -> str:
        made = f"{self.metadata.get('agent')} on {self.metadata.get('env')}"
        return f"Bundle({made}, ages {self.min_age}..{self.max_age}, backend {self.backend})"

    def __call__(self, obs: ArrayLike, actions: ArrayLike, age: int) -> NDArray[np.float32]:
        """Compute the deterministic action. Calls do not depend on each other.

        Args:
            obs: the newest observation that has arrived, [S].
            actions: the actions applied since it was made, oldest first, [Δ, A], in the task's units. Entries after the
                first `age` are ignored.
            age: how many actions those are, 0..Δ.

        Returns:
            [A], float32, in the task's units.

        Raises:
            DelayRLError: wrong sizes, an age beyond those of training, or numbers that are not finite.
        """
        age = age_of(age, self.max_age)
        try:
            with np.errstate(over="ignore"):  # overflow gives infinity, which is refused below
                obs, actions = np.asarray(obs, np.float32), np.asarray(actions, np.float32)
        except (TypeError, ValueError, OverflowError):
            raise DelayRLError("the policy takes arrays of numbers: obs [S] and actions [Δ, A]") from None
        if obs.shape != (self.obs_size,):
            raise DelayRLError(f"the policy takes observations of size {self.obs_size}; got shape {obs.shape}")
        shape = (self.max_age, self.action_size)
        if actions.shape != shape:
            raise DelayRLError(f"the policy takes an action history of shape {shape}; got {actions.shape}")
        if not (np.isfinite(obs).all() and np.isfinite(actions[:age]).all()):
            raise DelayRLError("the policy was given an observation or an action that is not a finite number")
        with np.errstate(all="ignore"):
            action = self._act(obs, actions, age)
        if not np.isfinite(action).all():
            raise DelayRLError("the policy was given numbers so large that its action is not finite")
        return np.minimum(np.maximum(action, self.low), self.high)  # rounding may have brought it beyond


def load_bundle(path: str | Path, backend: str = "numpy") -> Bundle:
    """Read a bundle, check everything in it, and return its policy.

    Args:
        path: the folder of the bundle.
        backend: "numpy"; "onnx", which runs a graph of the weights with onnxruntime (extra `deploy`); or "jax".
            None of them reads policy.onnx.

    Raises:
        DelayRLError: no bundle, a damaged or foreign one, or a backend that is not installed.
    """
    if backend not in BACKENDS:
        raise DelayRLError(f"unknown backend {backend!r}; there are {', '.join(BACKENDS)}")
    metadata, files = read_files(path, (WEIGHTS,))
    network, arrays = check_files(path, metadata, files)
    if backend == "jax":
        with one_line("the backend jax cannot be imported"):
            from delayrl.deploy.backends.jax_policy import jax_policy as policy
    elif backend == "onnx":
        from delayrl.deploy.backends.onnx_policy import onnx_policy as policy
    else:
        policy = numpy_policy
    return Bundle(network, metadata, policy(network, arrays), backend)


def _dt(metadata: dict[str, Any]) -> float | None:
    """Return the length of a step in a bundle.json, None if it has none. All of these refuse what cannot be."""
    dt = metadata.get("dt")
    if dt is None:
        return None
    if type(dt) not in (int, float) or not SHORTEST_STEP <= dt <= LONGEST_STEP:
        raise _unusable("dt", dt, f"seconds from {SHORTEST_STEP:g} to {LONGEST_STEP:g}")
    return float(dt)


def _min_age(metadata: dict[str, Any], longest: int) -> int:
    """Return the shortest age in a bundle.json, 0 if it has none."""
    ages: Any = metadata.get("ages")
    if ages is None:
        return 0
    pair = isinstance(ages, list) and len(ages) == 2 and all(type(age) is int for age in ages)
    if not pair or not 0 <= ages[0] <= ages[1] == longest:
        raise _unusable("ages", ages, f"the shortest and the longest, {longest}")
    return int(ages[0])


def _action_delay(metadata: dict[str, Any], longest: int) -> int:
    """Return the delay of actions in a bundle.json, 0 if it has none."""
    steps: Any = metadata.get("action_delay")
    if steps is None:
        return 0
    if type(steps) is not int or not 0 <= steps <= longest:
        raise _unusable("action_delay", steps, f"whole steps from 0 to {longest}")
    return steps


def _idle(metadata: dict[str, Any], size: int) -> NDArray[np.float32] | None:
    """Return the idle action in a bundle.json, None if it has none."""
    idle = metadata.get("idle")
    if idle is None:
        return None
    largest = float(np.finfo(np.float32).max)
    sized = isinstance(idle, list) and len(idle) == size
    if not sized or not all(type(x) in (int, float) and abs(x) <= largest for x in idle):
        raise _unusable("idle", idle, f"{size} numbers")
    return np.asarray(idle, np.float32)


def _unusable(name: str, value: Any, allowed: str) -> DelayRLError:
    return DelayRLError(f"bundle.json is damaged: {name} is {value!r:.60}, and must be {allowed}")
