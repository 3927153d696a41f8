"""Keep compiled programs for the next process: compiling is half of the time of a short run (docs/performance.md)."""

import contextlib
import hashlib
import os
import platform
import stat
import sys
from pathlib import Path
from typing import Any

import jax

LARGEST = 2**29
"""Bytes of compiled programs that are kept, for each kind of processor."""


def keep_compiled() -> Path | None:
    """Have JAX keep what it compiles in a folder of the user, and take from there what it has compiled before.

    Such an entry is code. So the folder belongs to the user, nobody else may write to it or exchange it, and it is
    apart for each kind of processor. JAX's own settings come first: `JAX_COMPILATION_CACHE_DIR=…` for another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` for none. No result depends on it. The setting holds for the whole process.

    Returns:
        The folder; None where JAX is set up already, or where no such folder can be made.
    """
    config: Any = jax.config  # JAX 0.10 declares no types
    if config.jax_compilation_cache_dir is not None or not config.jax_enable_compilation_cache:
        return None
    try:
        given = Path(os.environ.get("XDG_CACHE_HOME", ""))  # a relative one is to be ignored
        folder = (given if given.is_absolute() else Path.home() / ".cache") / "delayrl" / processor_kind()
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        folder = folder.resolve()
        if not _is_private(folder):
            return None
        _prune(folder)
    except (OSError, RuntimeError):  # no home, or one that cannot be written to
        return None
    config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    return folder


def processor_kind() -> str:
    """Return a name for this kind of processor: a program that was compiled for it may not run on another."""
    parts = [sys.platform, platform.machine(), platform.processor()]
    if (about := Path("/proc/cpuinfo")).exists():
        first, _, _ = about.read_text().partition("\n\n")
        parts += [line for line in first.splitlines() if line.startswith(("model name", "flags", "Features"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _is_private(folder: Path) -> bool:
    """Whether a folder is the user's, and nobody else may write to it, or to a folder above it."""
    if not hasattr(os, "getuid"):  # Windows, where a user's folder is
        return True
    user, own = os.getuid(), (folder, folder.parent)
    for path in (folder, *folder.parents):
        status = path.stat()
        shared = bool(status.st_mode & 0o022)
        if path not in own and status.st_mode & stat.S_ISVTX:  # as in /tmp: everybody may add, and only touch their own
            shared = False
        if shared or status.st_uid not in ((user,) if path in own else (user, 0)):
            return False
    return True


def _prune(folder: Path) -> None:
    """Delete the oldest entries if together they are too large. Another process may do so at the same time."""
    entries = []
    for file in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):
            status = file.stat()
            entries.append((status.st_mtime, status.st_size, file))
    total = 0
    for _, size, file in sorted(entries, reverse=True):
        total += size
        if total > LARGEST:
            file.unlink(missing_ok=True)
