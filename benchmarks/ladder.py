"""The ladder of any-age: what each part brings, from the rows of its grids; cells that have ended.

All arms have the seeds 0 to n - 1. An arm's *base*, with which it is compared, is any-age with its batches, or BPQL.
Arms of one seed begin with the same random actions, and with the same actor if they have one encoder.
"""

import functools
import itertools
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonl
import numpy as np
from learning.curves import bold, curve, difference, spread
from matplotlib import pyplot
from scipy import stats

from delayrl.bench import results as bench
from delayrl.bench.results import Collected
from delayrl.errors import DelayRLError
from delayrl.report import statistics
from delayrl.report.figures import STYLES
from delayrl.report.markup import markdown_table
from delayrl.report.results import Result
from delayrl.report.summary import summarise
from delayrl.run.cell import Cell
from delayrl.run.condition import Condition
from delayrl.run.folder import versions_in

read_table = functools.cache(bench.read_table)
"""Several sections of the pages read the same files."""
AWAY = 1_500
"""Seeds that end above this return have left the gaits on the back or creeping, at 700 to 1,480."""
BASE, WHOLE, SAC = "`bpql`", "`any-age`", "`sac`, no delay"
HALF = "`bpql`, `batch_size=128`, `critic_norm=layer`"
"""BPQL with any-age's critics and batches of 128."""
TWICE = "`any-age`, `batch_size=128`, `updates=2`"
"""As much arithmetic as WHOLE: batches of 128, two updates a step."""
BATCH = "`any-age`, `batch_size=128`, `critic_norm=batch`"
"""Any-age's best arm at a constant delay."""
BPQL_BATCH, SAC_BATCH = BATCH.replace("any-age", "bpql"), BATCH.replace("`any-age`", SAC)
GOALS = [
    (WHOLE, "`bpql`, its released settings", "1.5"),
    (WHOLE, BASE, ""),
    (WHOLE, "`bpql`, `critic_norm=layer`", "1.15"),
    (WHOLE, "`bpql`, preset `small`", ""),
    ("`any-age`, `critic_norm=none`", BASE, "1.15"),
    ("`any-age`, `batch_size=128`", "`bpql`, `batch_size=128`", ""),
    (WHOLE, HALF, "1.15"),
    ("`any-age`, `batch_size=128`", HALF, "1.15"),
    ("`any-age`, `batch_size=128`, `encoder=mlp`", HALF, ""),
    (WHOLE, "`sac`, no delay, `critic_norm=layer`", "0.75"),
    (WHOLE, "`sac`, no delay", ""),
    (TWICE, "`bpql`, its released settings", "1.5"),
    (TWICE, "`bpql`, `batch_size=128`, `updates=2`", ""),
    (TWICE, "`any-age`, `batch_size=128`", ""),
    (TWICE, WHOLE, ""),
    (TWICE, "`sac`, no delay, `critic_norm=layer`", ""),
    (TWICE, "`sac`, no delay", ""),
    (BATCH, "`bpql`, its released settings", "1.5"),
    (BATCH, WHOLE, ""),
    (BATCH, "`any-age`, `batch_size=128`", ""),
    (BATCH, HALF, ""),
    (BATCH, BPQL_BATCH, "1.15"),
    (BATCH, "`sac`, no delay, `critic_norm=layer`", ""),
    (BATCH, SAC_BATCH, "0.75"),
    (BATCH, "`sac`, no delay, `critic_norm=batch`", ""),
    (BPQL_BATCH, "`bpql`, its released settings", ""),
    (BPQL_BATCH, HALF, ""),
    (BPQL_BATCH, "`sac`, no delay, `critic_norm=layer`", ""),
    (BPQL_BATCH, SAC_BATCH, ""),
]
"""Two arms, and the ratio of their returns that is aimed at."""


