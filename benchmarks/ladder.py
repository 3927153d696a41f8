"""The ladder of any-age: what each part brings, from the rows of the grid `any-age-ladder`; cells that have ended."""

from pathlib import Path

import numpy as np
from learning.curves import curve, difference, spread
from matplotlib import pyplot

from delayrl.bench.results import read_table
from delayrl.report import statistics
from delayrl.report.results import Result
from delayrl.report.summary import summarise

AWAY = 1_500
"""Seeds that end above this return have left the gaits on the back or creeping, at 900 to 1,450."""
BASE = "bpql"


def section(files: list[Path], picture: Path) -> str:
    """Draw the curves, and return the table with what made it."""
    files_read, results = [read_table(file) for file in files], []
    for collected in files_read:
        cells = [(cell, progress) for cell, progress in collected.standing if progress.state == "done"]
        results += [r for r in summarise(collected.rows, cells, collected.configs).results.values() if r.runs]
    learners = sorted((r for r in results if r.condition.agent != "random"), key=lambda r: -area(r).mean())
    draw(learners, picture)
    versions = files_read[0].versions[0]
    made = f"{versions['cores']} x86 cores, jax {versions['jax']}, MuJoCo {versions['mujoco']}"
    return f"{table(learners)}\n\n{made}. Rows: {', '.join(f'`benchmarks/results/{file.name}`' for file in files)}."


def area(result: Result) -> statistics.Floats:
    """Return each seed's mean return over training."""
    return statistics.area(*result.curves)


def name(result: Result) -> str:
    """Return the arm in words: the agent, its delay if none, its preset if another, and its options."""
    condition = result.condition
    words = [f"`{condition.agent}`", *(["no delay"] if result.place.delay == 0 else [])]
    if condition.preset == "paper":
        return ", ".join([*words, "its released settings"])
    return ", ".join([*words, *(f"`{k}={v}`" for k, v in condition.overrides.items() if k != "precision")])


def table(results: list[Result]) -> str:
    """Return a Markdown table of the arms, compared with BPQL on the same SAC."""
    base = next((area(r) for r in results if name(r) == f"`{BASE}`"), None)
    head = ["arm", "seeds", "mean return over training", "times BPQL's", "difference, 95 % interval", "at the end"]
    head += [f"seeds above {AWAY:,}", "GFLOP a step"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for result in results:
        own, final = area(result), result.curves.final
        compared = base is not None and name(result) != f"`{BASE}`"
        times = f"{own.mean() / base.mean():.2f}" if compared and base is not None else ""
        apart = difference(own, base) if compared else ""
        cells = [name(result), str(result.runs), spread(own), times, apart, spread(final)]
        cost = f"{result.cost.flops / 1e9:.2f}" if result.cost else ""
        lines.append("| " + " | ".join([*cells, f"{int((final > AWAY).sum())} of {final.size}", cost]) + " |")
    return "\n".join(lines)


def draw(results: list[Result], out: Path) -> None:
    """Draw the curves of the arms in one picture."""
    figure, axes = pyplot.subplots(figsize=(8, 4.4), layout="constrained")
    for number, result in enumerate(results):
        steps, returns = result.curves
        curve(axes, steps, returns, f"C{number % 10}").set_label(name(result).replace("`", ""))
    axes.set_title("HalfCheetah-v5, 25 steps late, five seeds")
    axes.set_ylim(bottom=min(0, float(np.min([r.curves.mean.min() for r in results]))))
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=130)
    pyplot.close(figure)
