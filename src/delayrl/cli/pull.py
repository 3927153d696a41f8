"""`delayrl pull OWNER/NAME`: download a bundle from the Hugging Face Hub."""

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the repository and the folder of the bundle."""
    parser.add_argument("repo", help="OWNER/NAME")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--revision", help="a branch, tag or commit")
    parser.add_argument("--force", action="store_true", help="replace an existing bundle")


def run(given: argparse.Namespace) -> None:
    """Download the bundle, and print what it holds."""
    from delayrl.deploy.hub import plain, pull

    metadata = pull(given.repo, given.out, revision=given.revision, force=given.force)
    agent, env, longest = plain(metadata.get("agent")), plain(metadata.get("env")), metadata["policy"]["max_age"]
    print(f"{given.out}: {agent} on {env}, ages 0..{longest}")
