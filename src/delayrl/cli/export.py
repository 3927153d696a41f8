"""`delayrl export RUN`: write a run's policy as a bundle."""

import argparse
from pathlib import Path

from delayrl.cli.console import add_stored, quoted, say_unfinished


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the run folder and the folder of the bundle."""
    parser.add_argument("run", type=Path, help="the run folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--force", action="store_true", help="replace an existing bundle")
    add_stored(parser)


def run(given: argparse.Namespace) -> None:
    """Write the bundle, and print what it holds."""
    from delayrl.deploy.export import export_run
    from delayrl.deploy.runtime.telemetry import served

    metadata = export_run(given.run, given.out, force=given.force, env=given.env, agent=given.agent)
    shortest, longest = metadata["ages"]
    print(f"{given.out}: {metadata['agent']} on {metadata['env']}, ages {shortest}..{longest}")
    print(f"  serves                   {served(shortest, longest, metadata['action_delay'], metadata['dt'])}")
    print(f"  next                     delayrl latency {quoted(given.out)}")
    say_unfinished(given.run, metadata["step"])
