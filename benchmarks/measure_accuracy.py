"""Test how well `delayrl measure LOG` recovers known delays: `python benchmarks/measure_accuracy.py`, some minutes.

Writes one row for each log to results/measure.jsonl, and from these rows the tables of docs/measure.md. `--table` only
writes the tables. A log is a CSV file, read like a user's. The delay is a whole number of rows, 0 to 11.
"""

import argparse
import csv
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import jsonl
import numpy as np
from pages import HERE, insert

from delayrl.envs.making import make as make_task
from delayrl.errors import DelayRLError
from delayrl.measure import from_log
from delayrl.measure.reading import Table, read_signals
from delayrl.report.markup import markdown_table

RESULTS = HERE / "results" / "measure.jsonl"
ROW, ROWS, LONGEST, SEEDS = 0.02, 2000, 40, 3
PLANTS = ("gain", "integrator", "servo", "second order")
COMMANDS = ("white", "smooth", "held", "policy")
NOISES = (0.0, 0.01, 0.03, 0.1)
TASKS = ("HalfCheetah-v5", "Hopper-v5", "Reacher-v5", "Ant-v5", "Pendulum-v1")
WIDE = 4.5  # rows; the command warns about wider intervals
METHODS = ("dead time", "increments", "levels")


def move(plant: str, x: float, v: float, u: float) -> tuple[float, float]:
    """Return position and velocity one row later."""
    if plant == "gain":
        return u, 0.0
    if plant == "integrator":
        return x + 0.1 * u, 0.0
    if plant == "servo":  # follows a commanded position; natural frequency 0.3 a row, damping 0.7
        v += 0.09 * (u - x) - 0.42 * v
    else:  # a force moves a mass on a weak, weakly damped spring
        v += 0.02 * u - 0.05 * v - 0.01 * x
    return x + v, v


def choose(kind: str, t: int, old: np.ndarray, drift: np.ndarray, feedback: np.ndarray, random: Any) -> tuple[Any, Any]:
    """Return the next command and the next drift, the correlated noise of `smooth` and `policy`.

    `policy` is feedback on the observation plus the drift.
    """
    size = len(old)
    if kind == "white":
        return random.uniform(-1, 1, size), drift
    if kind == "held":
        return (random.uniform(-1, 1, size) if t % 10 == 0 else old), drift
    if kind == "smooth":
        drift = 0.95 * drift + 0.3 * random.normal(size=size)
        return np.clip(drift, -3, 3), drift
    drift = 0.8 * drift + 0.3 * random.normal(size=size)
    return np.tanh(feedback + drift), drift


def synthetic(plant: str, kind: str, noise: float, delay: int, random: Any) -> list[list[float]]:
    """Return rows of episode, time, command, observation; sensor noise is relative to the signal's deviation."""
    states, rows, x, v, u, drift, scale = [0.0], [], 0.0, 0.0, np.zeros(1), np.zeros(1), 0.0
    for t in range(ROWS):
        seen = states[max(0, t - delay)] + noise * scale * random.normal()
        u, drift = choose(kind, t, u, drift, np.array([-0.5 * seen]), random)
        rows.append([0, ROW * t, float(u[0]), seen])
        x, v = move(plant, x, v, float(u[0]))
        states.append(x)
        if t % 50 == 49:
            scale = float(np.std(states))
    return rows


def simulated(task: str, kind: str, noise: float, delay: int, random: Any) -> list[list[float]]:
    """Return the same rows for a Gymnasium task wrapped in `Delayed`."""
    env = make_task(task, delay)
    high = env.action_space.high
    gains = 0.1 * random.normal(size=(len(high), env.observation_space.shape[0]))
    obs, _ = env.reset(seed=int(random.integers(2**31)))
    rows, u, drift, episode = [], np.zeros(len(high)), np.zeros(len(high)), 0
    for t in range(ROWS):
        u, drift = choose(kind, t, u, drift, gains @ obs, random)
        u = np.clip(u, -1, 1)
        rows.append([episode, ROW * t, *u, *obs])
        obs, _, terminated, truncated, _ = env.step((u * high).astype(np.float32))
        if terminated or truncated:
            episode += 1
            obs, _ = env.reset(seed=int(random.integers(2**31)))
    env.close()
    table = np.array(rows)
    sensors = table[:, 2 + len(high) :]
    sensors += noise * sensors.std(0) * random.normal(size=sensors.shape)
    return table.tolist()


def write(path: Path, rows: list[list[float]], commands: int) -> None:
    """Write rows as a CSV log."""
    names = ["episode", "time", *(f"command_{i}" for i in range(commands))]
    names += [f"obs_{i}" for i in range(len(rows[0]) - len(names))]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *rows])


def levels(path: Path) -> float:
    """Return the lag, in rows, at which raw commands and observations correlate most: the naive estimate."""
    log = read_signals(Table(path))
    u, y = (v - v.mean(0) for v in (log.commands, log.observations))
    u, y = u / u.std(0), y / np.maximum(y.std(0), 1e-12)
    r = [np.abs(u[:-lag].T @ y[lag:]).max() for lag in range(1, LONGEST + 1)]
    return float(np.argmax(r))


