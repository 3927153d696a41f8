"""`delayrl watch RUN`: render an episode to a file."""

import argparse
from pathlib import Path

from delayrl.cli.console import add_env_kwargs, add_stored, say_unfinished, whole
from delayrl.run.rows import number_in_words


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the run folder, the file, and the episode to play."""
    add = parser.add_argument
    add("run", type=Path, help="the run folder")
    add("--out", type=Path, required=True, help="an .mp4 or .gif file")
    add("--delay", metavar="DELAY", help="a delay up to the longest of the training (default: that of the training)")
    add("--seed", type=whole, default=0, help="seed of the start state (default: 0)")
    add("--camera", metavar="NAME", help="a camera of the MuJoCo model (default: track, or one that follows the robot)")
    add("--compare", type=Path, metavar="RUN2", help="show a run on the same task beside it, from the same start state")
    add("--seconds", type=float, metavar="S", help="length of the file, with further episodes (default: one episode)")
    add_stored(parser)
    add_env_kwargs(parser)


def run(given: argparse.Namespace) -> None:
    """Render the episode, and print its length and return."""
    from delayrl.play.video import watch

    stored = {"env": given.env, "env_kwargs": dict(given.env_kwargs), "agent": given.agent}
    shown = (given.delay, given.seed, given.camera, given.compare, given.seconds)
    moments = watch(given.run, given.out, *shown, **stored)
    several = "" if given.seconds is None else "episode {0.episode}, "
    results = (
        several.format(moment) + f"{moment.step:,} steps, return {number_in_words(moment.total)}" for moment in moments
    )
    print(f"{given.out}: {'; beside it '.join(results)}")
    for folder in filter(None, (given.run, given.compare)):
        say_unfinished(folder)
