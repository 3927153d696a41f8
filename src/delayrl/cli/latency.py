"""`delayrl latency BUNDLE`: measure how long one decision takes."""

import argparse
import math
from pathlib import Path

from delayrl.cli.console import Numbers, print_table, seconds, whole
from delayrl.errors import DelayRLError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the bundle, and the decisions to time."""
    add = parser.add_argument
    add("bundle", type=Path, help="the folder of the bundle")
    add("--period", type=seconds, metavar="TIME", help="control period, e.g. 20ms or 50Hz (default: the task's step)")
    add("--backend", choices=["numpy", "onnx", "jax"], help="(default: all that are installed)")
    add("--ages", **Numbers.of(whole), metavar="N", help="(default: 5, 25, 50 and the longest)")
    add("--decisions", type=whole, default=2000, metavar="N", help="decisions for each age (default: 2000)")


def run(given: argparse.Namespace) -> None:
    """Time the decisions, and print their quantiles."""
    from delayrl.deploy.bundle import BACKENDS, load_bundle
    from delayrl.deploy.latency import available, latency, table

    policy = load_bundle(given.bundle)
    period = policy.dt if given.period is None else given.period
    if given.period is not None and not 0 < given.period < math.inf:
        raise DelayRLError(f"--period must be above 0; got {given.period:g} s")
    backends = [given.backend] if given.backend else [name for name in BACKENDS if available(name)]
    rows = {name: latency(given.bundle, name, decisions=given.decisions, ages=given.ages) for name in backends}
    print_table(*table(rows, period))
    note = f"control period {1000 * period:g} ms" if period else "control period unknown: give --period TIME"
    print(f"\n{given.decisions:,} decisions each, back to back, on one thread of one core; {note}")
