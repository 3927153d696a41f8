"""Checkpoints of a run folder: their manifests, and whether their files are intact. No JAX.

`checkpoints/STEP/manifest.json` holds the step, whether the run is complete, and the SHA-256 of each file of the
checkpoint and of each piece of the replay that it needs.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from delayrl.errors import DelayRLError
from delayrl.run.arrays import Arrays, load_arrays
from delayrl.run.disk import parsed


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint, as its manifest describes it."""

    path: Path
    step: int
    complete: bool  # whether it is the last of a finished run
    files: dict[str, str]  # checksums of its own files
    pieces: dict[str, str]  # checksums of the files in replay/ that it needs

    @property
    def can_go_on(self) -> bool:
        """Whether it holds what training further takes, besides the networks."""
        return "loop.safetensors" in self.files

    def arrays(self, name: str) -> Arrays:
        """Read one of its files: "agent" or "loop"."""
        return load_arrays(self.path / f"{name}.safetensors")

    def check(self, *, replay: bool) -> None:
        """Raise DelayRLError if a file is cut or changed: its own, which play needs, or those of its replay too."""
        folder = self.path.parents[1] / "replay"
        pieces = self.pieces if replay else {}
        for name, checksum in (self.files | pieces).items():
            file = (folder if name in pieces else self.path) / name
            named = Path(name).name == name and "\0" not in name
            if named and not file.exists():
                raise DelayRLError(f"{name} is missing")
            if not named or _checksum(file) != checksum:
                raise DelayRLError(f"{name} is cut or changed")


def checkpoint_folders(run: Path) -> list[Path]:
    """Return the folders of a run's checkpoints, newest first. Raises DelayRLError if they cannot be listed."""
    folder = run / "checkpoints"
    try:
        found = list(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:  # which `glob` would hide
        raise DelayRLError(f"{folder} cannot be read: {error.strerror}") from error
    numbered = [path for path in found if path.name.isascii() and path.name.isdecimal() and path.is_dir()]
    return sorted(numbered, reverse=True)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint's manifest. Raises DelayRLError if it is missing or damaged."""
    try:
        manifest = parsed((path / "manifest.json").read_text())
        step, complete = int(path.name), bool(manifest["complete"])
        files, pieces = dict(manifest["files"]), dict(manifest["pieces"])
        needed = {"agent.safetensors"} if complete else {"agent.safetensors", "loop.safetensors"}
        if manifest["step"] != step or not needed <= files.keys():
            raise ValueError
    except OSError as error:
        raise DelayRLError(str(error)) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DelayRLError("its manifest is damaged") from error
    return Checkpoint(path, step, complete, files, pieces)


def _checksum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
