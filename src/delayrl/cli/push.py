"""`delayrl push BUNDLE OWNER/NAME`: upload a bundle to the Hugging Face Hub."""

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the bundle and the repository."""
    parser.add_argument("bundle", type=Path, help="the folder of the bundle")
    parser.add_argument("repo", help="OWNER/NAME")
    parser.add_argument("--private", action="store_true", help="make a new repository private")


def run(given: argparse.Namespace) -> None:
    """Upload the bundle, and print its address."""
    from delayrl.deploy.hub import push

    print(push(given.bundle, given.repo, private=given.private))
