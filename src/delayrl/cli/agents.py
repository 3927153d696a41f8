"""`delayrl agents`: list the agents."""

import argparse

from delayrl.cli.console import print_table


def run(given: argparse.Namespace | None = None) -> None:
    """Print a table of the agents."""
    from delayrl.agents.registry import AGENTS

    rows = [[name, agent.summary, agent.paper] for name, agent in AGENTS.items()]
    print_table(["agent", "what it is", "paper"], rows)
