"""Run folders: configuration, rows, metrics, checkpoints. Text is JSON, arrays are safetensors; nothing is pickled.

```
config.json     what is trained, on what, with which versions
rows.jsonl      one row for each evaluation episode
metrics.jsonl   losses and speed
curve.png       return against steps
checkpoints/STEP/   agent.safetensors, loop.safetensors, manifest.json (checksums); the last two are kept
replay/         the trajectory in pieces, each written once; gone when the run is complete
```
"""

import contextlib
import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from delayrl.errors import DelayRLError

FORMAT = 1
CONFIG = {"agent": str, "preset": str, "env": str, "delay": int | str, "hyperparameters": dict, "schedule": dict}
"""What a configuration must hold, and of which type."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint whose checksums hold."""

    path: Path
    step: int
    complete: bool
    pieces: dict[str, str]

    def arrays(self, name: str) -> Arrays:
        """One of its files."""
        return load_arrays(self.path / f"{name}.safetensors")


@dataclass(frozen=True)
class Run:
    """A run folder."""

    path: Path

    @property
    def config(self) -> dict[str, Any]:
        """What was trained. Raises DelayRLError where the folder is no run."""
        file = self.path / "config.json"
        if not file.is_file():
            raise DelayRLError(f"{self.path} is not a run folder: it has no config.json")
        try:
            config = json.loads(file.read_text())
        except (ValueError, OSError) as error:
            raise DelayRLError(f"{file} is damaged: {type(error).__name__}") from error
        for name, kind in {"format": int, **CONFIG}.items():
            if not isinstance(config, dict) or not isinstance(config.get(name), kind):
                raise DelayRLError(f"{file} is damaged, or of another program: no {name}")
        if config["format"] != FORMAT:
            raise DelayRLError(f"{file} has format {config['format']}; this version reads {FORMAT}")
        return config  # type: ignore[no-any-return]

    def create(self, config: Mapping[str, Any]) -> None:
        """Make the folder and write its configuration."""
        with _disk(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            _write(self.path / "config.json", json.dumps({"format": FORMAT, **config}, indent=1).encode())

    def remove(self) -> None:
        """Delete what a run put there, and nothing else."""
        with _disk(self.path):
            for name in ("checkpoints", "replay", "tensorboard", "wandb"):
                if (self.path / name).exists():
                    shutil.rmtree(self.path / name)
            for name in ("rows.jsonl", "metrics.jsonl", "curve.png", "delays.png", "config.json"):
                (self.path / name).unlink(missing_ok=True)

    def is_free(self) -> bool:
        """Whether a new run may begin here: no folder yet, or an empty one (drafts of a crash aside)."""
        return not self.path.exists() or (
            self.path.is_dir() and all(file.name.endswith(".draft") for file in self.path.iterdir())
        )

    def append(self, name: str, rows: list[dict[str, Any]]) -> None:
        """Add lines to rows.jsonl or metrics.jsonl."""
        with _disk(self.path), open(self.path / f"{name}.jsonl", "a") as file:
            file.write("".join(json.dumps(row) + "\n" for row in rows))
            file.flush()
            os.fsync(file.fileno())

    def read(self, name: str) -> list[dict[str, Any]]:
        """The lines of rows.jsonl or metrics.jsonl; a last line that a crash cut off is left out."""
        file = self.path / f"{name}.jsonl"
        try:
            lines = file.read_text().splitlines(keepends=True) if file.is_file() else []
            return [json.loads(line) for line in lines if line.endswith("\n")]
        except (ValueError, RecursionError) as error:
            raise DelayRLError(f"{file} is damaged: {error}") from error

    def rewind(self, step: int) -> None:
        """Forget rows and checkpoints after the step that a run is resumed from: they will be made again."""
        with _disk(self.path):
            for name in ("rows", "metrics"):
                if (self.path / f"{name}.jsonl").is_file():
                    kept = [row for row in self.read(name) if row["step"] <= step]
                    _write(self.path / f"{name}.jsonl", "".join(json.dumps(row) + "\n" for row in kept).encode())
            for later in (self.path / "checkpoints").glob("[0-9]*"):
                if int(later.name) > step:
                    _forget(later)

    def checkpoints(self) -> tuple[list[Checkpoint], list[str]]:
        """The good checkpoints, newest first, and one line for each broken one."""
        good, broken = [], []
        for path in sorted((self.path / "checkpoints").glob("[0-9]*"), reverse=True):
            try:
                manifest = json.loads((path / "manifest.json").read_text())
                if manifest["step"] != int(path.name) or "agent.safetensors" not in manifest["files"]:
                    raise DelayRLError("its manifest is damaged")
                if not manifest["complete"] and "loop.safetensors" not in manifest["files"]:
                    raise DelayRLError("its manifest is damaged")
                for file, digest in (manifest["files"] | manifest["pieces"]).items():
                    home = self.path / "replay" if file in manifest["pieces"] else path
                    if Path(file).name != file or _digest(home / file) != digest:
                        raise DelayRLError(f"{file} is cut or changed")
                good.append(Checkpoint(path, int(path.name), bool(manifest["complete"]), manifest["pieces"]))
            except (OSError, ValueError, KeyError, TypeError, AttributeError, DelayRLError) as error:
                broken.append(f"checkpoint {path} is broken ({error}); it is left out")
        return good, broken

    def latest(self) -> Checkpoint:
        """The newest good checkpoint; DelayRLError where there is none."""
        good, broken = self.checkpoints()
        if not good:
            raise DelayRLError(broken[0] if broken else f"{self.path} has no checkpoint yet")
        return good[0]

    def save(
        self, step: int, agent: Arrays, loop: Arrays | None, pieces: dict[str, str], *, complete: bool = False
    ) -> None:
        """Write a checkpoint beside the older ones, put it in place at once, and keep the one before it."""
        home = self.path / "checkpoints"
        draft, final = home / ".draft", home / f"{step:012d}"
        with _disk(self.path):
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir(parents=True)
            files = {"agent.safetensors": agent} | ({"loop.safetensors": loop} if loop is not None else {})
            digests = {name: save_arrays(draft / name, arrays) for name, arrays in files.items()}
            manifest = {"step": step, "complete": complete, "files": digests, "pieces": pieces}
            _write(draft / "manifest.json", json.dumps(manifest).encode())
            if final.exists():
                _forget(final)
            draft.rename(final)
        for old in sorted(home.glob("[0-9]*"))[:-2]:
            shutil.rmtree(old, ignore_errors=True)

    def finish(self) -> None:
        """Delete what only a run that goes on needs: the older checkpoint and the replay."""
        for old in sorted((self.path / "checkpoints").glob("[0-9]*"))[:-1]:
            shutil.rmtree(old, ignore_errors=True)
        shutil.rmtree(self.path / "replay", ignore_errors=True)

    def save_piece(self, name: str, arrays: Arrays) -> str:
        """Write one piece of the replay; returns its checksum."""
        with _disk(self.path):
            (self.path / "replay").mkdir(exist_ok=True)
            draft = self.path / "replay" / ".draft"
            digest = save_arrays(draft, arrays)
            draft.rename(self.path / "replay" / name)
        return digest

    def drop_pieces(self) -> None:
        """Delete the pieces that no checkpoint names any more."""
        named: set[str] = set()
        for manifest in (self.path / "checkpoints").glob("[0-9]*/manifest.json"):
            with contextlib.suppress(ValueError, KeyError):
                named |= set(json.loads(manifest.read_text())["pieces"])
        for file in (self.path / "replay").glob("*"):
            if file.name not in named:
                file.unlink(missing_ok=True)


def save_arrays(path: Path, arrays: Arrays) -> str:
    """Write arrays as safetensors, flushed to the disk; returns the file's checksum."""
    data = safetensors.numpy.save({name: np.array(array, order="C") for name, array in arrays.items()})
    _write(path, data, rename=False)
    return hashlib.sha256(data).hexdigest()


def load_arrays(path: Path) -> Arrays:
    """Read safetensors; DelayRLError where the file is cut or something else."""
    try:
        return safetensors.numpy.load_file(path)
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        raise DelayRLError(f"{path} cannot be read: {str(error).splitlines()[0]}") from error


def flatten_tree(tree: Any) -> Arrays:
    """A tree of arrays as names and arrays."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in leaves}


def restore_tree(template: Any, arrays: Arrays, where: Path) -> Any:
    """The tree of the template's form with the stored values; DelayRLError where they belong to another agent."""
    leaves, form = jax.tree_util.tree_flatten_with_path(template)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    for name in sorted(named.keys() ^ arrays.keys()):
        state = "lacks" if name in named else "has"
        raise DelayRLError(f"{where} belongs to another agent or configuration: it {state} {name}")
    for name, leaf in named.items():
        if tuple(leaf.shape) != arrays[name].shape or np.dtype(leaf.dtype) != arrays[name].dtype:
            raise DelayRLError(
                f"{where} belongs to another agent or configuration: {name} is {arrays[name].dtype}"
                f"{list(arrays[name].shape)}, expected {leaf.dtype}{list(leaf.shape)}"
            )
    return jax.tree_util.tree_unflatten(form, [arrays[name] for name in named])


def _forget(checkpoint: Path) -> None:
    """Delete a checkpoint at once: a crash in the middle leaves no half of it under its name."""
    gone = checkpoint.with_name(".gone")
    shutil.rmtree(gone, ignore_errors=True)
    checkpoint.rename(gone)
    shutil.rmtree(gone)


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write(path: Path, data: bytes, *, rename: bool = True) -> None:
    """Write and flush; through a draft that takes the file's place at once, unless the caller renames."""
    target = path.with_name(path.name + ".draft") if rename else path
    try:
        with open(target, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        target.unlink(missing_ok=True)
        raise
    if rename:
        target.rename(path)


@contextlib.contextmanager
def _disk(path: Path) -> Iterator[None]:
    """What the disk refuses, in one line."""
    try:
        yield
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        raise DelayRLError(f"cannot write to {path}: {reason}; what was stored before is kept") from error
