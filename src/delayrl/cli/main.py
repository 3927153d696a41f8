"""The entry point of `delayrl`. An error that a user can cause is one line on stderr and a non-zero exit status."""

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any, TextIO

from delayrl import __version__
from delayrl.cli.console import Parser
from delayrl.errors import STOPPED, DelayRLError, DelayWarning, StoppedError, needs_extra

COMMANDS = {
    "train": "train an agent, or resume a run",
    "evaluate": "play a trained policy on start states that it never saw",
    "watch": "render an episode to a file",
    "runs": "list the runs in a folder",
    "compare": "compare runs: options, returns, learning curves",
    "measure": "measure the delay of an environment, or from a log",
    "export": "write a run's policy as a bundle, for use without JAX",
    "latency": "measure how long one decision of a bundle takes",
    "push": "upload a bundle to the Hugging Face Hub",
    "pull": "download a bundle from the Hugging Face Hub, and check it",
    "bench": "run a grid of agents, tasks, delays and seeds",
    "agents": "list the agents",
    "tasks": "list the tasks",
}
"""Each command is the module of its name in this folder, with `run(given)` and, if it has options, `add_options`."""


class _Stderr:
    """A stderr that never raises: a reader that is gone, or a full disk, ends no work that it was to be told of."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command that the words after `delayrl` name; None for the words of the process."""
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    if sys.stderr is not None and not isinstance(sys.stderr, _Stderr):
        sys.stderr = _Stderr(sys.stderr)  # type: ignore[assignment]
    if isinstance(sys.stdout, io.TextIOWrapper):  # what a terminal, or a name in a file, cannot show is escaped
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        _run(list(sys.argv[1:] if arguments is None else arguments))
    except DelayRLError as error:
        print(f"delayrl: {error}", file=sys.stderr)
        sys.exit(STOPPED if isinstance(error, StoppedError) else 2)
    except ModuleNotFoundError as error:
        if (needed := needs_extra(error)) is None:
            raise
        print(f"delayrl: {needed}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # of stdout, whose reader has seen enough; before OSError, its base class
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(f"delayrl: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def _show_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any) -> None:
    """Write a warning of ours as one line; others as Python does."""
    ours = issubclass(category, DelayWarning)
    sys.stderr.write(f"delayrl: {message}\n" if ours else warnings.formatwarning(message, category, filename, lineno))


def _run(arguments: list[str]) -> None:
    parser = Parser(prog="delayrl", description="Reinforcement learning when observations arrive late.")
    parser.add_argument("--version", action="version", version=f"delayrl {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    parsers = {name: commands.add_parser(name, help=text, description=text) for name, text in COMMANDS.items()}
    if not arguments or arguments[0] not in parsers:
        parser.parse_args(arguments)  # --help, or an error
        return
    name, *words = arguments
    command = import_module(f"delayrl.cli.{name}")
    if name == "train":  # its options depend on the agent and the preset
        command.add_options(parsers[name], words)
    elif hasattr(command, "add_options"):
        command.add_options(parsers[name])
    command.run(parsers[name].read(words))
