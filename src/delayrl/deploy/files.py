"""The files of a policy bundle: the weights, and how to use them. They are read as data; none is run.

```
bundle.json          network, task, delay, evaluation; sizes and SHA-256 of the files below; its own checksum
policy.safetensors   the weights
policy.onnx          the same policy as a graph, for other runtimes (optional); we never run it
```

A bundle may come from anybody. Only these names are read, and only as regular files. Nothing is used before its size
and checksum are verified and every array has the shape that the description demands.
"""

import json
import os
import stat
import tempfile
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Arrays, Network, parse
from delayrl.errors import DelayRLError
from delayrl.run.disk import disk_errors, parsed, write_flushed

FORMAT = 1
DOCUMENT, WEIGHTS, GRAPH = "bundle.json", "policy.safetensors", "policy.onnx"
LIMITS = {DOCUMENT: 1 << 20, WEIGHTS: 1 << 30, GRAPH: 1 << 30}
"""The largest size of each file, in bytes."""
HEADER_LIMIT = 1 << 20


def read_files(path: str | Path, wanted: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Read bundle.json and those `wanted` files that it lists; return its content, and the bytes of all files by name.

    Raises DelayRLError for anything missing, cut, changed, or not a regular file.
    """
    home = Path(path)
    if not home.is_dir():
        raise DelayRLError(f"{home} is not a policy bundle: it is not a folder")
    if not (home / DOCUMENT).exists() and (home / "config.json").exists():
        raise DelayRLError(f"{home} is a run, and no policy bundle: `delayrl export {home} --out DIR` makes one of it")
    document = _read(home / DOCUMENT)
    metadata = _parsed(document, home / DOCUMENT)
    files = metadata.get("files")
    if not isinstance(files, dict) or WEIGHTS not in files:
        raise DelayRLError(f"{home / DOCUMENT} is damaged: it does not name {WEIGHTS}")
    for name in files:
        if name not in (WEIGHTS, GRAPH):
            raise DelayRLError(f"{home / DOCUMENT} names a file that no bundle has: {name[:80]!r}")
    contents = {DOCUMENT: document}
    for name in (name for name in wanted if name in files):
        entry, data = files[name], _read(home / name)
        actual = len(data), sha256(data).hexdigest()
        if not isinstance(entry, dict) or actual != (entry.get("bytes"), entry.get("sha256")):
            raise DelayRLError(f"{home / name} is cut or changed: it is not the file that {DOCUMENT} describes")
        contents[name] = data
    return metadata, contents


def check_files(path: str | Path, metadata: dict[str, Any], files: Mapping[str, bytes]) -> tuple[Network, Arrays]:
    """Return the network in a bundle's files, and its arrays. Raises DelayRLError if they do not fit."""
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
    """Return the files with a bundle.json added: the metadata, their sizes and checksums, and its own checksum.

    Raises DelayRLError if a file is larger than `read_files` reads.
    """
    document = {"format": FORMAT, **metadata}
    document["files"] = {name: {"bytes": len(data), "sha256": sha256(data).hexdigest()} for name, data in files.items()}
    document["checksum"] = checksum(document)
    content = {DOCUMENT: json.dumps(document, indent=1, allow_nan=False).encode() + b"\n", **files}
    for name, data in content.items():
        if len(data) > LIMITS[name]:
            allowed = f"a bundle allows {LIMITS[name]:,}: use fewer observations or smaller networks"
            raise DelayRLError(f"{name} would have {len(data):,} bytes, {allowed}")
    return content


def checksum(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a bundle.json without its checksum. It covers the other files through theirs."""
    rest = {name: value for name, value in document.items() if name != "checksum"}
    return sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def check_target(out: Path, *, force: bool = False) -> None:
    """Raise DelayRLError unless `out` is new, an empty folder, or (with `force`) a folder with a bundle."""
    with disk_errors(out):
        if not out.is_dir() and (out.exists() or out.is_symlink()):
            raise DelayRLError(f"{out} exists and is not a folder; give another --out")
        if not out.is_dir() or not any(out.iterdir()):
            return
        if not force:
            raise DelayRLError(f"{out} is not empty; give another --out, or --force to replace a bundle in it")
        if not _is_bundle(out / DOCUMENT):
            raise DelayRLError(f"{out} is not empty and holds no bundle; give another --out")


def write_files(out: Path, files: Mapping[str, bytes], *, force: bool = False) -> None:
    """Write a bundle into a new or empty folder, or with `force` over an older bundle.

    All files are written beside the folder first and then moved into it. Other files in it are kept. Raises
    DelayRLError if the folder holds something else, or the disk refuses.
    """
    check_target(out, force=force)
    with disk_errors(out):
        home = out.resolve()  # "." has no name
        home.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{home.name}-", suffix=".draft", dir=home.parent) as drafts:
            for name, data in files.items():
                write_flushed(Path(drafts, name), data)
            home.mkdir(exist_ok=True)
            for name in {WEIGHTS, GRAPH} - files.keys():
                (home / name).unlink(missing_ok=True)
            for name in sorted(files, key=lambda name: name == DOCUMENT):  # last, because it has the checksums
                Path(drafts, name).replace(home / name)


def _parsed(data: bytes, file: Path) -> dict[str, Any]:
    try:
        document = json.loads(data, parse_constant=_no_constant, object_pairs_hook=_no_duplicates)
    except (ValueError, RecursionError) as error:
        raise DelayRLError(f"{file} is damaged: it is not JSON that we write ({type(error).__name__})") from error
    if not isinstance(document, dict) or "format" not in document:
        raise DelayRLError(f"{file} is damaged or belongs to another program: it has no format")
    if type(document["format"]) is not int or document["format"] != FORMAT:
        raise DelayRLError(f"{file} has format {document['format']!r:.40}; this version reads {FORMAT}")
    try:
        same = document.get("checksum") == checksum(document)
    except (ValueError, RecursionError):  # e.g. half of a surrogate pair
        same = False
    if not same:
        raise DelayRLError(f"{file} was changed after it was written: its checksum does not match")
    return document


def _is_bundle(file: Path) -> bool:
    """Whether it is the bundle.json of a bundle, in any format and even if damaged: such a bundle may be replaced."""
    try:
        document = parsed(_read(file))
    except (ValueError, DelayRLError):
        return False
    kinds = {"format": int, "policy": dict, "files": dict}
    return all(isinstance(document.get(name), kind) for name, kind in kinds.items())


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is not JSON")


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({name for name, _ in pairs}) != len(pairs):
        raise ValueError("a name occurs twice")
    return dict(pairs)


def _read(file: Path) -> bytes:
    """Read a regular file. Links are not followed, and devices and pipes do not block."""
    try:
        handle = os.open(file, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
        with open(handle, "rb") as stream:
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise DelayRLError(f"{file} is not a regular file")
            if status.st_size > LIMITS[file.name]:
                raise DelayRLError(f"{file} is larger than a bundle allows ({LIMITS[file.name]:,} bytes)")
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
        raise DelayRLError("it is not a safetensors file, or its header is too long")
    try:
        return safetensors.numpy.load(data)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, OverflowError, MemoryError) as error:
        raise DelayRLError(f"it is not a safetensors file that we write ({str(error)[:80]!r})") from error
