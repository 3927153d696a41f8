"""Run folders: configuration, rows, metrics, checkpoints. Text is JSON, arrays are safetensors; nothing is pickled.

```
config.json         what is trained, on what, with which versions
rows.jsonl          one row for each evaluation episode
metrics.jsonl       losses and speed
episodes.jsonl      one row for each episode of training
curve.png           return against steps
delays.png          return against delay, by `evaluate --sweep`
tensorboard/        or wandb/: what `--track` wrote
checkpoints/STEP/   agent.safetensors, loop.safetensors, manifest.json (checksums); the last two are kept
replay/             the trajectory in pieces, each written once; a run with --slim deletes it when it is complete
```
"""

import contextlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError, first_line
from delayrl.run.arrays import Arrays, save_arrays
from delayrl.run.checkpoint import Checkpoint, checkpoint_folders, read_checkpoint
from delayrl.run.disk import disk_errors, draft, lock, parsed, passes, remove, write_file, write_flushed
from delayrl.run.rows import check_rows

FORMAT = 1
NAMES = {"agent": str, "preset": str, "env": str, "delay": int | str}
CONFIG: dict[str, Any] = {"format": int, **NAMES, "hyperparameters": dict, "schedule": dict}
"""What a configuration must hold, with its types."""
MORE: dict[str, Any] = {"versions": dict, "later_versions": list, "configuration": str, "origin": dict, "unnamed": dict}
MORE |= {"seed": int, "protocol": str, "hyperparameters": dict, "schedule": dict}
"""What any configuration that is read may hold, a collected one too."""
FOLDERS = ("checkpoints", "replay", "tensorboard", "wandb")
LINES = ("rows", "metrics", "episodes")
FILES = (*(f"{name}.jsonl" for name in LINES), "curve.png", "delays.png", "config.json")
RunLike = str | PathLike[str]
"""A run, or the path of its folder."""


