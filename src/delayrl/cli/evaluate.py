"""`delayrl evaluate RUN`: play a trained policy."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from delayrl.cli.console import add_env_kwargs, add_stored, print_table, say_unfinished, whole
from delayrl.errors import DelayRLError
from delayrl.run.rows import number_in_words, return_in_words


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the run folder, and the episodes to play."""
    add = parser.add_argument
    add("run", type=Path, help="the run folder")
    add("--episodes", type=whole, default=10, help="episodes to play (default: 10)")
    add("--delay", metavar="DELAY", help="a delay up to the longest of the training (default: that of the training)")
    add("--sweep", action="store_true", help="play every delay from 0 to the longest, and draw a figure")
    add("--seed", type=whole, default=0, help="seed of the start states (default: 0)")
    add("--json", action="store_true", help="print JSON")
    add_stored(parser)
    add_env_kwargs(parser)


def run(given: argparse.Namespace) -> None:
    """Play the episodes, and print their returns."""
    from delayrl.play.evaluation import evaluate

    stored = {"env": given.env, "env_kwargs": dict(given.env_kwargs), "agent": given.agent}
    if given.sweep:
        _sweep(given, stored)
        return
    result = evaluate(given.run, given.episodes, given.delay, given.seed, **stored)
    if given.json:
        print(json.dumps(result))
    else:
        returns, lowest = result["returns"], f"the lowest {number_in_words(min(result['returns']), comma='')}"
        about = f"{result['agent']} on {result['env']}, delay {result['delay']}"
        print(f"{about}: return {return_in_words(returns)}, {lowest}")
    say_unfinished(given.run, result["step"])


def _sweep(given: argparse.Namespace, stored: dict[str, Any]) -> None:
    from tqdm import tqdm

    from delayrl.play.evaluation import sweep
    from delayrl.play.plots import against_delay
    from delayrl.play.policy import load

    if given.delay is not None:
        raise DelayRLError("--sweep plays every delay; leave --delay out")
    policy = load(given.run, **stored)
    played = sweep(policy, given.episodes, given.seed)
    results = list(tqdm(played, total=policy.spec.delay + 1, unit="delay", disable=given.json))
    if given.json:
        print(json.dumps(results))
    else:
        rows = []
        for r in results:
            values = (r["mean_return"], r["std_return"], min(r["returns"]))
            numbers = ("" if value is None else number_in_words(value, comma="") for value in values)
            rows.append([r["delay"], "yes" if r["learned"] else "no", *numbers, r["episodes"]])
        print_table(["delay", "learned", "mean return", "std", "lowest", "episodes"], rows)
    say_unfinished(given.run, results[0]["step"])
    figure = given.run / "delays.png"
    against_delay(results, figure)
    print(f"figure: {figure}", file=sys.stderr)
