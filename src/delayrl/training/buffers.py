"""Keep large update buffers resident between steps (docs/performance.md)."""

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
"""Bytes of an update's matrix products from which keeping the buffers is faster (measured).

XLA's allocation for such an update exceeds the 32 MB up to which glibc keeps a block by itself.
"""
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's malloc.h


def keep_buffers(agent: Agent, spec: Spec, seeds: int) -> bool:
    """Have the allocator keep the buffers of large updates. Call it before JAX looks for its devices.

    XLA allocates an update's buffers at each call. glibc returns blocks above 32 MB to the system at once, so all
    their pages are zeroed and mapped again: a sixth of an update's time. It keeps large blocks for the main thread
    only, so updates then run there, instead of on a thread of JAX's. That gives up computing beside the host's work,
    which costs small updates more than it saves.

    Returns whether buffers are kept from now on, in this process: never without glibc, off the main thread, or for
    small updates. No result depends on it.
    """
    if sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or seeds * max(product_bytes(agent, spec), default=0) < LARGE:
        return False
    if not mallopt(MMAP_THRESHOLD, 2**30):  # an old glibc, which accepts no more than 32 MB
        return False
    mallopt(TRIM_THRESHOLD, 2**31 - 1)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    return True


def product_bytes(agent: Agent, spec: Spec) -> list[int]:
    """Return for each phase the bytes of the matrix products of one update. Touches no device."""
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