@dataclass(frozen=True)
class RunFolder:
    """A run folder, or what will be one: what is written to it, and what is read back."""

    path: Path

    @property
    def exists(self) -> bool:
        """Whether a run has begun here."""
        return (self.path / "config.json").is_file()

    @property
    def is_free(self) -> bool:
        """Whether a new run may begin here: there is no folder, or an empty one (drafts of a crash aside)."""
        if not self.path.exists():
            return True
        return self.path.is_dir() and all(file.name.endswith(".draft") for file in self.path.iterdir())

    @property
    def config(self) -> dict[str, Any]:
        """What was trained. Raises DelayRLError if the folder is no run."""
        file = self.path / "config.json"
        self.check_exists()
        try:
            config = parsed(_text(file))
        except ValueError as error:
            raise DelayRLError(f"{file} is damaged: {first_line(error)}") from error
        _check_config(config, file)
        return config

    def check_exists(self) -> None:
        """Raise DelayRLError if no run has begun here. The message says what it is instead."""
        if not self.exists:
            below = ", ".join(map(str, _below(self.path)))
            hint = f"; its runs are {below}" if below else ""
            if (self.path / "bundle.json").exists():
                hint = "; it is a bundle, for `load_bundle` or `delayrl latency`"
            elif not below and self.path.is_dir():
                hint = f"; `delayrl runs {self.path}` lists the runs below it"
            raise DelayRLError(f"{self.path} is not a run folder: it has no config.json{hint}")

    def create(self, config: Mapping[str, Any]) -> None:
        """Make the folder and write its configuration."""
        with disk_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            write_file(self.path / "config.json", json.dumps({"format": FORMAT, **config}, indent=1).encode())

    def remove(self) -> None:
        """Delete what a run puts into its folder, and nothing else."""
        with disk_errors(self.path):
            for name in FOLDERS + FILES:
                remove(self.path / name)

    def append(self, name: str, rows: list[dict[str, Any]]) -> None:
        """Add lines to one of the files LINES."""
        with disk_errors(self.path), open(self.path / f"{name}.jsonl", "a") as file:
            file.write(_lines(rows))
            file.flush()
            os.fsync(file.fileno())

    def read(self, name: str) -> list[dict[str, Any]]:
        """Return the lines of one of the files LINES, without a last line that a crash cut off."""
        file = self.path / f"{name}.jsonl"
        try:
            lines = _text(file).splitlines(keepends=True) if file.is_file() else []
            rows = [parsed(line) for line in lines if line.endswith("\n")]
        except ValueError as error:
            raise DelayRLError(f"{file} is damaged: {error}") from error
        if name == "rows":
            check_rows(rows, file)
        elif wrong := [row for row in rows if type(row.get("step")) is not int]:
            raise DelayRLError(f"{file} is damaged: a line has no step: {str(wrong[0])[:200]}")
        return rows

    def extend(self, config: Mapping[str, Any]) -> None:
        """Replace the configuration by one of a longer run, and its hash in all rows."""
        rows = [row | {"configuration": config["configuration"]} for row in self.read("rows")]
        with disk_errors(self.path):
            write_file(self.path / "rows.jsonl", _lines(rows).encode())
        self.create(config)

    def rewind(self, step: int) -> None:
        """Delete rows and checkpoints of later steps than `step`: the resumed run makes them again."""
        with disk_errors(self.path):
            for name in LINES:
                if (self.path / f"{name}.jsonl").is_file():
                    kept = [row for row in self.read(name) if row["step"] <= step]
                    write_file(self.path / f"{name}.jsonl", _lines(kept).encode())
            for later in checkpoint_folders(self.path):
                if int(later.name) > step:
                    shutil.rmtree(_set_aside(later))

    def checkpoints(self) -> tuple[list[Checkpoint], list[str]]:
        """Return the checkpoints from which training can resume, newest first, and one line for each broken one.

        One of a complete run needs no replay for that.
        """
        found = list(self._checked(replay=True))
        lines = [f"{line}; it is left out" for line in found if isinstance(line, str)]
        return [checkpoint for checkpoint in found if isinstance(checkpoint, Checkpoint)], lines

    def latest(self) -> Checkpoint:
        """Return the newest checkpoint whose networks are intact. Raises DelayRLError if there is none."""
        broken = []
        for found in self._checked(replay=False):
            if isinstance(found, Checkpoint):
                return found
            broken.append(found)
        raise DelayRLError(broken[0] if broken else f"{self.path} has no checkpoint yet")

    def _checked(self, *, replay: bool) -> Iterator[Checkpoint | str]:
        """Yield the checkpoints, newest first, a line for a broken one; with the replay of unfinished ones or not."""
        for path in checkpoint_folders(self.path):
            found: Checkpoint | str
            try:
                found = read_checkpoint(path)
                found.check(replay=replay and not found.complete)
            except (OSError, DelayRLError) as error:
                if passes(error):  # it may be whole
                    raise DelayRLError(f"checkpoint {path} cannot be read now: {error}") from (error.__cause__ or error)
                found = f"checkpoint {path} is broken ({error})"
            yield found

    def save(
        self, step: int, agent: Arrays, loop: Arrays | None, pieces: dict[str, str], *, complete: bool = False
    ) -> None:
        """Write a checkpoint, and delete all but the one before it. `loop` is what a resumed run needs besides."""
        final = self.path / "checkpoints" / f"{step:012d}"
        with disk_errors(self.path):
            final.parent.mkdir(parents=True, exist_ok=True)
            with draft(final) as folder:
                folder.mkdir()
                files = {"agent.safetensors": save_arrays(folder / "agent.safetensors", agent)}
                if loop is not None:
                    files["loop.safetensors"] = save_arrays(folder / "loop.safetensors", loop)
                manifest = {"step": step, "complete": complete, "files": files, "pieces": pieces}
                write_flushed(folder / "manifest.json", json.dumps(manifest).encode())
                if final.exists():  # only now is there another for this step
                    _set_aside(final)
            shutil.rmtree(final.with_name(".gone"), ignore_errors=True)
        self._drop_checkpoints(2)

    def finish(self, *, slim: bool) -> None:
        """Delete the older checkpoint and, of a `slim` run, what training further takes: the replay."""
        self._drop_checkpoints(1)
        if slim:
            shutil.rmtree(self.path / "replay", ignore_errors=True)
        else:
            self.drop_pieces()

    def save_piece(self, name: str, arrays: Arrays) -> str:
        """Write one piece of the replay. Returns its checksum."""
        with disk_errors(self.path):
            (self.path / "replay").mkdir(exist_ok=True)
            with draft(self.path / "replay" / name) as file:
                return save_arrays(file, arrays)

    def drop_pieces(self) -> None:
        """Delete the pieces of the replay that no checkpoint needs any more."""
        needed: set[str] = set()
        for path in checkpoint_folders(self.path):
            with contextlib.suppress(DelayRLError):
                needed |= read_checkpoint(path).pieces.keys()
        for file in (self.path / "replay").glob("*.safetensors*"):  # with drafts of a process that was killed
            if file.name not in needed and file.is_file():
                file.unlink(missing_ok=True)

    def _drop_checkpoints(self, kept: int) -> None:
        abandoned = (self.path / "checkpoints").glob(".*draft")  # by a process that was killed
        for old in [*checkpoint_folders(self.path)[kept:], *abandoned]:
            shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def hold(path: Path) -> Iterator[None]:
    """Keep a run folder for this process until the block ends. Raises DelayRLError if another process trains it."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    with disk_errors(path), contextlib.suppress(FileExistsError):  # a file: it is refused later
        path.mkdir(parents=True, exist_ok=True)
    try:
        with lock(path) as free:
            if not free:
                raise DelayRLError(f"{path} is being trained by another process")
            yield
    finally:
        for folder in made:  # what was refused leaves nothing
            with contextlib.suppress(OSError):
                folder.rmdir()


def _lines(rows: Iterable[Mapping[str, Any]]) -> str:
    """Write rows as JSON, one a line."""
    return "".join(json.dumps(row) + "\n" for row in rows)


def path_of(run: RunLike) -> Path:
    """Return the path of a run's folder. Raises DelayRLError for what is none, such as the list of several runs."""
    if isinstance(run, str | PathLike):
        return Path(run)
    what = "this is a list of runs" if isinstance(run, list | tuple) else f"got {run!r}"
    raise DelayRLError(f"give one run, or the path of its folder; {what}")


