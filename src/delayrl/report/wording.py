"""Numbers and sentences that Markdown and page share."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from delayrl.errors import count
from delayrl.report.comparisons import Comparison
from delayrl.report.results import Anchor, Result, Setting, agent_order
from delayrl.report.statistics import FEWEST, SMOOTHED, mean_std
from delayrl.report.summary import Aggregate, Summary
from delayrl.report.tables import Table, TableEntry
from delayrl.run.cell import CellState
from delayrl.run.cost import Cost
from delayrl.run.rows import number_in_words, shown_like, unsigned_zero

PAPER = (
    "Paper: Wu et al., Variational Delayed Policy Optimization, NeurIPS 2024; 10 seeds, 1,000,000 steps. It states no "
    "protocol; its released code has the habits of `official`."
)


def number(value: float, like: float | None = None) -> str:
    """Write a return with about three digits, or with as many decimals as `like` gets."""
    if math.isnan(value):
        return ""
    size = abs(value if like is None else like)
    return number_in_words(value, like, least=0 if size >= 1000 else 1 if size >= 10 else 2)


def normalised(value: float) -> str:
    """Write a normalised return; 0.00 has no sign."""
    return unsigned_zero(f"{value:.2f}")


def steps(value: float) -> str:
    """Write environment steps, large numbers in millions as the paper does, with a third decimal where there is one."""
    if math.isnan(value) or value < 1e5:
        return "" if math.isnan(value) else f"{value:,.0f}"
    return f"{value / 1e6:.3f}".removesuffix("0") + "M"


def spread(value: float, std: float, write: Callable[[float], str] | None = None) -> str:
    """Write mean ± standard deviation, by default with equally many decimals; a deviation of NaN is left out."""
    write = write or partial(number, like=shown_like(value, std))
    return "" if math.isnan(value) else write(value) + ("" if math.isnan(std) else f" ± {write(std)}")


def anchor(anchor: Anchor) -> str:
    """Write an anchor's value with its spread and number of seeds; empty if there is none."""
    seeds = count(anchor.returns.size, "seed")
    return f"{spread(*mean_std(anchor.returns))} ({seeds})" if anchor.returns.size else ""


def threshold(result: Result) -> str:
    """Write what the steps to Ret_df lead to: the smoothed return of which reference; empty if there is none."""
    anchor = result.threshold_anchor
    if not anchor.smoothed.size:
        return ""
    return f"{spread(*mean_std(anchor.smoothed))} ({anchor.source}, {anchor.steps:,} steps)"


def interval(bounds: tuple[float, float], write: Callable[[float], str]) -> str:
    """Write a 95 % interval, with × for a threshold that is not reached; empty if it is unknown, or reaches nothing."""
    low, high = bounds
    if math.isnan(low) or math.isinf(low):
        return ""
    return f"{write(low)} to {'×' if math.isinf(high) else write(high)}"


class EntryTexts(NamedTuple):
    """The lines of a table's entry; empty where there is nothing to say."""

    ours: str
    interval: str
    area: str
    raw: str
    note: str
    theirs: str


def entry_texts(table: Table, entry: TableEntry) -> EntryTexts:
    """Write our value, its interval, the area under the curve, the raw return, the note and the paper's value."""
    write = steps if table.kind == "steps" else normalised
    ours = "×" if entry.missed else spread(entry.value, entry.std, write)
    area = spread(entry.area, entry.area_std, normalised)
    published = entry.published
    theirs = "" if published is None else spread(published.value, published.std, write) or "×"
    raw = spread(entry.raw, entry.raw_std)
    return EntryTexts(ours, interval(entry.interval, write), area, raw, entry.note, theirs)


def captions(tables: Iterable[Table]) -> Iterator[str]:
    """Say what stands in the entries of each table of a setting; where one above has the same, name that one."""
    said: dict[str, str] = {}
    for table in tables:
        first = said.setdefault(caption(table), table.title)
        yield caption(table) if first == table.title else f"Entries are written as in “{first}”."


def caption(table: Table) -> str:
    """Say what stands in a table's entries."""
    if table.kind == "steps":
        return (
            "First evaluation at which the mean over seeds reaches that of delay-free SAC after training (×: none), "
            f"both averaged over the last {SMOOTHED} evaluations; its 95 % interval; how many seeds reach it. "
            "Where no delay-free SAC has as many steps, the reference has more, and its steps are noted. "
            "Raw: return after the last step."
        )
    return (
        "Final return, mean ± standard deviation over seeds; 95 % interval of the mean, with the anchors' uncertainty "
        f"(with fewer than {FEWEST} seeds about their range, which covers less: 75 % with three). "
        "Area: normalised mean return over training. Raw: return after the last step."
    )


