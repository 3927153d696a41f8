"""One cell in a process of its own: `python -m delayrl.bench.worker FOLDER [DEVICE]`.

It holds the cell's lock, trains, and says on stdout in one line of JSON how that went. It stops at a checkpoint when
it is sent SIGTERM, and when whoever started it is gone: its stdin is a pipe that closes then.
"""

import contextlib
import json
import os
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import Literal, NamedTuple

from delayrl.bench.folders import LockedError, hold, journal, note, seed_folders, stored
from delayrl.errors import DelayRLError, StoppedError

Kind = Literal["done", "stopped", "failed", "died", "locked"]


class Outcome(NamedTuple):
    """How one try of a cell ended, and the first line of what it said."""

    kind: Kind
    line: str


def main() -> None:
    """Work on the cell whose folder is given."""
    answer = os.fdopen(os.dup(1), "w")  # libraries may print; the answer stands alone
    os.dup2(2, 1)
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    outcome = work(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None)
    print(json.dumps(outcome), file=answer, flush=True)


def work(folder: Path, device: str | None = None) -> Outcome:
    """Hold the cell and train it, or go on with it."""
    try:
        with hold(folder):
            cell = json.loads((folder / "cell.json").read_text())
            seeds = tuple(cell["seeds"])
            step, complete = stored(folder, seeds)
            if complete:
                if not any(event["event"] == "done" for event in journal(folder)[-1:]):
                    note(folder, "done")  # its worker was killed before it could say so
                return Outcome("done", "")
            from delayrl.run.provenance import versions
            from delayrl.training.train import train

            try:
                note(folder, "begun", pid=os.getpid(), step=step, versions=versions())
                out = folder if len(seeds) > 1 else seed_folders(folder, seeds)[0]
                train(
                    cell["agent"],
                    cell["env"],
                    cell["delay"],
                    preset=cell["preset"],
                    protocol=cell["protocol"],
                    seed=seeds[0],
                    seeds=len(seeds),
                    out=out,
                    device=device,
                    progress=False,
                    **cell["overrides"],
                )
                note(folder, "done")
                return Outcome("done", "")
            except StoppedError as error:
                note(folder, "stopped", step=stored(folder, seeds)[0])
                return Outcome("stopped", str(error))
            except DelayRLError as error:  # trying again would end in the same way
                _log(str(error))
                return Outcome("failed", str(error))
    except LockedError:
        return Outcome("locked", "another process works on it")
    except DelayRLError as error:
        return Outcome("failed", str(error))
    except Exception as error:
        _log(traceback.format_exc())
        words = str(error).strip().splitlines()
        return Outcome("died", f"{type(error).__name__}: {words[0] if words else ''}".rstrip(": "))


def _log(text: str) -> None:
    with contextlib.suppress(OSError):  # the disk may be full
        print(text, file=sys.stderr, flush=True)


def _stop_with_parent() -> None:
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
