"""Packets: a fixed head, then numbers. They contain nothing executable, and malformed ones are dropped."""

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

HELLO, OBSERVATION, TICK, ACTION, APPLIED, PAUSE, END = range(1, 8)
HEAD = struct.Struct("<4sBIIdH")  # magic, kind, episode, step, stamp, how many numbers follow
MAGIC = b"dly1"
LONGEST = 1024  # numbers in a packet


class Packet(NamedTuple):
    """One datagram. `values` is an observation, an action, or for a tick the steps of its observations."""

    kind: int
    episode: int
    step: int
    stamp: float
    values: NDArray[np.float64]


def encode(kind: int, episode: int, step: int, stamp: float = 0.0, values: NDArray[np.floating] | tuple = ()) -> bytes:
    """Return a packet as bytes."""
    numbers = np.asarray(values, "<f8")
    return HEAD.pack(MAGIC, kind, episode, step, stamp, len(numbers)) + numbers.tobytes()


def decode(data: bytes) -> Packet | None:
    """Return the packet in the bytes, or None if they are not a packet."""
    if len(data) < HEAD.size:
        return None
    magic, kind, episode, step, stamp, count = HEAD.unpack_from(data)
    if magic != MAGIC or not HELLO <= kind <= END or count > LONGEST:
        return None
    if len(data) != HEAD.size + 8 * count:
        return None
    return Packet(kind, episode, step, stamp, np.frombuffer(data, "<f8", count, HEAD.size))
