"""VDPO's own questions: one change at a time, the tables of docs/algorithms/vdpo.md from the cells of `evidence-3`."""

from functools import partial
from pathlib import Path

from front import SEEDS, comparable, decimals, name, raw, results_of, seeds, short
from ladder import area, made_on, read_table, rows_of, trained_with
from learning.curves import bold, difference

from delayrl.report.markup import markdown_table
from delayrl.report.results import Result

PLAIN = "`vdpo` †"
HEAD = ["change", "at the end", "minus unchanged", "over training", "minus unchanged", "arithmetic"]


def section(file: Path) -> str:
    """Return a table for each task, with what made its rows."""
    collected = read_table(file)
    used = [v for condition, _, own in trained_with(collected) if condition.agent == "vdpo" for v in own]
    about = (
        f"Preset `matched`, `--tokens 1280`, `--precision bfloat16`, the steps of the first page; {SEEDS} seeds where "
        "no other number is given. The highest over training stands first; † acts on the true state while it trains. ± "
        "is the standard deviation over seeds, each of ten episodes; differences have Welch's interval of 95 %, and "
        "are bold where it leaves out 0, without a correction for their number. *Arithmetic* is that of a step over "
        f"the unchanged agent's. {made_on(used)} {rows_of([file], [collected])}"
    )
    return "\n\n".join([*tables(results_of([file])), about])


def tables(results: list[Result]) -> list[str]:
    """Return a Markdown table, under its title, for each task and delay where VDPO and a change of it have ended."""
    ended = comparable(results, {name(result) for result in results if result.condition.agent == "vdpo"})
    parts = []
    for env, delay in dict.fromkeys((r.place.env, r.place.delay) for r in ended):
        here = [r for r in ended if (r.place.env, r.place.delay) == (env, delay)]
        base = next((r for r in here if name(r) == PLAIN), None)
        if base and len(here) > 1:
            ranked = sorted(here, key=lambda r: -area(r).mean())
            body = [line(result, base) for result in ranked]
            parts.append(f"**{short(env)}, {delay} steps late**\n\n{markdown_table(HEAD, body)}")
    return parts


def line(result: Result, base: Result) -> list[str]:
    """Write a line of a table: a change of VDPO beside `base`, which has none."""
    write = partial(difference, digits=decimals(base.curves.final))
    words = "none †" if result is base else name(result).removeprefix("`vdpo`, ")
    cells = [words + seeds(result)]
    for own, other in ((result.curves.final, base.curves.final), (area(result), area(base))):
        cells += [raw(own), "" if result is base else bold(write(own, other))]
    price = f"{result.cost.flops / base.cost.flops:.2f}" if result.cost and base.cost else ""
    return [*cells, price]