def sections(file: Path, picture: Path) -> tuple[str, str]:
    """Draw the curves; return the tables of all arms, with what made them, and of the goals."""
    collected = read_table(file)
    cells = [(cell, progress) for cell, progress in collected.standing if progress.state == "done"]
    check_seeds(cell for cell, _ in cells)
    found = summarise(collected.rows, cells, collected.configs).results.values()
    results = [result for result in found if result.runs]
    learners = sorted((r for r in results if r.condition.agent != "random"), key=lambda r: -area(r).mean())
    draw(learners, picture)
    every = [used for *_, own in trained_with(collected) for used in own]
    made = "HalfCheetah-v5, preset `matched` unless said, `--precision bfloat16`. ± is the standard deviation over "
    made += f"seeds, each of ten episodes. {made_on(every)} {rows_of([file], [collected])}"
    commits = ", ".join(dict.fromkeys(str(used["commit"]) for used in every))
    times = update_times(file.parent / "arms.jsonl")
    return f"{table(learners, times)}\n\n{made} Commits: {commits}.", goals(learners)


def check_seeds(cells: Iterable[Cell]) -> None:
    """Raise DelayRLError where an arm has other seeds than 0 to n - 1, each once: seeds are paired by their place."""
    seeds: dict[str, list[int]] = defaultdict(list)
    for cell in cells:
        seeds[arm(cell.condition)] += cell.seeds
    for words, own in seeds.items():
        if sorted(own) != [*range(len(own))]:
            raise DelayRLError(f"{words} has ended for seeds {sorted(own)}: each from 0 on is needed, and once")


def made_on(used: list[dict[str, Any]]) -> str:
    """Write the hardware and libraries that rows were made with, each once."""
    words = dict.fromkeys(f"{v['cores']} x86 cores, jax {v['jax']}, MuJoCo {v['mujoco']}" for v in used)
    return f"{'; '.join(words)}."


def rows_of(files: list[Path], tables: list[Collected]) -> str:
    """Write where rows are, with how many cells of each grid have ended."""
    states = [[progress.state for _, progress in table.standing] for table in tables]
    counted = (f"{of_grid.count('done')} of {len(of_grid)}" for of_grid in states)
    named = (f"`benchmarks/results/{file.name}` ({n})" for file, n in zip(files, counted, strict=True))
    return f"Rows, and cells that have ended: {', '.join(named)}."


def trained_with(table: Collected) -> list[tuple[Condition, bool, list[dict[str, Any]]]]:
    """Return the condition of each run whose cell has ended, whether it is privileged, and what it was trained with."""
    ended = {cell.id: cell.condition for cell, progress in table.standing if progress.state == "done"}
    runs = (config for config in table.configs if config["cell"] in ended)
    return [(ended[run["cell"]], run["privileged"], versions_in(run)) for run in runs]


def gflop(result: Result) -> str:
    """Write the arithmetic of a step; empty if it is unknown."""
    return f"{result.cost.flops / 1e9:.2f}" if result.cost else ""


def area(result: Result) -> statistics.Floats:
    """Return each seed's mean return over training."""
    return statistics.area(*result.curves)


def name(result: Result) -> str:
    """Return the arm in words."""
    return arm(result.condition)


def arm(condition: Condition) -> str:
    """Return an arm in words: the agent, its delay if none, its preset if another, and its options."""
    words = [f"`{condition.agent}`", *(["no delay"] if condition.delay == 0 else [])]
    if condition.preset != "matched":
        return ", ".join([*words, "its released settings" if condition.preset == "paper" else "preset `small`"])
    return ", ".join([*words, *(f"`{k}={v}`" for k, v in sorted(condition.overrides.items()) if k != "precision")])


def base_of(result: Result) -> str:
    """Return the arm that an arm is compared with: any-age with its batches, for those BPQL; none for BPQL and SAC.

    That of BPQL with batch norm is BPQL with layer norm and as large batches. That of another encoder with a pull or
    a belief loss is this encoder alone.
    """
    agent, own, options = result.condition.agent, name(result), result.condition.overrides
    if "encoder" in options and {"pull_weight", "belief_weight"} & options.keys():
        more = ("pull_weight", "belief_weight", "second_age")
        return arm(replace(result.condition, overrides={k: v for k, v in options.items() if k not in more}))
    if agent == "sac" or own == BASE:
        return ""
    if own == BPQL_BATCH:
        return HALF
    if agent == "bpql" or own == WHOLE:
        return BASE
    size = options.get("batch_size")
    alike = f"{WHOLE}, `batch_size={size}`" if size else WHOLE
    return WHOLE if own == alike else alike


