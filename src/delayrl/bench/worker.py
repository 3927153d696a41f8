"""Train one cell in a process of its own: `python -m delayrl.bench.worker FOLDER [--device DEVICE] [--core N]`.

The worker locks the cell, trains it, and prints how that ended as one line of JSON. It stops at a checkpoint on
SIGTERM, or when the process that started it is gone: its stdin is a pipe, which closes then.
"""

import argparse
import contextlib
import json
import os
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import Any, Literal, NamedTuple

from delayrl.bench.folders import LockedError, hold_cell, journal, note, seed_paths, stored
from delayrl.errors import DelayRLError, StoppedError, described
from delayrl.run.disk import passes
from delayrl.run.rows import CONDITION

Kind = Literal["done", "stopped", "failed", "died", "locked"]


class Outcome(NamedTuple):
    """How one try of a cell ended, with the first line of its message."""

    kind: Kind
    line: str


def main() -> None:
    """Work on the cell whose folder the command line names."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--device")
    parser.add_argument("--core", type=int)
    given = parser.parse_args()
    if given.core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {given.core})  # before JAX counts the cores and starts as many threads
    answer = os.fdopen(os.dup(1), "w")  # libraries may print to stdout: that goes to stderr
    os.dup2(2, 1)
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    outcome = work(given.folder, given.device)
    print(json.dumps(outcome), file=answer, flush=True)


def work(folder: Path, device: str | None = None) -> Outcome:
    """Lock a cell, then train or resume it. Its folder has its cell.json; the device is "cpu", "gpu" or JAX's own."""
    try:
        with hold_cell(folder):
            return _train(folder, json.loads((folder / "cell.json").read_text()), device)
    except LockedError:
        return Outcome("locked", "another process works on it")
    except DelayRLError as error:
        _log(str(error))
        return Outcome("died" if passes(error) else "failed", str(error))
    except Exception as error:
        _log(traceback.format_exc())
        # another try may find more memory or a disk that answers; JAX's errors are RuntimeErrors. A mistake stays
        again = isinstance(error, OSError | MemoryError | RuntimeError)
        return Outcome("died" if again else "failed", described(error))


def _train(folder: Path, cell: dict[str, Any], device: str | None) -> Outcome:
    seeds = tuple(cell["seeds"])
    step, complete = stored(folder, seeds)
    if complete:
        events = journal(folder)
        if not events or events[-1]["event"] != "done":
            note(folder, "done")  # the worker that finished it was killed before it noted that
        return Outcome("done", "")
    from delayrl.training.train import train  # it sets JAX up: nothing here may start it before

    try:
        note(folder, "begun", pid=os.getpid(), step=step)
        condition = {name: cell[name] for name in CONDITION} | cell["overrides"]
        out = folder if len(seeds) > 1 else seed_paths(folder, seeds)[0]
        train(**condition, seed=seeds[0], seeds=len(seeds), out=out, device=device, progress=False, slim=True)
        note(folder, "done")
        return Outcome("done", "")
    except StoppedError as error:
        note(folder, "stopped", step=stored(folder, seeds)[0])
        return Outcome("stopped", str(error))


def _log(text: str) -> None:
    with contextlib.suppress(OSError):  # the disk may be full
        print(text, file=sys.stderr, flush=True)


def _stop_with_parent() -> None:
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
