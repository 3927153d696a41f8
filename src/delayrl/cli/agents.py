"""`delayrl agents`: list the agents."""

import argparse

from delayrl.cli.console import print_table


def run(given: argparse.Namespace | None = None) -> None:
    """Print a table of the agents."""
    from delayrl.run.agents import known_agents

    rows = [[name, agent.summary, agent.paper] for name, agent in known_agents().items()]
    print_table(["agent", "what it is", "paper"], rows)
    print("\nMODULE:NAME of your own works as well (docs/own-agent.md).")
