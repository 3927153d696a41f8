"""Made-up results, for the report's tests and for measuring it: `python tests/report/synthetic.py OUT`.

No number here was measured. Returns are a known function of agent, delay and step, with noise from the seed.
"""

import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.report.report import report
from delayrl.run.cell import Cell, Progress
from delayrl.run.condition import Condition

TASKS = ["Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "Pusher", "Reacher", "Swimmer", "Walker2d"]
QUALITY = {"vdpo": 1.1, "ad-sac": 1.0, "bpql": 0.95, "dida": 0.8, "dcac": 0.6, "a-sac": 0.4, "sac": 1.0, "random": 0.0}
RANDOM, REFERENCE = -50.0, 4_000.0
EVIL = "</script><script>alert(1)</script>"
NASTY = [
    EVIL,
    "a|b `c` *d* [e](http://f)",
    "<img src=x onerror=alert(1)>",
    "{{data}}",
    "$x^2$",
    "two\nlines",
    "<!--",
    "\ud800",
]

Standing = tuple[Cell, Progress]


def standing(
    agent: str, env: str, delay: int | str, seeds: int | tuple[int, ...] = 3, id: str = "", state: Any = "done",
    step: int | None = None, steps: int = 1_000_000, **changes: Any,
) -> Standing:  # fmt: skip
    """A cell and how far it is: at its end, unless `step` says otherwise."""
    seeds = tuple(range(seeds)) if isinstance(seeds, int) else seeds
    id = id or f"{agent}-{env}-{delay}-{changes.get('overrides', '')}"
    condition = Condition(agent, env, delay, steps=steps, **changes)
    return Cell(condition, seeds, id), Progress(state, steps if step is None else step)


def rows(cells: Sequence[Standing], evaluations: int = 100, episodes: int = 10) -> Iterator[dict[str, Any]]:
    """What the cells would have written so far."""
    for number, (cell, progress) in enumerate(cells):
        condition, interval = cell.condition, cell.condition.steps // evaluations
        for seed in cell.seeds:
            noise = np.random.default_rng([number, seed])
            delay = condition.delay if isinstance(condition.delay, int) else 5
            quality = QUALITY.get(condition.agent, 0.5) * 0.97**delay
            for step in range(interval, progress.step + 1, interval):
                learned = 1.0 if condition.agent == "random" else 1 - np.exp(-5 * step / condition.steps)
                mean = RANDOM + quality * learned * (REFERENCE - RANDOM) + 100 * noise.normal()
                for episode in range(episodes):
                    yield condition.columns | {
                        "cell": cell.id, "privileged": condition.agent in ("vdpo", "dida", "ad-sac"), "seed": seed,
                        "step": step, "policy": "agent", "episode": episode, "reset_seed": 1,
                        "return": mean + float(episode), "length": 1000, "mujoco": "0.0.0",
                    }  # fmt: skip


def row(of: Standing, seed: int, step: int, value: float, episode: int = 0, policy: str = "agent") -> dict[str, Any]:
    """A row of a cell."""
    columns = of[0].condition.columns
    return columns | {
        "cell": of[0].id, "seed": seed, "step": step, "policy": policy, "episode": episode, "return": value,
        "privileged": columns["agent"] == "vdpo",
    }  # fmt: skip


def curve(of: Standing, seed: int, values: list[float], policy: str = "agent") -> list[dict[str, Any]]:
    """An evaluation of two episodes, 5 above and 5 below the mean, every 100 steps."""
    return [
        row(of, seed, 100 * i, value + 5 - 10 * episode, episode, policy)
        for i, value in enumerate(values, 1)
        for episode in range(2)
    ]


def small(**changes: Any) -> dict[str, Standing]:
    """An agent and its anchors, by agent."""
    given = {"steps": 300, "seeds": 2} | changes
    return {
        "vdpo": standing("vdpo", "delayrl/Ant-v4", 5, **given),
        "sac": standing("sac", "delayrl/Ant-v4", 0, **given),
        "random": standing("random", "delayrl/Ant-v4", 0, **given),
    }


def anchored(cells: dict[str, Standing], **curves: list[list[float]]) -> list[dict[str, Any]]:
    """Rows of the cells. Random: 0 and 20, so 10. Delay-free SAC ends at 100 and 120, so 110."""
    curves = {"random": [[0.0] * 3, [20.0] * 3], "sac": [[0.0, 50, 100], [0.0, 50, 120]]} | curves
    return [r for name, runs in curves.items() for seed, c in enumerate(runs) for r in curve(cells[name], seed, c)]


def longer_reference() -> tuple[list[Standing], list[dict[str, Any]]]:
    """Cells and rows of agents that end after 300 and 400 steps, where delay-free SAC has 300 and 500."""
    cells = small() | {
        "bpql": standing("bpql", "delayrl/Ant-v4", 5, 2, steps=400),
        "longer": standing("sac", "delayrl/Ant-v4", 0, 2, id="longer", steps=500),
    }
    longer = [[20.0, 40, 60, 80, 100], [0.0, 20, 40, 60, 120]]
    vdpo, bpql = [[0.0, 10, 20], [0.0, 20, 40]], [[0.0, 10, 20, 30], [0.0, 20, 40, 60]]
    return [*cells.values()], anchored(cells, vdpo=vdpo, bpql=bpql, longer=longer)


def two_lengths() -> tuple[list[Standing], list[dict[str, Any]]]:
    """Cells and rows of agents that end after 400 and after 800 steps, each with its delay-free SAC."""
    some = (("vdpo", 5, 400), ("vdpo", 25, 400), ("bpql", 5, 800), ("sac", 0, 400), ("sac", 0, 800), ("random", 0, 400))
    cells = [standing(agent, "Ant", delay, 2, f"{agent}{delay}{steps}", steps=steps) for agent, delay, steps in some]
    return cells, list(rows(cells, evaluations=4, episodes=1))


def nasty() -> tuple[list[Standing], list[dict[str, Any]]]:
    """Cells and rows whose names try to break out of the page."""
    given: dict[str, Any] = {"preset": EVIL, "protocol": EVIL, "steps": 200}
    cells = [standing(name, name, name, id=name, **given) for name in NASTY]
    cells += [standing("random", name, 0, **given) for name in NASTY]
    return cells, list(rows(cells, evaluations=2, episodes=1))


def full_grid(seeds: int = 10, tasks: Sequence[str] = TASKS) -> list[Standing]:
    """The paper's: 9 tasks, 3 constant delays and a stochastic one, 6 agents; its ablation; and the anchors."""
    cells = []
    for task in tasks:
        env = f"delayrl/{task}-v4"
        for delay in (5, 25, 50, "paper-stochastic-5"):
            cells += [standing(agent, env, delay, seeds) for agent in QUALITY if agent not in ("sac", "random")]
        for representation in ("mlp", "transformer-no-belief"):
            cells.append(standing("vdpo", env, 5, seeds, overrides={"representation": representation}))
        cells += [standing("sac", env, 0, seeds), standing("random", env, 0, seeds)]
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
