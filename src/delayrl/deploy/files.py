"""The files of a policy bundle: weights, and what must be known to use them. They are data, none is code.

```
bundle.json          network, task, delay, evaluation; sizes and SHA-256 sums of the files below; its own sum
policy.safetensors   the weights
policy.onnx          the same policy as a graph (optional)
```

A bundle may come from anybody. Only these names are read, only as regular files, and nothing is used before its size
and its sum are right and every array has the shape that the description asks for.
"""

import hashlib
import json
import os
import shutil
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Arrays, Network, parse
from delayrl.errors import DelayRLError

FORMAT = 1
DOCUMENT, WEIGHTS, GRAPH = "bundle.json", "policy.safetensors", "policy.onnx"
LIMITS = {DOCUMENT: 1 << 20, WEIGHTS: 1 << 30, GRAPH: 1 << 30}
"""No file of a bundle is larger, in bytes."""
HEADER_LIMIT = 1 << 20


def read_files(path: str | Path, wanted: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What bundle.json says; its bytes, and those of the `wanted` files that it names, whose sums are right.

    Raises:
        DelayRLError: anything missing, cut, changed, or not a regular file.
    """
    home = Path(path)
    if not home.is_dir():
        raise DelayRLError(f"{home} is not a policy bundle: it is no folder")
    document = _read(home / DOCUMENT)
    metadata = _parsed(document, home / DOCUMENT)
    files = metadata.get("files")
    if not isinstance(files, dict) or WEIGHTS not in files:
        raise DelayRLError(f"{home / DOCUMENT} is damaged: it does not name {WEIGHTS}")
    for name in files:
        if name not in (WEIGHTS, GRAPH):
            raise DelayRLError(f"{home / DOCUMENT} names a file that no bundle has: {name[:80]!r}")
    found = {DOCUMENT: document}
    for name in (name for name in wanted if name in files):
        entry = files[name]
        data = _read(home / name)
        if not isinstance(entry, dict) or (len(data), _digest(data)) != (entry.get("bytes"), entry.get("sha256")):
            raise DelayRLError(f"{home / name} is cut or changed: it is not the file that {DOCUMENT} describes")
        found[name] = data
    return metadata, found


def check_files(path: str | Path, metadata: dict[str, Any], files: Mapping[str, bytes]) -> tuple[Network, Arrays]:
    """The network and its arrays, from the bytes of a bundle's files. DelayRLError where they do not fit."""
    try:
        network = parse(metadata.get("policy"))
    except DelayRLError as error:
        raise DelayRLError(f"{Path(path) / DOCUMENT} is damaged: {error}") from error
    try:
        arrays = _arrays(files[WEIGHTS])
        network.check(arrays)
    except DelayRLError as error:
        raise DelayRLError(f"{Path(path) / WEIGHTS} cannot be used: {error}") from error
    return network, arrays


def seal(metadata: Mapping[str, Any], files: Mapping[str, bytes]) -> dict[str, bytes]:
    """All files of a bundle: these, and a bundle.json of the metadata with their sums and its own."""
    document = {"format": FORMAT, **metadata}
    document["files"] = {name: {"bytes": len(data), "sha256": _digest(data)} for name, data in files.items()}
    document["checksum"] = checksum(document)
    return {DOCUMENT: json.dumps(document, indent=1, allow_nan=False).encode() + b"\n", **files}


def checksum(document: Mapping[str, Any]) -> str:
    """SHA-256 of everything in a bundle.json but this sum; through the files' sums, of the whole bundle."""
    rest = {name: value for name, value in document.items() if name != "checksum"}
    return _digest(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode())


def check_target(out: Path, *, force: bool = False) -> None:
    """DelayRLError unless a bundle may be put there: a new or empty folder, or with `force` one with a bundle in it."""
    try:
        if not (out.exists() or out.is_symlink()):
            return
        if not out.is_dir():
            raise DelayRLError(f"{out} exists and is no folder; give another --out")
        if not any(out.iterdir()):
            return
        if not force:
            raise DelayRLError(f"{out} is not empty; give another --out, or --force to replace a bundle in it")
        if not _is_bundle(out / DOCUMENT):
            raise DelayRLError(f"{out} is not empty and holds no bundle; give another --out")
    except OSError as error:
        raise DelayRLError(f"cannot write to {out}: {error.strerror or error}") from error


def write_files(out: Path, files: Mapping[str, bytes], *, force: bool = False) -> None:
    """Put a bundle's files in place, in a folder that is new or empty; with `force` over an older bundle.

    They are written to a draft beside it first. Nothing that is not a bundle's is overwritten.

    Raises:
        DelayRLError: the folder holds something else, or the disk refuses.
    """
    check_target(out, force=force)
    try:
        home = out.resolve()  # "." has no name
        draft = home.with_name(f".{home.name}.{os.getpid()}.draft")
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        try:
            for name, data in files.items():
                with open(draft / name, "xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            home.mkdir(exist_ok=True)
            for name in (WEIGHTS, GRAPH):
                if name not in files:
                    (home / name).unlink(missing_ok=True)
            for name in sorted(files, key=lambda name: name == DOCUMENT):  # last: until then the sums do not hold
                os.replace(draft / name, home / name)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    except OSError as error:
        raise DelayRLError(f"cannot write to {out}: {error.strerror or error}") from error


def _parsed(data: bytes, file: Path) -> dict[str, Any]:
    try:
        document = json.loads(data, parse_constant=_no_number, object_pairs_hook=_no_twins)
    except (ValueError, RecursionError) as error:
        raise DelayRLError(f"{file} is damaged: it is no JSON that we write ({type(error).__name__})") from error
    if not isinstance(document, dict) or "format" not in document:
        raise DelayRLError(f"{file} is damaged, or of another program: it has no format")
    if type(document["format"]) is not int or document["format"] != FORMAT:
        raise DelayRLError(f"{file} has format {document['format']!r:.40}; this version reads {FORMAT}")
    try:
        same = document.get("checksum") == checksum(document)
    except (ValueError, RecursionError):  # e.g. half of a surrogate pair
        same = False
    if not same:
        raise DelayRLError(f"{file} was changed after it was written: its checksum is another one")
    return document


def _is_bundle(file: Path) -> bool:
    """Whether it is a bundle's document, of whatever format and with whatever sums: a damaged one may be replaced."""
    try:
        document = json.loads(_read(file))
    except (ValueError, RecursionError, DelayRLError):
        return False
    kinds = {"format": int, "policy": dict, "files": dict}
    return isinstance(document, dict) and all(isinstance(document.get(name), kind) for name, kind in kinds.items())


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not JSON")


def _no_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({name for name, _ in pairs}) != len(pairs):
        raise ValueError("a name stands twice")
    return dict(pairs)


def _read(file: Path) -> bytes:
    """A regular file's bytes: no link is followed, no device or pipe is waited for."""
    try:
        handle = os.open(file, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
        with open(handle, "rb") as stream:
            found = os.fstat(stream.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise DelayRLError(f"{file} is not a regular file")
            if found.st_size > LIMITS[file.name]:
                raise DelayRLError(f"{file} is larger than a bundle's may be ({LIMITS[file.name]:,} bytes)")
            return stream.read(LIMITS[file.name] + 1)
    except FileNotFoundError:
        if file.name == DOCUMENT:
            raise DelayRLError(f"{file.parent} is not a policy bundle: it has no {DOCUMENT}") from None
        raise DelayRLError(f"{file} is missing") from None
    except OSError as error:
        kind = "is a link; a bundle holds files only" if file.is_symlink() else f"cannot be read: {error.strerror}"
        raise DelayRLError(f"{file} {kind}") from error


def _arrays(data: bytes) -> dict[str, NDArray[Any]]:
    header = int.from_bytes(data[:8], "little")
    if len(data) < 8 or header > min(len(data) - 8, HEADER_LIMIT):
        raise DelayRLError("it is no safetensors file, or its header is too long")
    try:
        return safetensors.numpy.load(data)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, OverflowError, MemoryError) as error:
        raise DelayRLError(f"it is no safetensors file that we write ({str(error)[:80]!r})") from error


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