def table(results: list[Result], times: Mapping[str, tuple[float, float]] | None = None) -> str:
    """Return a Markdown table of the arms, each minus its base seed by seed.

    `times` has the milliseconds of each arm's update, and their ratio to BPQL's.
    """
    arms, times = {name(r): r for r in results}, times or {}
    head = ["arm", "over training", "minus its base", "at the end", "minus its base", f"above {AWAY:,}", "GFLOP"]
    body = []
    for result in results:
        cells, base = [name(result)], arms.get(base_of(result))
        for values in (area, lambda one: one.curves.final):
            cells += [spread(values(result)), bold(paired(values(result), values(base))) if base else ""]
        final = result.curves.final
        cells += [f"{int((final > AWAY).sum())} of {final.size}", gflop(result)]
        body.append([*cells, "{:.1f} ({:.2f})".format(*times[name(result)]) if name(result) in times else ""])
    return markdown_table([*head, "update, ms"], body)


def update_times(file: Path) -> dict[str, tuple[float, float]]:
    """Return the medians over the rounds of arms.py: of each arm's update in milliseconds, and of its ratio to BPQL's.

    Nothing without its rows.
    """
    rows = jsonl.read(file)[1:] if file.exists() else []
    known = {row["arm"]: np.array(row["ms"]) for row in rows}
    return {arm: (float(np.median(ms)), float(np.median(ms / known[BASE]))) for arm, ms in known.items()}


def goals(results: list[Result]) -> str:
    """Return a Markdown table of any-age's returns over those of other arms, beside what was to be reached."""
    arms = {name(r): r for r in results}
    head = ["arm", "over", "goal", "over training", "difference", "at the end", "difference"]
    body = []
    for one, other, goal in GOALS:
        if one in arms and other in arms:
            x, y = arms[one], arms[other]
            training = [ratio(area(x), area(y), x), difference(area(x), area(y))]
            end = [ratio(x.curves.final, y.curves.final, x), difference(x.curves.final, y.curves.final)]
            body.append([one, other, goal and f"≥ {goal}", *training, *end])
    return markdown_table(head, body)


def ratio(one: statistics.Floats, other: statistics.Floats, result: Result) -> str:
    """Write the ratio of two mean returns, each above the random policy's; empty if that has not run."""
    low = result.random_anchor.value
    return "" if np.isnan(low) else f"{(one.mean() - low) / (other.mean() - low):.2f}"


def paired(one: statistics.Floats, other: statistics.Floats) -> str:
    """Write the mean difference over the seeds that both have, with its 95 % interval by Student's t; empty for one."""
    shared = min(one.size, other.size)
    if shared < 2:
        return ""
    gaps = one[:shared] - other[:shared]
    half = stats.t.ppf(0.975, shared - 1) * stats.sem(gaps)
    return f"{gaps.mean():+,.0f} ({gaps.mean() - half:+,.0f} to {gaps.mean() + half:+,.0f})"


def draw(arms: list[Result], out: Path) -> None:
    """Draw a panel for each arm with a delay, in the order of the table: its seeds and their mean, beside two others.

    Dotted is SAC without a delay, dashed the arm's base.
    """
    late, known = [r for r in arms if r.condition.delay != 0], {name(r): r for r in arms}
    rows, columns = -(-len(late) // 5), 5
    figure, panels = pyplot.subplots(
        rows, columns, figsize=(11, 1.9 * rows), sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for number, (axes, result) in enumerate(itertools.zip_longest(panels.flat, late)):
        if result is None:
            axes.set_axis_off()
            continue
        for other, dashes in ((SAC, ":"), (base_of(result), "--")):
            if other in known:
                axes.plot(known[other].curves.steps, known[other].curves.mean, dashes, color="#444444", linewidth=1.2)
        colour = STYLES["bpql" if result.condition.agent == "bpql" else "any-age"][0]
        curve(axes, *result.curves, colour)
        axes.set(xlabel="", ylabel="", xticks=[0, 50_000, 100_000])
        axes.set_title(textwrap.fill(name(result).replace("`", ""), 30, break_long_words=False), fontsize=8)
        axes.tick_params(labelsize=8, labelbottom=number >= len(late) - columns)  # the last of its column
        axes.xaxis.set_major_formatter(lambda step, _: f"{step / 1000:.0f}")
    figure.supxlabel("thousands of environment steps", fontsize=9)
    figure.supylabel("return", fontsize=9)
    figure.savefig(out, dpi=110)
    pyplot.close(figure)
