"""Have the memory that an update computes in stay the process's own, where the CPU's allocator would give it back."""

import ctypes
import sys

import jax

from delayrl.agents.base import Agent
from delayrl.estimate import product_bytes
from delayrl.types import Spec

LARGE = 50 * 2**20
"""Bytes of an update's matrix products beyond which glibc maps fresh pages for every update (measured)."""
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's malloc.h


def keep_memory(agent: Agent, spec: Spec, seeds: int) -> bool:
    """Where updates are large: no fresh pages for each. Returns whether they are; no result changes by it.

    XLA allocates what an update computes in at each call. glibc gives blocks above 32 MB back to the system at once, so
    that all their pages are zeroed and mapped again: a sixth of an update's time. It keeps large blocks for a process's
    main thread only; so the updates are computed there, instead of on a thread of JAX's. That costs the time of the
    host's work beside them, and is why small updates stay where they are. Without glibc nothing is kept, and where JAX
    has looked for its devices before, the thread stays what it was.
    """
    if seeds * max(product_bytes(agent, spec)) < LARGE:
        return False
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # read once, when JAX first looks for the CPU
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)):
        mallopt(MMAP_THRESHOLD, 2**30)
        mallopt(TRIM_THRESHOLD, 2**31 - 1)
    return True
