"""`delayrl tasks`: list the tasks."""

import argparse

from delayrl.cli.console import print_table


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add nothing: the command has no options."""


def run(given: argparse.Namespace) -> None:
    """Print a table of the tasks."""
    from delayrl.envs import tasks

    rows = []
    for task in tasks():
        limit, seconds = task.time_limit or "-", f"{task.seconds:g}" if task.seconds else "-"
        rows.append([task.name, task.obs_size, task.action_size, f"±{task.action_high:g}", limit, seconds])
    print_table(["task", "observation", "action", "range", "time limit", "seconds a step"], rows)
    print("\nAny other Gymnasium task with flat Box observations and bounded Box actions works as well.")
