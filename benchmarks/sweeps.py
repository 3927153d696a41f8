"""Returns of one policy at every constant delay that it serves, from the rows of `collect.py … --every-delay`."""

from pathlib import Path

import jsonl
import numpy as np
from matplotlib import pyplot
from numpy.typing import NDArray

from delayrl.report.markup import markdown_table

Sweeps = dict[str, NDArray[np.float64]]
"""Mean returns by agent, [seeds, delays]; the delays are 0, 1, …"""
SHOWN = 5
"""Every so many delays have a row of the table."""


def read(file: Path) -> Sweeps:
    """Return the mean returns in a file of rows."""
    returns: dict[str, dict[int, dict[int, float]]] = {}
    for line in jsonl.read(file):
        if "sweep" in line:
            found = line["sweep"]
            runs = returns.setdefault(found["agent"], {})
            runs.setdefault(line["run"], {})[found["delay"]] = found["mean_return"]
    return {
        agent: np.array([[run[d] for d in sorted(run)] for run in runs.values()]) for agent, runs in returns.items()
    }


def draw(sweeps: Sweeps, title: str, out: Path, colours: dict[str, str]) -> None:
    """Draw return against delay for the agents that have a colour: the mean over seeds, a thin line for each seed."""
    figure, axes = pyplot.subplots(figsize=(7.5, 4), layout="constrained")
    for agent, seeds in sweeps.items():
        if agent in colours:
            delays = np.arange(seeds.shape[1])
            axes.plot(delays, seeds.T, color=colours[agent], alpha=0.25, linewidth=1)
            axes.plot(delays, seeds.mean(0), color=colours[agent], linewidth=2.2, marker="o", label=agent)
    axes.set(xlabel="constant delay in evaluation (steps)", ylabel="return", title=title)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(out, dpi=140)
    pyplot.close(figure)


def table(seeds: NDArray[np.float64]) -> str:
    """Return a Markdown table of one agent's means by delay, each as a part of the best one's too. All are above 0."""
    means, deviations = seeds.mean(0), seeds.std(0, ddof=1)
    shown = sorted({*range(0, len(means), SHOWN), len(means) - 1, int(means.argmin()), int(means.argmax())})
    rows = [[str(d), f"{means[d]:,.0f} ± {deviations[d]:,.0f}", f"{means[d] / means.max():.2f}"] for d in shown]
    return markdown_table(["Δ in evaluation", "mean return", "part of the best"], rows)


def section(file: Path, agent: str) -> str:
    """Return the table of one agent's rows, with what made them."""
    lines = jsonl.read(file)
    config = next(line["config"] for line in lines if "config" in line)
    episodes = next(line["sweep"]["episodes"] for line in lines if "sweep" in line)
    versions, seeds = config["versions"], read(file)[agent]
    steps = f"{config['schedule']['steps']:,} steps, {len(seeds)} seeds, {episodes} episodes each"
    made = (
        f"{config['env']}, trained under {config['delay']}, preset `{config['preset']}`, {steps} on start states that "
    )
    made += "the run never saw; ± is the standard deviation over seeds. "
    made += f"{versions['cores']} x86 cores, jax {versions['jax']}, MuJoCo {versions['mujoco']}, "
    made += f"commit {versions['commit']}. Rows: `benchmarks/results/{file.name}`."
    return f"{table(seeds)}\n\n{made}"
