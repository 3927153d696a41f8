"""Any-age beside other agents and simpler arms: the tables of differences in docs/algorithms/any-age-results.md."""

from collections.abc import Sequence
from pathlib import Path

import front
import numpy as np
from ladder import BATCH, area
from learning.curves import bold, difference, spread
from scipy import stats

from delayrl.report.markup import markdown_table
from delayrl.report.results import Result, delay_order
from delayrl.report.statistics import Floats
from delayrl.report.wording import normalised

ENV, OWN = "HalfCheetah-v5", "`any-age`"
PLAIN = "`any-age`, `critic_norm=none`"
"""Compared with the agents whose critics have no layer normalisation either."""
LEFT_OUT: dict[str, tuple[str, ...]] = {OWN: (), BATCH: ("any-age",), PLAIN: ("any-age", "critic_norm")}
"""The arms with tables of their own, and the words in the names of others that are left out of them."""
SIMPLER = (
    OWN,
    "`any-age`, `forecast_error=distance`",
    "`any-age`, `batch_size=128`",
    "`any-age`, `encoder=mlp`",
    "`any-age`, `batch_size=128`, `encoder=mlp`",
    "`bpql`, `critic_norm=layer`",
    "`bpql`, `batch_size=128`, `critic_norm=layer`",
    BATCH,
    "`bpql`, `batch_size=128`, `critic_norm=batch`",
    "`bpql`",
)
WHERE: dict[str, front.Case] = {
    "5": (ENV, 5),
    "25": (ENV, 25),
    "50": (ENV, 50),
    "uniform:1:25": (ENV, "uniform:1:25"),
    "Hopper, 25": ("delayrl/Hopper-v4", 25),
    "pole on a pole, 5": ("InvertedDoublePendulum-v5", 5),
}
"""Arms of one table, any-age with its defaults first, and its columns: tasks and delays."""


def section(files: list[Path], env: str = ENV) -> str:
    """Return the tables of a task from the cells that have ended, with what their words mean."""
    rows = table(front.results_of(files), env)
    about = (
        f"{env}, preset `matched`, {front.STEPS[env]:,} steps, `--precision bfloat16`; {front.SEEDS} seeds where no "
        "other number is given. ± is the standard deviation over seeds, each of ten episodes; intervals are Welch's, "
        "of 95 %, and bold where they leave out 0. § stays clear after Holm's correction for all these differences, at "
        "the end and over training together. *Arithmetic* is that of a step of the other over any-age's."
    )
    if "†" in rows:
        about += " † acts on the true state while it trains; VDPO has `--tokens 1280`."
    return f"{rows}\n\n{about}"


def table(results: list[Result], env: str = ENV) -> str:
    """Return a Markdown table for each delay: a row for each other agent that has ended on the preset `matched`."""
    chosen: dict[tuple[str, int | str], Result] = {}
    for result in front.comparable(results):
        if result.place.env == env and result.place.delay != 0:
            chosen[front.name(result), result.place.delay] = result
    pairs = []
    for own_name, words in LEFT_OUT.items():
        for (name, delay), other in chosen.items():
            alike = not any(word in name for word in words)
            if alike and (own_name, delay) in chosen and own_name != name:
                pairs.append((delay, own_name, name, chosen[own_name, delay], other))
    pairs.sort(key=lambda pair: (delay_order(pair[0]), pair[1], -area(pair[-1]).mean()))
    at_the_end = [welch(own.curves.final, other.curves.final) for *_, own, other in pairs]
    clear = holm(at_the_end + [welch(area(own), area(other)) for *_, own, other in pairs])
    ends, areas = clear[: len(pairs)], clear[len(pairs) :]
    parts: dict[str, list[list[str]]] = {}
    for (delay, own_name, name, own, other), end, whole in zip(pairs, ends, areas, strict=True):
        cells = [name, ended_at(other), bold(difference(own.curves.final, other.curves.final)) + " §" * end]
        cells += [bold(difference(area(own), area(other))) + " §" * whole]
        ratio = f"{other.cost.flops / own.cost.flops:.2f}" if own.cost and other.cost else ""
        parts.setdefault(f"**Δ = {delay}**: {own_name} ends at {ended_at(own)}.", []).append([*cells, ratio])
    head = ["other agent", "ends at", "any-age minus it, at the end", "over training", "arithmetic"]
    return "\n\n".join(f"{title}\n\n{markdown_table(head, body)}" for title, body in parts.items())


