"""Arrays on disk as safetensors, and pytrees as named arrays. Nothing is pickled."""

import hashlib
import operator
import re
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from delayrl.errors import DelayRLError, first_line
from delayrl.run.disk import write_flushed

Arrays = dict[str, NDArray[Any]]
OLD_NAME = re.compile(r"(?<![^.])((?:\w+_)?)memory(?![^.])")
"""Optimiser states were called "memory" in files that version 0.1 wrote."""


def save_arrays(path: Path, arrays: Arrays) -> str:
    """Write arrays as safetensors, flushed to the disk. Returns the file's SHA-256."""
    data = safetensors.numpy.save({name: np.array(array, order="C") for name, array in arrays.items()})
    write_flushed(path, data)
    return hashlib.sha256(data).hexdigest()


def load_arrays(path: Path) -> Arrays:
    """Read safetensors. Raises DelayRLError if the file is cut or something else."""
    try:
        return safetensors.numpy.load_file(path)  # type: ignore[no-any-return]
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        raise DelayRLError(f"{path} cannot be read: {first_line(error)}") from error


def inner_range(low: NDArray[Any], high: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a range in single precision, rounded inwards: no number of it is beyond the given one."""
    least, largest = np.asarray(low, np.float32), np.asarray(high, np.float32)
    least = np.where(least < low, np.nextafter(least, np.float32(np.inf)), least)
    return least, np.where(largest > high, np.nextafter(largest, np.float32(-np.inf)), largest)


def age_of(given: Any, longest: int) -> int:
    """Return an age as a number of steps. Raises DelayRLError if it is no integer, or not in 0..longest."""
    try:
        age = operator.index(given)
    except TypeError:
        raise DelayRLError(f"an age is an integer, the number of whole steps; got {given!r}") from None
    if not 0 <= age <= longest:
        raise DelayRLError(f"the policy takes ages 0..{longest}; got {age}")
    return age


def named_leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by name, in its order: "critic.0.w" for `tree.critic[0]["w"]`.

    Raises DelayRLError if two have one name.
    """
    import jax

    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    named: dict[str, Any] = {}
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if name in named:
            raise DelayRLError(f"two arrays of the agent's state would be stored as {name}: give one another name")
        named[name] = leaf
    return named


def flatten_tree(tree: Any) -> Arrays:
    """Return the leaves of a pytree as arrays by name."""
    return {name: np.asarray(leaf) for name, leaf in named_leaves(tree).items()}


def restore_tree(template: Any, arrays: Arrays, where: Path) -> Any:
    """Return a pytree of the template's form with stored leaves.

    Raises DelayRLError, naming `where`, if a leaf is missing, left over, or of another shape or type.
    """
    import jax

    expected = named_leaves(template)
    arrays = {name if name in expected else OLD_NAME.sub(r"\1opt_state", name): x for name, x in arrays.items()}
    for name in sorted(expected.keys() ^ arrays.keys()):
        verb = "lacks" if name in expected else "has"
        raise DelayRLError(f"{where} belongs to another agent or configuration: it {verb} {name}")
    for name, leaf in expected.items():
        if tuple(leaf.shape) != arrays[name].shape or np.dtype(leaf.dtype) != arrays[name].dtype:
            raise DelayRLError(
                f"{where} belongs to another agent or configuration: {name} is {arrays[name].dtype}"
                f"{list(arrays[name].shape)}, expected {leaf.dtype}{list(leaf.shape)}"
            )
    return jax.tree.unflatten(jax.tree.structure(template), [arrays[name] for name in expected])
