"""The content of a new bundle. Needs no JAX."""

import warnings
from importlib.util import find_spec
from typing import Any

import numpy as np
import safetensors.numpy

from delayrl.deploy.backends.network import Arrays, Network
from delayrl.deploy.backends.onnx_policy import onnx_graph
from delayrl.deploy.files import GRAPH, WEIGHTS, check_files, seal
from delayrl.errors import DelayWarning


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
