"""Where and how the process computes: its device, and large update buffers that stay resident (docs/performance.md)."""

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
    programs = [program for _, program in traced_updates(agent, spec)]
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
