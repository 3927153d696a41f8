"""Made-up results, for the report's tests and for measuring it: `python tests/synthetic.py` writes such a report.

No number here was measured. Returns are a known function of agent, delay and step, with noise from the seed.
"""

import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.report.report import report
from delayrl.report.summary import Cell

TASKS = ["Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "Pusher", "Reacher", "Swimmer", "Walker2d"]
QUALITY = {"vdpo": 1.1, "ad-sac": 1.0, "bpql": 0.95, "dida": 0.8, "dcac": 0.6, "a-sac": 0.4, "sac": 1.0, "random": 0.0}
RANDOM, REFERENCE = -50.0, 4_000.0


def cell(agent: str, env: str, delay: int | str, seeds: int | tuple[int, ...] = 3, **changes: Any) -> Cell:
    seeds = tuple(range(seeds)) if isinstance(seeds, int) else seeds
    values: dict[str, Any] = {
        "id": f"{agent}-{env}-{delay}-{changes.get('overrides', '')}", "agent": agent, "env": env, "delay": delay,
        "preset": "paper", "protocol": "corrected", "seeds": seeds, "overrides": {}, "status": "done",
        "done": 1_000_000, "total": 1_000_000,
    }  # fmt: skip
    return Cell(**values | changes)


def rows(cells: Sequence[Cell], evaluations: int = 100, episodes: int = 10) -> Iterator[dict[str, Any]]:
    """What the cells would have written up to `done`."""
    for number, c in enumerate(cells):
        for seed in c.seeds:
            noise = np.random.default_rng([number, seed])
            quality = QUALITY.get(c.agent, 0.5) * (0.97 ** (c.delay if isinstance(c.delay, int) else 5))
            for step in range(c.total // evaluations, c.done + 1, c.total // evaluations):
                learned = 1.0 if c.agent == "random" else 1 - np.exp(-5 * step / c.total)
                mean = RANDOM + quality * learned * (REFERENCE - RANDOM) + 100 * noise.normal()
                for episode in range(episodes):
                    yield {
                        "cell": c.id, "agent": c.agent, "env": c.env, "delay": c.delay, "preset": c.preset,
                        "protocol": c.protocol, "privileged": c.agent in ("vdpo", "dida", "ad-sac"), "seed": seed,
                        "step": step, "policy": "agent", "episode": episode, "reset_seed": 1,
                        "return": mean + float(episode), "length": 1000, "mujoco": "0.0.0",
                    }  # fmt: skip


def full_grid(seeds: int = 10) -> list[Cell]:
    """The paper's: 9 tasks, 3 constant delays and a stochastic one, 6 agents; its ablation; and the anchors."""
    cells = []
    for task in TASKS:
        env = f"delayrl/{task}-v4"
        for delay in (5, 25, 50, "paper-stochastic-5"):
            cells += [cell(agent, env, delay, seeds) for agent in QUALITY if agent not in ("sac", "random")]
        for representation in ("mlp", "transformer-no-belief"):
            cells.append(cell("vdpo", env, 5, seeds, overrides={"representation": representation}))
        cells += [cell("sac", env, 0, seeds), cell("random", env, 0, seeds)]
    return cells


def main() -> None:
    """Time and size of the report of a full grid; its folder is the argument."""
    cells, out = full_grid(), Path(sys.argv[1])
    made = list(rows(cells))
    begin = time.perf_counter()
    report(made, cells, out, "Synthetic grid: no number here was measured")
    seconds = time.perf_counter() - begin
    size = (out / "report.html").stat().st_size / 1e6
    print(f"{len(cells)} cells, {len(made):,} rows: {seconds:.1f} s, report.html {size:.1f} MB")


if __name__ == "__main__":
    main()
