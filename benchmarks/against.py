"""Any-age beside each other agent and delay of a task: the tables of differences in docs/algorithms/any-age.md."""

import re
from pathlib import Path

import front
from ladder import area
from learning.curves import difference, spread
from which import results_of

from delayrl.bench.results import read_table
from delayrl.report.markdown import markdown_table
from delayrl.report.results import Result, delay_order

ENV, OWN = "HalfCheetah-v5", "`any-age`"
VARIANTS = ("`any-age`, `encoder=mlp`", "`any-age`, `forecast_learns_from=states+values`")
"""Shown beside the arms of the first page."""


def section(files: list[Path], env: str = ENV) -> str:
    """Return the table of a task from the cells that have ended, with what its words mean."""
    rows = table(results_of(map(read_table, files)), env)
    about = f"{env}, preset `matched`, {front.STEPS[env]:,} steps, `--precision bfloat16`; {front.SEEDS} seeds where "
    about += "no other number is given. ± is the standard deviation over seeds, each of ten episodes; intervals are "
    about += (
        "Welch's, of 95 %, and bold where they leave out 0. *Arithmetic* is that of a step of any-age over that of "
    )
    about += "the other."
    if "†" in rows:
        about += " † reads the true state while it trains; VDPO has `--tokens 1280`."
    return f"{rows}\n\n{about}"


def table(results: list[Result], env: str = ENV) -> str:
    """Return a Markdown table: a row for each delay and other agent that has ended on the preset `matched`."""
    chosen: dict[tuple[str, int | str], Result] = {}
    for result in front.comparable(results, VARIANTS):
        if result.place.env == env and result.place.delay != 0:
            chosen[front.name(result), result.place.delay] = result
    head = ["delay", "any-age's end", "other agent", "its end", "any-age minus it, at the end", "over training"]
    body = []
    for (name, delay), other in sorted(chosen.items(), key=lambda i: (delay_order(i[0][1]), -area(i[1]).mean())):
        own = chosen.get((OWN, delay))
        if own is None or name == OWN:
            continue
        x, y = own.curves.final, other.curves.final
        cells = [str(delay), ended_at(own), name, ended_at(other)]
        cells += [bold(difference(x, y)), bold(difference(area(own), area(other)))]
        ratio = f"{own.cost.flops / other.cost.flops:.2f}" if own.cost and other.cost else ""
        body.append([*cells, ratio])
    return markdown_table([*head, "arithmetic"], body)


def ended_at(result: Result) -> str:
    """Write the returns at the end, with the number of seeds if it is another than usual."""
    return spread(result.curves.final) + (f" ({result.runs} seeds)" if result.runs != front.SEEDS else "")


def bold(text: str) -> str:
    """Write in bold a difference whose interval leaves out 0."""
    low, high = re.findall(r"[-+][\d,]+", text)[1:]
    return f"**{text}**" if low[0] == high[0] else text