CELLS_CAPTION = (
    "Tables above leave out rows and columns without a number; here are all. Returns after the last step. Hours: of "
    "one worker, on a CPU one core, for all seeds together, at the speed since its last start (of an unfinished cell, "
    "since its first update after it), beside whatever else the machine did. Steps to Ret_df: to the threshold in the "
    "table of anchors."
)
AGGREGATE_CAPTION = (
    "Over all tasks, with as many runs of each as the one with fewest has; 95 % interval. Agents that lack a task on "
    "which another has ended at this delay are left out, because means over different tasks cannot be compared, and so "
    "are results with a failed run."
)
COMPARISON_CAPTION = (
    "How probable it is that a run of the row's agent ends above a run of the column's on the same task, in the mean "
    "over the tasks that both have ended on. The 95 % interval is a bootstrap over runs within their task. A "
    "probability is bold where it excludes 0.5. Near 0 and 1 its interval is too narrow: 1.00 to 1.00 says only that "
    "no run of the one ended below one of the other. Below stands the difference of the mean normalised returns, with "
    "the anchors' uncertainty, where all these tasks have anchors. With fewer than "
    f"{FEWEST} runs of either agent on a task neither has an interval. Of many comparisons some are bold by chance. "
    "Results with a failed run are left out."
)


def comparison_texts(comparison: Comparison) -> tuple[str, str, str, str]:
    """Write the probability, its interval, the difference of normalised returns with its own, and what they rest on."""
    p, d = comparison.probability, comparison.difference
    within = interval((d.low, d.high), signed)
    difference = "" if math.isnan(d.value) else signed(d.value) + (f" ({within})" if within else "")
    one, other = comparison.runs
    counts = f"{tasks(comparison.tasks, comparison.delay)}, {one} and {other} runs"
    return normalised(p.value), interval((p.low, p.high), normalised), difference, counts


def aggregate_counts(a: Aggregate) -> str:
    """Write what an aggregate rests on."""
    return f"{tasks(a.tasks, a.delay)}, {count(a.runs, 'run')}"


def tasks(number: int, delay: int | str | None) -> str:
    """Write a number of tasks at a delay, or of conditions at all constant ones."""
    return count(number, "condition" if delay is None else "task")


def delay(delay: int | str | None) -> str:
    """Write a delay, or that all constant ones are together."""
    return "all constant" if delay is None else str(delay)


def hours(value: float) -> str:
    """Write hours with two digits or more; empty if they are unknown."""
    if math.isnan(value):
        return ""
    return "< 0.01" if value < 0.01 else f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def signed(value: float) -> str:
    """Write a difference of normalised returns; 0.00 has no sign."""
    text = f"{value:+.2f}"
    return text if float(text) else normalised(0)


COST_HEAD = ("Agent", "Reads the true state", "Parameters", "Gradient steps", "Batch", "FLOP")
COST_CAPTION = (
    "Of one seed, per environment step from the first update on: steps of each optimiser, and multiplications and "
    "additions of the updates' matrix products. Ranges are over tasks and delays."
)


def costs(summary: Summary, setting: Setting) -> Sequence[tuple[str, ...]]:
    """Write a line for each agent that learns and whose cost is known, in the columns of COST_HEAD."""
    known: dict[str, list[Result]] = {}
    for place, result in summary.results.items():
        if place.setting == setting and result.cost and result.cost.batches:
            known.setdefault(place.label, []).append(result)
    lines = []
    for label in sorted(known, key=agent_order):
        costs = [result.cost for result in known[label] if result.cost]
        steps = " or ".join(dict.fromkeys(gradient_steps(cost) for cost in costs))
        batches = " or ".join(dict.fromkeys(", ".join(dict.fromkeys(map(str, cost.batches))) for cost in costs))
        parameters, flops = _range([cost.parameters for cost in costs]), _range([cost.flops for cost in costs])
        privileged = "in training" if any(result.privileged for result in known[label]) else "no"
        lines.append((summary.name(label), privileged, parameters, steps, batches, flops))
    return lines


def gradient_steps(cost: Cost) -> str:
    """Write how often each optimiser steps; those that step alike are together."""
    names: dict[float, list[str]] = {}
    for name, number in cost.gradient_steps.items():
        names.setdefault(float(f"{number:.2g}"), []).append(name)
    return "; ".join(f"{number:g} × {', '.join(alike)}" for number, alike in sorted(names.items(), reverse=True))


