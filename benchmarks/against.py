"""Any-age beside other agents and simpler arms: the tables of differences in docs/algorithms/any-age.md."""

import re
from collections.abc import Sequence
from pathlib import Path

import front
import numpy as np
from ladder import area, read_table
from learning.curves import difference, spread
from scipy import stats
from which import results_of

from delayrl.report.markup import markdown_table
from delayrl.report.results import Result, delay_order
from delayrl.report.statistics import Floats
from delayrl.report.wording import normalised

ENV, OWN = "HalfCheetah-v5", "`any-age`"
PLAIN = "`any-age`, `critic_norm=none`"
"""Compared with the agents whose critics have no layer normalisation either."""
VARIANTS = (
    PLAIN,
    "`any-age`, `encoder=mlp`",
    "`any-age`, `forecast_learns_from=states+values`",
    "`any-age`, `forecast_error=distance`",
    "`bpql`, `batch_size=128`",
    "`bpql`, `batch_size=128`, `critic_norm=layer`",
    "`any-age`, `batch_size=128`",
    "`any-age`, `batch_size=128`, `encoder=mlp`",
)
"""Shown beside the arms of the first page."""
SIMPLER = (
    OWN,
    "`any-age`, `forecast_error=distance`",
    "`any-age`, `batch_size=128`",
    "`any-age`, `encoder=mlp`",
    "`any-age`, `batch_size=128`, `encoder=mlp`",
    "`bpql`, `critic_norm=layer`",
    "`bpql`, `batch_size=128`, `critic_norm=layer`",
    "`bpql`",
)
WHERE: tuple[tuple[str, int | str], ...] = (
    (ENV, 5),
    (ENV, 25),
    (ENV, 50),
    (ENV, "uniform:1:25"),
    ("delayrl/Hopper-v4", 25),
    ("InvertedDoublePendulum-v5", 5),
)
"""Arms of one table, any-age with its defaults first, and its tasks and delays."""


def section(files: list[Path], env: str = ENV) -> str:
    """Return the table of a task from the cells that have ended, with what its words mean."""
    rows = table(results_of(map(read_table, files)), env)
    about = f"{env}, preset `matched`, {front.STEPS[env]:,} steps, `--precision bfloat16`; {front.SEEDS} seeds where "
    about += "no other number is given. ± is the standard deviation over seeds, each of ten episodes; intervals are "
    about += (
        "Welch's, of 95 %, and bold where they leave out 0. *Arithmetic* is that of a step of any-age over that of "
    )
    about += "the other. § stays clear after Holm's correction for all differences of its column. *Critics* are "
    about += "any-age's: with layer normalisation, or plain (`critic_norm=none`) beside agents without it."
    if "†" in rows:
        about += " † acts on the true state while it trains; VDPO has `--tokens 1280`."
    return f"{rows}\n\n{about}"


def table(results: list[Result], env: str = ENV) -> str:
    """Return a Markdown table: a row for each delay and other agent that has ended on the preset `matched`."""
    chosen: dict[tuple[str, int | str], Result] = {}
    for result in front.comparable(results, VARIANTS):
        if result.place.env == env and result.place.delay != 0:
            chosen[front.name(result), result.place.delay] = result
    head = ["delay", "critics", "any-age's end", "other agent", "its end", "any-age minus it, at the end"]
    pairs = []
    for (name, delay), other in sorted(chosen.items(), key=lambda i: (delay_order(i[0][1]), -area(i[1]).mean())):
        owns = [OWN] if "any-age" in name or "critic_norm" in name else [OWN, PLAIN]
        pairs += [
            (own, name, delay, chosen[own, delay], other) for own in owns if (own, delay) in chosen and own != name
        ]
    ends = holm([welch(own.curves.final, other.curves.final) for *_, own, other in pairs])
    areas = holm([welch(area(own), area(other)) for *_, own, other in pairs])
    body = []
    for (own_name, name, delay, own, other), end, whole in zip(pairs, ends, areas, strict=True):
        cells = [str(delay), "plain" if own_name == PLAIN else "layer", ended_at(own), name, ended_at(other)]
        cells += [bold(difference(own.curves.final, other.curves.final)) + " §" * end]
        cells += [bold(difference(area(own), area(other))) + " §" * whole]
        ratio = f"{own.cost.flops / other.cost.flops:.2f}" if own.cost and other.cost else ""
        body.append([*cells, ratio])
    return markdown_table([*head, "over training", "arithmetic"], body)


def added(files: list[Path]) -> str:
    """Return the table of any-age's seeds in two halves: those of the plan, and those that were added later."""
    return added_table(results_of(map(read_table, files)))


def added_table(results: list[Result], delay: int = 25) -> str:
    """Return a Markdown table of any-age's first and later seeds at a delay of ENV, minus each other agent.

    Another agent stands with the same seeds if it has them all, else with its own five.
    """
    here = [r for r in front.comparable(results, VARIANTS) if (r.place.env, r.place.delay) == (ENV, delay)]
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
    about = "Normalised returns at the end: 0 is the random policy, 1 SAC without a delay. ↓ is clearly below any-age "
    about += (
        "with its defaults, whose line is the first, and (↓) over training alone; ↑ and (↑) are above it, by Welch's "
    )
    about += (
        "interval of 95 %, one for each cell, without a correction for their number. *Arithmetic* is that of a step "
    )
    about += "over any-age's. An empty cell has not run."
    return f"{simpler_table(results_of(map(read_table, files)))}\n\n{about}"


def simpler_table(results: list[Result]) -> str:
    """Return a Markdown table: a row for each of SIMPLER, a column for each of WHERE."""
    here = front.comparable(results, SIMPLER)
    chosen = {(front.name(result), (result.place.env, result.place.delay)): result for result in here}
    body = []
    for name in SIMPLER:
        pairs = [(chosen.get((name, case)), chosen.get((OWN, case))) for case in WHERE]
        price = [
            f"{one.cost.flops / own.cost.flops:.2f}" for one, own in pairs if one and own and one.cost and own.cost
        ]
        body.append([name, price[0] if price else "", *(beside(one, own) for one, own in pairs)])
    head = (f"{front.short(env)}, Δ = {delay}" for env, delay in WHERE)
    return markdown_table(["arm", "arithmetic", *head], body)


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
            return f"{score} {higher if one.mean() > other.mean() else lower}"
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
    return spread(result.curves.final) + (f" ({result.runs} seeds)" if result.runs != front.SEEDS else "")


def bold(text: str) -> str:
    """Write in bold a difference whose interval leaves out 0; a difference without an interval is empty."""
    if not text:
        return ""
    low, high = re.findall(r"[-+][\d,]+", text)[1:]
    return f"**{text}**" if low[0] == high[0] else text
