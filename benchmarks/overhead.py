"""Measure what the wrappers cost, on alternating steps with and without them: `python benchmarks/overhead.py`.

The task is HalfCheetah-v5. Writes benchmarks/results/overhead.jsonl, from which figures.py makes the table.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonl
import numpy as np

from delayrl.envs.task import quiet
from delayrl.run.provenance import versions
from delayrl.wrappers import AugmentedObservation, AugmentedVectorObservation, Delayed, DelayedVector

TASK = "HalfCheetah-v5"
ROUNDS = 31
DELAYS = ("5", "50", "uniform:1:5@fifo")


def seconds(env: Any, steps: int) -> float:
    """Measure the processor time of one step, in seconds."""
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(64)]
    began = time.process_time()
    for i in range(steps):
        *_, terminated, truncated, _ = env.step(actions[i % 64])
        if not isinstance(terminated, np.ndarray) and (terminated or truncated):
            env.reset()
    return (time.process_time() - began) / steps


def main() -> None:
    """Measure every wrapper against the bare task, in alternation, and write the ratios."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    with quiet():
        cases: list[tuple[str, int, Any, Any]] = []
        bare = gym.make(TASK, disable_env_checker=True)
        for delay in DELAYS:
            delayed = Delayed(gym.make(TASK, disable_env_checker=True), delay)
            cases += [
                (f"Delayed {delay}", 1, bare, delayed),
                (f"AugmentedObservation {delay}", 1, bare, AugmentedObservation(delayed)),
            ]
        for count in (4, 16):
            many = gym.make_vec(TASK, count, "sync")
            delayed_vector = DelayedVector(gym.make_vec(TASK, count, "sync"), "5")
            cases += [("DelayedVector 5", count, many, delayed_vector)]
            cases += [("AugmentedVectorObservation 5", count, many, AugmentedVectorObservation(delayed_vector))]
        ratios: dict[tuple[str, int], list[float]] = {case[:2]: [] for case in cases}
        for number in range(ROUNDS):
            for name, count, without, wrapped in cases:
                steps = 1000 // count
                before, with_it, after = seconds(without, steps), seconds(wrapped, steps), seconds(without, steps)
                ratios[name, count].append(2 * with_it / (before + after))
            print(f"\rround {number + 1} of {ROUNDS}", end="", file=sys.stderr)
    lines = [{"versions": versions(), "task": TASK, "rounds": ROUNDS}]
    for (name, count), values in ratios.items():
        low, middle, high = np.percentile(values, [25, 50, 75]).round(3).tolist()
        lines.append({"wrapper": name, "environments": count, "ratio": middle, "quartiles": [low, high]})
        print(f"\n{name}, {count}: {middle} ({low} to {high})", end="", file=sys.stderr)
    jsonl.write(Path(__file__).parent / "results" / "overhead.jsonl", lines)


if __name__ == "__main__":
    main()
