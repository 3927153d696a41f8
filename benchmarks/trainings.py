"""Short runs of `delayrl train` on HalfCheetah-v5, which start.py and machines.py time."""

import argparse
from typing import NamedTuple


class Work(NamedTuple):
    """What is trained. The fields are columns of the rows."""

    agent: str
    delay: int
    preset: str


def words(work: Work, steps: int, random_steps: int) -> list[str]:
    """Return a command line after `delayrl`, but for its `--out`; learning begins after the random steps."""
    text = f"train {work.agent} --env HalfCheetah-v5 --delay {work.delay} --preset {work.preset} --steps {steps} "
    text += f"--random-steps {random_steps} --update-after {random_steps} --replay-capacity 20000 --overwrite --quiet"
    return text.split()


def parser(description: str, works: list[Work]) -> argparse.ArgumentParser:
    """Return a parser of the options that both scripts have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--table", action="store_true", help="write the table alone")
    parser.add_argument("--only", metavar="AGENT", choices=sorted({work.agent for work in works}))
    return parser