def measure(path: Path, delay: int) -> dict[str, Any]:
    """Return all estimates in rows of delay; a response one row later is a delay of 0."""
    row: dict[str, Any] = {"delay": delay, "levels": levels(path)}
    try:
        e = from_log(path, longest=(LONGEST - 1) * ROW)
    except DelayRLError as error:
        return row | {"dead time": None, "increments": None, "error": str(error).split(": ", 1)[1][:60]}
    row |= {"dead time": e.delay / ROW, "increments": e.peak.lag / ROW - 1, "strength": e.strength}
    return row | {"low": e.low / ROW, "high": e.high / ROW}


def cases() -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield each log's description and the function that makes it."""
    for plant, kind, noise, seed in product(PLANTS, COMMANDS, NOISES, range(SEEDS)):
        yield {"plant": plant, "commands": kind, "noise": noise, "seed": seed}, synthetic
    for task, kind, noise, seed in product(TASKS, COMMANDS, (0.0, 0.03), range(SEEDS)):
        yield {"plant": task, "commands": kind, "noise": noise, "seed": seed}, simulated


def run() -> None:
    """Measure every log and write the rows."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        for number, (case, make) in enumerate(cases()):
            random = np.random.default_rng([number, case["seed"]])
            delay = int(random.integers(0, 12))
            rows = make(case["plant"], case["commands"], case["noise"], delay, random)
            sizes = 1 if make is synthetic else make_task(case["plant"]).action_space.shape[0]
            write(path, rows, sizes)
            lines.append(case | measure(path, delay))
        for seed in range(100):  # signals that have nothing to do with each other
            random = np.random.default_rng([seed, 99])
            both = np.cumsum(random.normal(size=(ROWS, 4)), 0) if seed % 2 else random.normal(size=(ROWS, 4))
            write(path, [[0, ROW * t, *row] for t, row in enumerate(both)], 2)
            lines.append({"plant": "unrelated", "seed": seed} | measure(path, 0))
    jsonl.write(RESULTS, lines)


def score(lines: list[dict[str, Any]], method: str) -> str:
    """Return the share of logs measured to within half a row, and in brackets to within one row."""
    errors = [abs(line[method] - line["delay"]) if line[method] is not None else np.inf for line in lines]
    return f"{np.mean(np.array(errors) < 0.5):.0%} ({np.mean(np.array(errors) < 1.5):.0%})"


def table(groups: list[tuple[str, list[dict[str, Any]]]], head: str) -> str:
    """Return a Markdown table with one group of logs per line."""
    body = []
    for name, lines in groups:
        inside = [line["low"] <= line["delay"] <= line["high"] for line in lines if "low" in line]
        body.append([name, len(lines), *(score(lines, method) for method in METHODS), f"{np.mean(inside):.0%}"])
    titles = [head, "logs", "dead time", "peak of increments", "peak of levels", "in the interval"]
    return markdown_table(titles, body)


def tables() -> None:
    """Write the tables into docs/measure.md."""
    lines = jsonl.read(RESULTS)
    own = [line for line in lines if line["plant"] in PLANTS]
    groups = [
        (f"{plant}, noise {noise:.0%}", [c for c in own if (c["plant"], c["noise"]) == (plant, noise)])
        for plant, noise in product(PLANTS, NOISES)
    ]
    tasks = [
        (f"{task}, {kind}", [c for c in lines if (c["plant"], c.get("commands")) == (task, kind)])
        for task, kind in product(TASKS, COMMANDS)
    ]
    unrelated = [line for line in lines if line["plant"] == "unrelated"]
    alarms = sum(line["dead time"] is not None for line in unrelated)
    errors = [c["dead time"] - c["delay"] for c in own if c["dead time"] is not None]
    text = table([*groups, ("all", own)], "plant") + "\n\n"
    text += table([*tasks, ("all", [c for _, group in tasks for c in group])], "task, commands") + "\n\n"
    measured = [line for line in lines if line["plant"] != "unrelated" and line["dead time"] is not None]
    wide = [line["high"] - line["low"] > WIDE for line in measured]
    wrong = [abs(line["dead time"] - line["delay"]) > 1.5 for line in measured]
    text += (
        f"Of {len(unrelated)} logs of unrelated signals (half of them random walks) {alarms} showed a delay. On the "
        f"plants the dead time was too short in {np.mean(np.array(errors) < -0.5):.0%} and too long in "
        f"{np.mean(np.array(errors) > 0.5):.0%} of the logs. Of the {sum(wrong)} answers that "
        f"were off by two rows or more {sum(np.logical_and(wide, wrong))} came with an interval so wide "
        f"that the command warns, of the {len(measured) - sum(wrong)} others "
        f"{sum(np.logical_and(wide, np.logical_not(wrong)))}. "
        "Results: `benchmarks/results/measure.jsonl`."
    )
    insert(HERE.parent / "docs" / "measure.md", "accuracy", text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", action="store_true", help="only rewrite the tables")
    if not parser.parse_args().table:
        run()
    tables()
