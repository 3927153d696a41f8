"""`delayrl watch RUN`: render an episode to a file."""

import argparse
from pathlib import Path

from delayrl.cli.console import add_env_kwargs, add_stored_env


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the run folder, the file, and the episode to play."""
    add = parser.add_argument
    add("run", type=Path, help="the run folder")
    add("--out", type=Path, required=True, help="an .mp4 or .gif file")
    add("--delay", metavar="DELAY", help="a delay up to the longest of the training (default: that of the training)")
    add("--seed", type=int, default=0, help="seed of the start state (default: 0)")
    add_stored_env(parser)
    add_env_kwargs(parser)


def run(given: argparse.Namespace) -> None:
    """Render the episode, and print its length and return."""
    from delayrl.play.video import watch

    task = {"env": given.env, "env_kwargs": dict(given.env_kwargs)}
    frames, total = watch(given.run, given.out, given.delay, given.seed, **task)
    print(f"{given.out}: {frames} frames, return {total:.1f}")