def _range(values: Sequence[float]) -> str:
    if any(math.isnan(value) for value in values):
        return "unknown"
    return " to ".join(dict.fromkeys(_short(value) for value in (min(values), max(values))))


def _short(value: float) -> str:
    """Write a large number with three digits and k, M, G or T."""
    value = float(f"{value:.3g}")
    power = min(4, int(math.log10(value)) // 3) if value >= 1 else 0
    return f"{value / 1000**power:g}{('', 'k', 'M', 'G', 'T')[power]}"


def source(table: Table) -> str:
    """Name the paper's tables that the published values of a table are from; empty if it has none."""
    numbers = sorted({entry.published.table for entry in table.entries.values() if entry.published})
    return f"Paper: Table{'s' * (len(numbers) > 1)} {', '.join(numbers)}." if numbers else ""


def paper(summary: Summary) -> str:
    """Name the paper if a table shows values of it."""
    return PAPER if any(source(table) for table in summary.tables) else ""


def states(summary: Summary) -> str:
    """Write how many results are in each state."""
    number_of = Counter(result.progress.state for result in summary.results.values())
    order: tuple[CellState, ...] = ("done", "running", "begun", "failed", "todo")
    parts = [f"{number_of[state]} {state}" for state in order if number_of[state]]
    return f"{count(len(summary.results), 'result')}: {', '.join(parts)}"


def overrides(summary: Summary) -> list[str]:
    """Write the overrides that all cells of an agent share, or all of a task, a sentence for agents that agree."""
    agents_with: dict[tuple[str, str], list[str]] = {}
    for (agent, env), values in summary.shared.items():
        words = f" on {env}" if env else ""
        agents_with.setdefault((words, ", ".join(f"{k}={v}" for k, v in sorted(values.items()))), []).append(agent)
    return [
        f"Overridden in all cells of {', '.join(sorted(agents))}{words}: {values}."
        for (words, values), agents in agents_with.items()
    ]


def raw(summary: Summary) -> list[str]:
    """Write on which tasks returns are not normalised, and why."""
    tasks: dict[str, list[str]] = {}
    for result in summary.results.values():
        random, reference = result.random_anchor.value, result.reference_anchor.value
        if result.is_anchor or not result.runs or reference > random:
            continue
        why = f"SAC without a delay ({number(reference)}) is not better than the random policy ({number(random)})"
        if math.isnan(random) or math.isnan(reference):
            why = "SAC without a delay has not ended under this protocol, preset and length"
            if math.isnan(random):
                why = "the random policy has no rows of this protocol"
        tasks.setdefault(why, []).append(result.place.env)
    return [f"Returns on {', '.join(dict.fromkeys(own))} are not normalised: {why}." for why, own in tasks.items()]


def remarks(summary: Summary) -> list[str]:
    """Write what must be known of all results: rows left out, raw returns, what changed, overrides."""
    line = f"{summary.unplaced:,} rows belong to no cell of the grid; they are left out."
    left_out = [line] if summary.unplaced else []
    changed = [
        f"The simulated model of {env} is not the same in all rows, under one version of MuJoCo: returns of different "
        "tasks stand together."
        for env in summary.changed
    ]
    recoded = [
        f"The modules of {agent} changed between its runs: returns of different agents may stand together."
        for agent in summary.recoded
    ]
    return left_out + raw(summary) + changed + recoded + overrides(summary)


def made_with(versions: Sequence[Mapping[str, Any]]) -> list[str]:
    """Write a sentence for each machine and set of libraries; commits that differ in nothing else share one."""
    commits: dict[str, list[str]] = {}
    for used in versions:
        kind = f" ({used['processor']})" if used.get("processor") else ""
        hardware = f"{used.get('device')}, {used.get('cores')} cores, {used.get('machine')}{kind}"
        names = ("python", "jax", "mujoco", "gymnasium")
        libraries = ", ".join(f"{name} {used[name]}" for name in names if used.get(name))
        commits.setdefault(f"Made on {hardware}; {libraries}", []).append(str(used.get("commit") or "unknown"))
    return [f"{words}; commit {', '.join(dict.fromkeys(hashes))}." for words, hashes in commits.items()]


def seeds(results: Iterable[Result]) -> str:
    """Write how many seeds the results have."""
    counts = sorted({result.seeds for result in results})
    return count(counts[0], "seed") if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"
