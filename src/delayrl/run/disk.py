"""Writing to disk: what is written appears under its name at once and complete, or not at all."""

import contextlib
import errno
import io
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError


@contextlib.contextmanager
def draft(path: Path, *, shared: bool = False) -> Iterator[Path]:
    """Yield the path of a draft, a file or a folder; rename it into place when the block ends, delete it if it raises.

    If `shared`, several processes may write it at the same time. Else the next overwrites what a killed one left.
    """
    name = path.with_name(f".{path.name}-{os.getpid()}.draft" if shared else f".{path.name}.draft")
    remove(name)
    try:
        yield name
        name.rename(path)
    except BaseException:
        with contextlib.suppress(OSError):
            remove(name)
        raise


def write_file(path: Path, data: bytes, *, shared: bool = False) -> None:
    """Write a file through a draft, flushed to the disk."""
    with draft(path, shared=shared) as name:
        write_flushed(name, data)


def write_figure(path: Path, figure: Any, dpi: int) -> None:
    """Write a figure of Matplotlib as a .png, or as what the suffix says. What fails leaves the file that was there."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format=path.suffix[1:] or "png", dpi=dpi)
    with disk_errors(path):
        write_file(path, drawn.getvalue())


def write_flushed(path: Path, data: bytes) -> None:
    """Write a file where it stands, flushed to the disk; for what is inside a draft already."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def parsed(text: str | bytes) -> dict[str, Any]:
    """Return the object that a JSON text holds. Raises ValueError where it holds none, or one nested too deeply."""
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(value, dict):
        raise ValueError("no object")
    return value


def remove(path: Path) -> None:
    """Delete a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def lock(path: Path, *, shared: bool = False, patience: float = 0) -> Iterator[bool]:
    """Lock a file or folder until the block or the process ends; yield whether it was free (always if none can lock).

    Shared locks keep out only those that are not. One that another process holds is tried again for `patience` seconds.
    """
    try:
        import fcntl  # POSIX only
    except ImportError:
        yield True
        return
    try:
        handle = os.open(path, os.O_RDWR)  # NFS locks what can be written
    except OSError:  # a folder, or what may only be read
        handle = os.open(path, os.O_RDONLY)
    try:
        free, give_up = False, time.monotonic() + patience
        while not free:
            try:
                fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
                free = True
            except BlockingIOError:
                if time.monotonic() >= give_up:
                    break
                time.sleep(0.05)
            except OSError:  # a file system without locks
                free = True
        yield free
    finally:
        os.close(handle)


PASSING = {errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN, errno.EINTR}
"""Errors of a disk, mostly of one on a network, that another try may not meet. A full disk stays full."""


def passes(error: BaseException) -> bool:
    """Tell whether an error, or what caused it, is one of `PASSING`."""
    return any(isinstance(one, OSError) and one.errno in PASSING for one in (error, error.__cause__))


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into one line."""
    try:
        yield
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        kept = "; what was stored before is kept" if os.path.exists(path) else ""  # Path.exists may raise
        raise DelayRLError(f"cannot write to {path}: {reason}{kept}") from error
