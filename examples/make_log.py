"""Write a log like that of a robot arm: a position servo at 100 Hz whose measured position is 65 ms old.

    python examples/make_log.py arm.csv            commands and observations, from which the delay is estimated
    python examples/make_log.py arm.csv --stamps   when each observation was made and received, which gives exact delays

The servo takes about 60 ms to go half of a step, so the position trails the command by about twice the delay. The delay
is 150 ms longer during the first second (a cold start). Stamped delays are 50 ms plus a gamma-distributed part with a
mean of 15 ms; observations arrive in order.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

ROW, DELAY, ROWS = 0.01, 0.065, 1500


def servo(steps: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Simulate commands (smooth, with exploration noise) and true positions, one of each every millisecond."""
    position = velocity = target = command = 0.0
    commands, positions = [], []
    for i in range(steps):
        if i % 10 == 0:
            target = 0.97 * target + 0.1 * random.normal()
            command = target + 0.1 * random.normal()
        commands.append(command)
        positions.append(position)
        velocity += 0.001 * (900 * (command - position) - 45 * velocity)
        position += 0.001 * velocity
    return np.array(commands), np.array(positions)


def main() -> None:
    """Read the command line and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--stamps", action="store_true", help="stamp observations instead of logging signals")
    parser.add_argument("--rows", type=int, default=ROWS)
    given = parser.parse_args()
    random = np.random.default_rng(0)
    time = ROW * np.arange(given.rows)
    with given.out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if given.stamps:
            travel = 0.05 + random.gamma(3, 0.005, given.rows) + np.where(time < 1, 0.15 * (1 - time), 0)
            received = np.maximum.accumulate(time + travel)
            writer.writerow(["stamp", "received"])
            writer.writerows([f"{made:.2f}", f"{arrived:.5f}"] for made, arrived in zip(time, received, strict=True))
            return
        commands, positions = servo(10 * given.rows, random)
        made = np.maximum(0, 10 * np.arange(given.rows) - np.where(time < 1, 215, 1000 * DELAY).astype(int))
        writer.writerow(["time", "command", "obs_position"])
        seen = positions[made] + 0.002 * random.normal(size=given.rows)
        writer.writerows(
            [f"{t:.2f}", f"{c:.4f}", f"{p:.4f}"] for t, c, p in zip(time, commands[::10], seen, strict=True)
        )


if __name__ == "__main__":
    main()
