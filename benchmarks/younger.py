"""Show policies younger ages than they learned, or hold these back: `python benchmarks/younger.py RUN... --out ROWS`.

The policies are of one agent that learned the age of its constant delay alone, one run for each seed.
"""

import argparse
import json
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonl
import numpy as np
from overruns import Link, returns

from delayrl.deploy import Bundle, Controller, export_run, load_bundle
from delayrl.run.provenance import versions

TRAVELS = ((0, 0), (1, 1), (2, 2), (3, 3), (4, 4), (5, 5), (3, 5), (0, 5))


def exported(run: Path) -> Bundle:
    """Return the policy of a run as it is deployed, in NumPy."""
    with tempfile.TemporaryDirectory() as folder:
        export_run(run, Path(folder) / "bundle")
        return load_bundle(Path(folder) / "bundle")


def main() -> None:
    """Play every link with and without holding back, and write the returns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--out", type=Path, required=True, help="the file of the rows")
    given = parser.parse_args()
    policies = [exported(run) for run in given.runs]
    configs = [json.loads((run / "config.json").read_text()) for run in given.runs]
    kept = ("agent", "env", "delay", "preset", "schedule", "hyperparameters")
    lines: list[dict[str, Any]] = [{"policy": {name: configs[0][name] for name in kept}, "versions": versions()}]
    env = gym.make(configs[0]["env"])
    for link in (Link(low, high) for low, high in TRAVELS):
        for policy, config in zip(policies, configs, strict=True):
            for min_age in (0, policy.min_age):
                totals = returns(env, Controller(policy, min_age=min_age), link)
                lines.append({"link": asdict(link), "seed": config["seed"], "min_age": min_age, "returns": totals})
            print(link, config["seed"], [round(np.mean(line["returns"])) for line in lines[-2:]], flush=True)
    jsonl.write(given.out, lines)


if __name__ == "__main__":
    main()
