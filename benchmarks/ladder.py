"""The ladder of any-age: what each part brings, from the rows of the grid `any-age-ladder`; cells that have ended.

All arms have the seeds 0 to n - 1. Arms of one seed begin with the same random actions, and with the same actor if they
have one encoder.
"""

from pathlib import Path

import numpy as np
from learning.curves import curve, difference, spread
from matplotlib import pyplot
from scipy import stats

from delayrl.bench.results import read_table
from delayrl.report import statistics
from delayrl.report.markdown import markdown_table
from delayrl.report.results import Result
from delayrl.report.summary import summarise
from delayrl.report.wording import interval, normalised

AWAY = 1_500
"""Seeds that end above this return have left the gaits on the back or creeping, at 700 to 1,470."""
BASE, WHOLE = "`bpql`", "`any-age`"


FRONT = {
    "`sac`, no delay": "#8c8c8c",
    "`any-age`": "#1f6feb",
    "`bpql`, `critic_norm=layer`": "#9a6700",
    "`bpql`": "#1a7f37",
}
"""The arms on the first page, and their colours."""


def sections(files: list[Path], pictures: Path) -> tuple[str, str]:
    """Draw the curves; return the table of all arms, and that of the first page, with what made them."""
    files_read, results = [read_table(file) for file in files], []
    for collected in files_read:
        cells = [(cell, progress) for cell, progress in collected.standing if progress.state == "done"]
        results += [r for r in summarise(collected.rows, cells, collected.configs).results.values() if r.runs]
    learners = sorted((r for r in results if r.condition.agent != "random"), key=lambda r: -area(r).mean())
    draw([(f"C{number % 10}", r) for number, r in enumerate(learners)], pictures / "ladder.png")
    shown = [r for r in learners if name(r) in FRONT]
    draw([(FRONT[name(r)], r) for r in shown], pictures / "halfcheetah.png")
    every = [used for collected in files_read for used in collected.versions]
    words = [f"{v['cores']} x86 cores, jax {v['jax']}, MuJoCo {v['mujoco']}" for v in every]
    rows = ", ".join(f"`benchmarks/results/{file.name}`" for file in files)
    made = "HalfCheetah-v5, preset `matched` with `--precision bfloat16`. ± is the standard deviation over seeds, each "
    made += f"of ten episodes. {'; '.join(dict.fromkeys(words))}. Rows: {rows}."
    commits = ", ".join(dict.fromkeys(str(used["commit"]) for used in every))
    return f"{table(learners)}\n\n{made} Commits: {commits}.", f"{front(shown)}\n\n{made}"


def front(results: list[Result]) -> str:
    """Return the table of the first page."""
    head = ["agent", "delay", "normalised, 95 % interval", "return at the end", "each seed", "steps", "GFLOP a step"]
    body = []
    for result in results:
        seeds = " · ".join(f"{value:,.0f}" for value in result.curves.final)
        mean, within = result.final.mean(), interval(result.final_interval, normalised)
        score = "" if np.isnan(mean) else normalised(mean) + (f" ({within})" if within else "")
        cells = [name(result), str(result.place.delay), score, spread(result.curves.final), seeds]
        body.append([*cells, f"{result.condition.steps:,}", gflop(result)])
    return markdown_table(head, body)


def gflop(result: Result) -> str:
    """Write the arithmetic of a step; empty if it is unknown."""
    return f"{result.cost.flops / 1e9:.2f}" if result.cost else ""


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
    """Return a Markdown table of the arms, compared with BPQL on the same SAC, and any-age with its other arms."""
    areas = {name(r): area(r) for r in results}
    base, whole = areas.get(BASE), areas.get(WHOLE)
    head = ["arm", "seeds", "over training", "times BPQL's", "less BPQL's"]
    head += ["`any-age`'s less it, by seed", "at the end", f"above {AWAY:,}", "GFLOP"]
    body = []
    for result in results:
        arm, final = name(result), result.curves.final
        own, compared = areas[arm], base is not None and arm != BASE
        times = f"{own.mean() / base.mean():.2f}" if compared and base is not None else ""
        apart = difference(own, base) if compared else ""
        changed = result.condition.agent == "any-age" and arm != WHOLE and whole is not None
        cells = [arm, str(result.runs), spread(own), times, apart, paired(whole, own) if changed else ""]
        body.append([*cells, spread(final), f"{int((final > AWAY).sum())} of {final.size}", gflop(result)])
    return markdown_table(head, body)


def paired(one: statistics.Floats, other: statistics.Floats) -> str:
    """Write the mean difference over the seeds that both have, with its 95 % interval by Student's t."""
    shared = min(one.size, other.size)
    gaps = one[:shared] - other[:shared]
    half = stats.t.ppf(0.975, shared - 1) * stats.sem(gaps)
    return f"{gaps.mean():+,.0f} ({gaps.mean() - half:+,.0f} to {gaps.mean() + half:+,.0f})"


def draw(arms: list[tuple[str, Result]], out: Path) -> None:
    """Draw the curves of the arms, each in its colour, in one picture."""
    figure, axes = pyplot.subplots(figsize=(8, 4.4), layout="constrained")
    for colour, result in arms:
        curve(axes, *result.curves, colour).set_label(name(result).replace("`", ""))
    axes.set_title("HalfCheetah-v5, 25 steps late unless said")
    axes.set_ylim(bottom=min(0, float(np.min([r.curves.mean.min() for _, r in arms]))))
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=130)
    pyplot.close(figure)
