"""`delayrl tasks`: list the tasks."""

import argparse

from delayrl.cli.console import print_table


def run(given: argparse.Namespace) -> None:
    """Print a table of the tasks."""
    from delayrl.envs.making import tasks

    rows = []
    for name, env, seconds in tasks():
        actions = env.action_space
        sizes = [env.observation_space.shape[0], actions.shape[0], f"±{actions.high.max():g}"]
        rows.append([name, *sizes, env.spec.max_episode_steps or "-", f"{seconds:g}" if seconds else "-"])
    print_table(["task", "observation", "action", "range", "time limit", "seconds a step"], rows)
    print("\nAny other Gymnasium task with bounded Box actions works as well, and so does MODULE:NAME of your own.")
