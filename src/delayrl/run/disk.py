"""Writing to disk: what is written appears under its name at once and complete, or not at all."""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

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


def write_flushed(path: Path, data: bytes) -> None:
    """Write a file where it stands, flushed to the disk; for what is inside a draft already."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def remove(path: Path) -> None:
    """Delete a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def lock(folder: Path) -> Iterator[bool]:
    """Lock a folder until the block or the process ends; yield whether it was free (always where nothing can lock)."""
    try:
        import fcntl  # POSIX only
    except ImportError:
        yield True
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        free = True
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            free = False
        except OSError:  # a file system without locks
            pass
        yield free
    finally:
        os.close(handle)


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into one line."""
    try:
        yield
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        raise DelayRLError(f"cannot write to {path}: {reason}; what was stored before is kept") from error
