"""Who is clearly above whom: the tables of docs/benchmarks.md, "Case by case", from the cells that have ended."""

from collections.abc import Collection, Iterable
from pathlib import Path

from against import welch
from front import Case, comparable, name, older, raw, results_of, seeds
from ladder import area, gflop, read_table

from delayrl.report.markup import markdown_table
from delayrl.report.results import Result
from delayrl.report.statistics import Floats
from delayrl.report.wording import normalised

CASES: dict[str, Case] = {
    "halfcheetah-5": ("HalfCheetah-v5", 5),
    "halfcheetah-25": ("HalfCheetah-v5", 25),
    "halfcheetah-50": ("HalfCheetah-v5", 50),
    "halfcheetah-random": ("HalfCheetah-v5", "uniform:1:25"),
    "hopper-25": ("delayrl/Hopper-v4", 25),
    "pusher-25": ("delayrl/Pusher-v4", 25),
    "pusher-50": ("delayrl/Pusher-v4", 50),
    "poles-5": ("InvertedDoublePendulum-v5", 5),
    "poles-10": ("InvertedDoublePendulum-v5", 10),
}
"""Task and delay of each table."""
WAITING = "@wait"
"""The end of a delay whose observations are held back for the longest one."""
HEAD = ["arm", "normalised", "at the end", "over training", "above, at the end", "above, over training", "GFLOP"]


def sections(files: list[Path]) -> dict[str, str]:
    """Return the table of each case."""
    results, marked = results_of(files), older(map(read_table, files))
    return {key: table(results, *case, marked) for key, case in CASES.items()}


def table(results: list[Result], env: str, delay: int | str, marked: Collection[tuple[str, Case]] = ()) -> str:
    """Return a Markdown table of the arms that have ended at a delay, and of SAC without one, the highest first.

    An arm is clearly above those whose numbers it names: Welch's interval of 95 % of the difference leaves out 0. ° is
    on those `marked`.
    """
    own = [r for r in comparable(results) if r.place.env == env and plant(r) in (0, delay)]
    arms = {label(result): result for result in own}  # those with most seeds come last
    ranked = sorted(arms.items(), key=lambda arm: -arm[1].curves.final.mean())
    ends, areas = [result.curves.final for _, result in ranked], [area(result) for _, result in ranked]
    body = []
    for place, (words, result) in enumerate(ranked):
        cells = [f"**{place + 1}** {words}{note(result, marked)}", normalised(result.final.mean())]
        cells += [raw(values[place]).replace(" ", "&nbsp;") for values in (ends, areas)]
        body.append([*cells, above(place, ends), above(place, areas), gflop(result)])
    return markdown_table(HEAD, body)


def label(result: Result) -> str:
    """Return the arm in words, marked if it waits for the longest delay."""
    return name(result) + (f", `{WAITING}`" if plant(result) != result.place.delay else "")


def note(result: Result, marked: Collection[tuple[str, Case]]) -> str:
    """Write ° if the arm has rows from before the mistake, and the number of seeds if it is another than usual."""
    old = (name(result), (result.place.env, result.place.delay)) in marked
    return " °" * old + seeds(result)


def plant(result: Result) -> int | str:
    """Return the delay, without the rule to wait."""
    delay = result.place.delay
    return delay.removesuffix(WAITING) if isinstance(delay, str) else delay


def above(place: int, values: list[Floats]) -> str:
    """Write the numbers, from 1, of the arms that the one at `place` is clearly above."""
    one = values[place]
    return ranges(i for i, other in enumerate(values, 1) if one.mean() > other.mean() and welch(one, other) <= 0.05)


def ranges(numbers: Iterable[int]) -> str:
    """Write ascending numbers, three and more in a row as first–last."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs)
