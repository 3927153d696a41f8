"""What the scripts beside this one share: they type what a user types, and say what must come back.

Each attempt is printed before it is made. One that gives something else ends the script with what it gave.
"""

import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

SHORT = "--preset small --steps 150 --random-steps 50 --evaluate-every 50 --evaluation-episodes 2 --quiet"
SMALL = {"steps": 300, "random_steps": 100, "evaluate_every": 100, "evaluation_episodes": 2, "batch_size": 8}
TINY: dict[str, Any] = {"preset": "small", "hidden": [8, 8], "progress": False, **SMALL}
"""Options of `delayrl.train` for a run that learns in seconds."""


def point(number: int, title: str) -> None:
    """Print which point of the list the next attempts belong to."""
    print(f"\n-- {number}. {title}", flush=True)


def typed(line: str, *says: str) -> str:
    """Run a command line, which must succeed and write `says`; return what it wrote."""
    status, text = _run(line)
    expect(status == 0 and all(words in text for words in says), f"it wrote (status {status}):\n{text}\nnot {says}")
    return text


def refused(line: str, *says: str) -> None:
    """Run a command line, which must fail with one line that says why."""
    status, text = _run(line)
    one_line = status == 2 and text.count("\n") == 1
    expect(one_line and all(words in text for words in says), f"it wrote (status {status}):\n{text}\nnot {says}")
    print(f"    {text.strip()}", flush=True)


def ran(code: str) -> str:
    """Run Python code in a process of its own, which must succeed; return what it printed."""
    print("python:", "; ".join(code.strip().splitlines()), flush=True)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    expect(done.returncode == 0, done.stderr)
    return done.stdout.strip()


def raises(what: str, call: Callable[[], Any], *says: str) -> None:
    """Call what must raise a DelayRLError of one line that says why."""
    from delayrl import DelayRLError

    print(f"{what}:", flush=True)
    try:
        call()
    except DelayRLError as error:
        text = str(error)
        expect("\n" not in text and all(words in text for words in says), f"it raised\n{text}\nnot {says}")
        print(f"    {text}", flush=True)
        return
    raise AssertionError(f"it did not raise {says}")


def holds(what: str, truth: Any, got: Any = None) -> None:
    """Check something that was computed."""
    print(what, flush=True)
    expect(truth, f"got {got!r}")


def expect(truth: Any, otherwise: str) -> None:
    """Raise AssertionError with a text unless something is true."""
    if not truth:
        raise AssertionError(otherwise)


def _run(line: str) -> tuple[int, str]:
    print(f"$ {line}", flush=True)
    program, *words = shlex.split(line)
    done = subprocess.run([Path(sys.executable).with_name(program), *words], capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr
