"""The content of a new bundle. Needs no JAX."""

import warnings
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Arrays, Network
from delayrl.deploy.backends.numpy_policy import numpy_policy
from delayrl.deploy.backends.onnx_policy import onnx_graph
from delayrl.deploy.files import GRAPH, WEIGHTS, check_files, seal
from delayrl.errors import DelayRLError, DelayWarning

SAMPLES, TOLERANCE = 200, 1e-3
"""Inputs on which a network is compared with the policy that it is of, and its largest error, of the actions' range."""


def check_same(
    network: Network,
    arrays: Arrays,
    policy: Callable[..., NDArray[Any]],
    otherwise: str,
    usual: tuple[NDArray[Any], NDArray[Any]] | None = None,
) -> None:
    """Raise DelayRLError, which begins with `otherwise`, unless the network acts as the policy, at ages from 0 to Δ.

    `policy` takes the newest observation [S], the actions since [Δ, A] and the age, as a bundle does. `usual` are mean
    and deviation of its observations, both [S], if they are known: half of those here are like them, where a mean far
    above its deviation leaves single precision few digits.
    """
    act, random = numpy_policy(network, arrays), np.random.default_rng(0)
    low, high = np.asarray(network.low), np.asarray(network.high)
    for number, age in enumerate(np.linspace(0, network.max_age, SAMPLES).round().astype(int).tolist()):
        obs = (random.normal(size=network.obs_size) * random.choice([0.1, 1.0])).astype(np.float32)
        if usual is not None and number % 2:
            obs = np.asarray(usual[0] + usual[1] * obs, np.float32)
        actions = np.zeros((network.max_age, network.action_size), np.float32)
        actions[:age] = random.uniform(low, high, (age, network.action_size))
        error = float(np.max(np.abs(act(obs, actions, age) - policy(obs, actions, age)) / (high - low)))
        if not error <= TOLERANCE and usual is not None and number % 2:
            why = "single precision has too few digits for observations so far from 0: subtract their mean in the task"
            raise DelayRLError(f"{why}; at age {age} the action is {error:.2g} of the range off")
        if not error <= TOLERANCE:
            raise DelayRLError(f"{otherwise}: at age {age} it is {error:.2g} of the range off")


def pack(network: Network, arrays: Arrays, metadata: dict[str, Any]) -> dict[str, bytes]:
    """Return the files of a bundle: the weights, the graph, and a bundle.json of `metadata` and the network.

    Without the package `onnx` the graph is left out, with a DelayWarning that says so. Raises DelayRLError if a file is
    larger than a bundle allows.
    """
    metadata = metadata | {"policy": network.document()}
    weights = safetensors.numpy.save(dict(sorted(arrays.items())))
    files = {WEIGHTS: weights}
    if find_spec("onnx") is None:
        line = f"the bundle has no {GRAPH}, because the package onnx is not installed: pip install 'delayrl[deploy]', "
        warnings.warn(line + "then export again with --force", DelayWarning, stacklevel=3)
    else:
        files[GRAPH] = onnx_graph(network, arrays, metadata)
    check_files("the new bundle", metadata, files)
    return seal(metadata, files)


def space_json(space: Any) -> dict[str, Any]:
    """Return a Box as JSON can hold it, with null for a missing bound."""
    low, high = ([float(x) if np.isfinite(x) else None for x in bound] for bound in (space.low, space.high))
    return {"shape": list(space.shape), "dtype": str(space.dtype), "low": low, "high": high}
