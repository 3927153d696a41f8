"""Where and how the process computes: its device, and update buffers that stay resident (docs/performance.md)."""

import ctypes
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import jax

from delayrl.agents.base import Agent
from delayrl.core.types import Spec
from delayrl.errors import DelayRLError
from delayrl.training.products import follow, traced_updates

LARGE = 50 * 2**20
"""Bytes of an update's matrix products from which computing on the main thread is faster (measured).

XLA's allocation for such an update can exceed the 64 MB that glibc has room for in the heap of another thread.
"""
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3  # glibc's malloc.h


def keep_buffers(agent: Agent, spec: Spec, seeds: int) -> None:
    """Have the allocator keep the buffers of updates. Call it before JAX looks for its devices.

    XLA allocates an update's buffers at each call. glibc returns blocks above 32 MB to the system at once, and on
    JAX's threads also smaller ones. So all their pages are zeroed and mapped again: a sixth to a quarter of an
    update's time. Asked to, it keeps blocks of up to 64 MB on any thread, larger ones on the main thread only. So large
    updates run there. That gives up computing beside the host's work, which costs small updates more than it saves.

    It needs a glibc that can be asked (2.35). No result depends on it.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None or not mallopt(MMAP_THRESHOLD, 2**26):  # an old glibc accepts no more than 32 MB
        return
    mallopt(TRIM_THRESHOLD, 2**27)
    mallopt(TOP_PAD, 2**26)  # as large as a heap: else one of another thread is unmapped when it is empty
    on_main_thread = threading.current_thread() is threading.main_thread()
    if not on_main_thread or seeds * max(product_bytes(agent, spec), default=0) < LARGE:
        return
    mallopt(MMAP_THRESHOLD, 2**30)
    mallopt(TRIM_THRESHOLD, 2**31 - 1)
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def product_bytes(agent: Agent, spec: Spec) -> list[int]:
    """Return for each phase the bytes of the matrix products of one update. Touches no device."""
    programs = [traced.jaxpr.jaxpr for _, traced in traced_updates(agent, spec)]
    results = [[x.aval for product in follow(program)[0] for x in product.equation.outvars] for program in programs]
    return [sum(x.size * x.dtype.itemsize for x in of_phase) for of_phase in results]


@contextmanager
def on_device(name: str | None) -> Iterator[None]:
    """Run on "cpu" or "gpu"; None leaves the choice to JAX."""
    if name is None:
        yield
        return
    if name not in ("cpu", "gpu"):
        raise DelayRLError(f"device must be cpu or gpu; got {name!r}")
    try:
        device = jax.devices(name)[0]
    except RuntimeError as error:
        hint = "`pip install 'delayrl[cuda]'` brings CUDA, or use --device cpu"
        raise DelayRLError(f"JAX finds no {name}; {hint}") from error
    with jax.default_device(device):
        yield