def added(files: list[Path]) -> str:
    """Return the table of any-age's seeds in two halves: those of the plan, and those that were added later."""
    return added_table(front.results_of(files))


def added_table(results: list[Result], delay: int = 25) -> str:
    """Return a Markdown table of any-age's first and later seeds at a delay of ENV, minus each other agent.

    Another agent stands with the same seeds if it has them all, else with its own five.
    """
    here = [r for r in front.comparable(results) if (r.place.env, r.place.delay) == (ENV, delay)]
    chosen = {front.name(result): result for result in here if front.name(result) != PLAIN}
    own = chosen.pop(OWN)
    halves = slice(0, front.SEEDS), slice(front.SEEDS, own.runs)
    first, later = f"seeds 0 to {front.SEEDS - 1}", f"seeds {front.SEEDS} to {own.runs - 1}"
    head = [
        "other agent",
        *(f"{seeds}, {over}" for over in ("at the end", "over training") for seeds in (first, later)),
    ]
    body = []
    for name, other in sorted(chosen.items(), key=lambda item: -area(item[1]).mean()):
        cells = []
        for one, two in ((own.curves.final, other.curves.final), (area(own), area(other))):
            cells += [bold(difference(one[half], two[half] if two.size == one.size else two)) for half in halves]
        body.append([name, *cells])
    return markdown_table(head, body)


def simpler(files: list[Path]) -> str:
    """Return the table of any-age's simpler arms, with what its marks mean."""
    about = (
        "Delays in steps, on HalfCheetah if no task is named. The cells are normalised returns at the end: 0 is the "
        "random policy, 1 SAC without a delay. ↓ is clearly below any-age with its defaults, whose line is the first, "
        "and (↓) over training alone; ↑ and (↑) are above it, by Welch's interval of 95 % for each cell, without a "
        "correction for their number. *Arithmetic* is that of a step over any-age's. An empty cell has not run."
    )
    return f"{simpler_table(front.results_of(files))}\n\n{about}"


def simpler_table(results: list[Result]) -> str:
    """Return a Markdown table: a row for each of SIMPLER, a column for each of WHERE."""
    here = front.comparable(results)
    chosen = {(front.name(result), (result.place.env, result.place.delay)): result for result in here}
    body = []
    for name in SIMPLER:
        pairs = [(chosen.get((name, case)), chosen.get((OWN, case))) for case in WHERE.values()]
        costs = [(one.cost, own.cost) for one, own in pairs if one and own]
        price = [f"{one.flops / own.flops:.2f}" for one, own in costs if one and own]
        body.append([name, price[0] if price else "", *(beside(one, own) for one, own in pairs)])
    return markdown_table(["arm", "arithmetic", *WHERE], body)


def beside(result: Result | None, own: Result | None) -> str:
    """Write a normalised return, marked where it is clearly below or above any-age's; empty for what has not run."""
    if result is None:
        return ""
    score = normalised(result.final.mean())
    if own is None or own is result:
        return score
    at_the_end = ("↓", "↑"), result.curves.final, own.curves.final
    over_training = ("(↓)", "(↑)"), area(result), area(own)
    for (lower, higher), one, other in (at_the_end, over_training):
        if welch(one, other) <= 0.05:
            return f"{score}&nbsp;{higher if one.mean() > other.mean() else lower}"
    return score


def welch(one: Floats, other: Floats) -> float:
    """Return the p-value of a difference of the means."""
    return float(stats.ttest_ind(one, other, equal_var=False).pvalue)


def holm(values: Sequence[float]) -> list[bool]:
    """Return which p-values stay below 5 % after Holm's correction for all of them (Holm, 1979)."""
    clear = [False] * len(values)
    for passed, index in enumerate(np.argsort(values)):
        if not values[index] <= 0.05 / (len(values) - passed):  # nor is what cannot be known
            break
        clear[index] = True
    return clear


def ended_at(result: Result) -> str:
    """Write the returns at the end, with the number of seeds if it is another than usual."""
    return spread(result.curves.final) + front.seeds(result)
