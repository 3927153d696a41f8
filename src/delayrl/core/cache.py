"""Keep compiled programs for the next process: compiling is half of the time of a short run (docs/performance.md)."""

import hashlib
import os
import platform
import sys
from pathlib import Path

import jax

LARGEST = 2**29
"""Bytes of compiled programs that are kept, for each kind of processor."""


def keep_compiled() -> Path | None:
    """Have JAX keep what it compiles in a folder of the user, and take from there what it has compiled before.

    Such an entry is code. So the folder belongs to the user, nobody else may write to it, and it is apart for each kind
    of processor. JAX's own settings come first: `JAX_COMPILATION_CACHE_DIR=…` for another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` for none. No result depends on it.

    Returns:
        The folder; None where JAX is set up already, or where no such folder can be made.
    """
    if jax.config.jax_compilation_cache_dir is not None or not jax.config.jax_enable_compilation_cache:
        return None
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "delayrl" / processor()
    try:
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if not _is_private(folder.parent) or not _is_private(folder):
            return None
        _prune(folder)
    except OSError:  # no home, or one that cannot be written to
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    return folder


def processor() -> str:
    """Return a name for this kind of processor: a program that was compiled for it may not run on another."""
    parts = [sys.platform, platform.machine(), platform.processor()]
    if (about := Path("/proc/cpuinfo")).exists():
        first, _, _ = about.read_text().partition("\n\n")
        parts += [line for line in first.splitlines() if line.startswith(("model name", "flags", "Features"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _is_private(folder: Path) -> bool:
    """Whether a folder is one of the user's, to which nobody else may write."""
    if not hasattr(os, "getuid"):  # Windows, where a user's folder is
        return True
    status = folder.lstat()
    return folder.is_dir() and not folder.is_symlink() and status.st_uid == os.getuid() and not status.st_mode & 0o022


def _prune(folder: Path) -> None:
    """Delete the oldest entries if together they are too large."""
    entries = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime, reverse=True)
    total = 0
    for file in entries:
        total += file.stat().st_size
        if total > LARGEST:
            file.unlink(missing_ok=True)
