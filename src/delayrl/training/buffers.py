"""Have the memory that an update computes in stay the process's own, where the CPU's allocator would give it back."""

import ctypes
import sys
import threading
from collections.abc import Iterator
from typing import Any

import jax

from delayrl.agents.base import Agent
from delayrl.core.types import Spec
from delayrl.training.estimate import update_shapes

LARGE = 50 * 2**20
"""Bytes that the matrix products of an update yield, from which on keeping is faster (measured).

What XLA allocates at once for such an update is more than the 32 MB up to which glibc keeps a block by itself.
"""
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's malloc.h


def keep_memory(agent: Agent, spec: Spec, seeds: int) -> bool:
    """Where updates are large: no fresh pages for each. Returns whether that was asked for; no result changes by it.

    XLA allocates what an update computes in at each call. glibc gives blocks above 32 MB back to the system at once, so
    that all their pages are zeroed and mapped again: a sixth of an update's time. It keeps large blocks for a process's
    main thread only; so the updates are computed there, instead of on a thread of JAX's. That costs the time of the
    host's work beside them, and is why small updates stay where they are. Nothing is done without glibc, and off the
    main thread. It holds for the process, and is to be asked for before JAX looks for its devices.
    """
    if sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or seeds * max(product_bytes(agent, spec), default=0) < LARGE:
        return False
    if not mallopt(MMAP_THRESHOLD, 2**30):  # an old glibc, which knows no more than 32 MB
        return False
    mallopt(TRIM_THRESHOLD, 2**31 - 1)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    return True


def product_bytes(agent: Agent, spec: Spec) -> list[int]:
    """Of each phase: the bytes that the matrix products of one update yield. No device is touched."""
    shapes = [(phase, update_shapes(phase, agent, spec)) for phase in agent.phases()]
    return [sum(_products(jax.jit(phase.update).trace(*args).jaxpr)) for phase, args in shapes]


def _products(jaxpr: Any) -> Iterator[int]:
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield from (x.aval.size * x.aval.dtype.itemsize for x in equation.outvars)
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)  # closed or not
                if hasattr(inner, "eqns"):
                    yield from _products(inner)
