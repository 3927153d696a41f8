"""Packets: a fixed head and numbers. Nothing in them can be executed, and what is malformed is dropped."""

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

HELLO, OBSERVATION, TICK, ACTION, APPLIED, PAUSE, END = range(1, 8)
HEAD = struct.Struct("<4sBIIdH")  # magic, kind, episode, step, stamp, how many numbers follow
MAGIC = b"dly1"
LONGEST = 1024  # numbers in a packet


class Packet(NamedTuple):
    """One datagram. `values`: an observation, an action, or of a tick the steps of the observations with it."""

    kind: int
    episode: int
    step: int
    stamp: float
    values: NDArray[np.float64]


def encode(kind: int, episode: int, step: int, stamp: float = 0.0, values: NDArray[np.floating] | tuple = ()) -> bytes:
    """Bytes of a packet."""
    numbers = np.asarray(values, "<f8")
    return HEAD.pack(MAGIC, kind, episode, step, stamp, len(numbers)) + numbers.tobytes()


def decode(data: bytes) -> Packet | None:
    """The packet, or None where it is none of ours."""
    if len(data) < HEAD.size:
        return None
    magic, kind, episode, step, stamp, count = HEAD.unpack_from(data)
    if magic != MAGIC or not HELLO <= kind <= END or count > LONGEST:
        return None
    if len(data) != HEAD.size + 8 * count:
        return None
    return Packet(kind, episode, step, stamp, np.frombuffer(data, "<f8", count, HEAD.size))