def seed_folders(run: RunLike) -> list[RunFolder]:
    """Return the run in a folder, or those of several seeds below it, as `train(seeds=…)` makes them."""
    one = RunFolder(path_of(run))
    return [one] if one.exists else [RunFolder(path) for path in _below(one.path)] or [one]


def _below(path: Path) -> list[Path]:
    """Return the run folders of several seeds, by their seeds."""
    folders = [file.parent for file in path.glob("seed*/config.json") if file.parent.name[4:].isdigit()]
    return sorted(folders, key=lambda folder: (len(folder.name), folder.name))


def versions_in(config: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the versions, commits and hardware that a run was trained with: one, and those that it went on with."""
    return [used for used in (config.get("versions"), *config.get("later_versions", [])) if used]


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError as error:
        raise DelayRLError(f"{file} cannot be read: {error.strerror}") from error


def _check_config(config: Mapping[str, Any], file: Path) -> None:
    for name, kind in CONFIG.items():
        if not isinstance(config.get(name), kind):
            raise DelayRLError(f"{file} is damaged, or of another program: no {name}")
    if config["format"] != FORMAT:
        raise DelayRLError(f"{file} has format {config['format']}; this version reads {FORMAT}")
    check_more(config, file)


def check_more(config: Mapping[str, Any], where: object) -> None:
    """Raise DelayRLError, naming `where`, if what a configuration holds besides is of another type."""
    for name, kind in MORE.items():
        value = config.get(name, kind())
        if not isinstance(value, kind) or (kind is list and not all(isinstance(part, dict) for part in value)):
            raise DelayRLError(f"{where} is damaged: no good {name}: {value!r:.60}")
    if type(config.get("schedule", {"steps": 0}).get("steps")) is not int:
        raise DelayRLError(f"{where} is damaged: its schedule has no steps")
    if not isinstance(source := config.get("origin", {}).get("from", {}), dict):
        raise DelayRLError(f"{where} is damaged: no good origin: {source!r:.60}")


def is_config(file: Path) -> bool:
    """Whether a file is the configuration of a run, of any version: damaged, it stands beside a run's rows."""
    try:
        whole = file.is_file() and CONFIG.keys() <= parsed(file.read_text()).keys()
    except (ValueError, OSError):
        whole = False
    return whole or (file.parent / "rows.jsonl").exists()


def _set_aside(path: Path) -> Path:
    """Rename a checkpoint that is to be deleted: a crash leaves no half of it under its name. Returns the new path."""
    gone = path.with_name(".gone")
    shutil.rmtree(gone, ignore_errors=True)  # of a killed process
    return path.rename(gone)
