"""The result on the first page: what each method is worth, from the cells that have ended."""

import functools
import itertools
from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
from ladder import arm, made_on, read_table, rows_of, spread, trained_with
from learning.curves import curve
from matplotlib import pyplot

from delayrl.bench.results import Collected
from delayrl.errors import DelayRLError
from delayrl.report.figures import STYLES
from delayrl.report.markup import markdown_table
from delayrl.report.results import Result, Setting
from delayrl.report.statistics import Floats
from delayrl.report.summary import summarise
from delayrl.report.wording import interval, normalised
from delayrl.run.condition import Condition

Case = tuple[str, int | str]
"""Task and delay."""
Chosen = dict[tuple[str, Case], Result]
"""Results by arm and case."""
CASES: tuple[Case, ...] = (
    ("HalfCheetah-v5", 5),
    ("HalfCheetah-v5", 25),
    ("HalfCheetah-v5", 50),
    ("delayrl/Hopper-v4", 25),
    ("delayrl/Pusher-v4", 50),
    ("InvertedDoublePendulum-v5", 5),
)
"""Task and delay of each column, and of each panel of the picture; the second decides the order of the rows."""
STEPS = {
    "HalfCheetah-v5": 100_000,
    "delayrl/Hopper-v4": 200_000,
    "delayrl/Pusher-v4": 40_000,
    "InvertedDoublePendulum-v5": 30_000,
}
SEEDS = 5
BUDGET = {"precision", "steps", "evaluate_every", "replay_capacity", "tokens"}
"""Overrides that leave an agent what it is."""
OLDER = {"01b5aa23787f", "306d0e2c45c5", "3ee61c16dc1c", "6441e5f11602", "730fe4a4960b", "752d29b5f225", "e50179b9d693"}
"""Commits from before the mistake of docs/benchmarks.md, "A mistake in older rows", was fixed."""
COLOURS = {
    "`sac`, no delay": STYLES["sac"][0],
    "`sac`, no delay, `critic_norm=batch`": STYLES["random"][0],
    "`any-age`": STYLES["any-age"][0],
    "`any-age`, `batch_size=128`, `critic_norm=batch`": "#7a0019",
    "`vdpo` †": STYLES["vdpo"][0],
    "`lifting`": STYLES["lifting"][0],
    "`bpql`": STYLES["bpql"][0],
    "`bpql`, `batch_size=128`, `critic_norm=batch`": "#4a6b00",
    "`bpql`, `batch_size=128`, `critic_norm=layer`": "#b5d800",
    "`a-sac`": STYLES["a-sac"][0],
    "`dcac`": STYLES["dcac"][0],
    "`sac-memoryless`": STYLES["sac-memoryless"][0],
}
"""What the table and the picture show. Agents have the colours of reports."""
MORE = (
    "`sac`, no delay, `critic_norm=layer`",
    "`sac`, no delay, `batch_size=128`, `critic_norm=batch`",
    "`any-age`, `critic_norm=none`",
    "`any-age`, `encoder=mlp`",
    "`any-age`, `forecast_learns_from=states+values`",
    "`any-age`, `forecast_error=distance`",
    "`any-age`, `second_age=any`",
    "`any-age`, `batch_size=128`",
    "`any-age`, `batch_size=128`, `encoder=mlp`",
    "`any-age`, `batch_size=128`, `critic_norm=batch`, `encoder=mlp`",
    "`bpql`, `critic_norm=layer`",
    "`bpql`, `batch_size=128`",
)
ARMS = {*COLOURS, *MORE}
"""What other pages show."""


def section(files: list[Path], pictures: Path) -> str:
    """Draw the curves as `result.png`; return the table, with what made its rows."""
    tables = [read_table(file) for file in files]
    chosen = choose(results_of(files))
    draw(chosen, pictures / "result.png")
    shown = [result.condition for result in chosen.values()]
    runs = itertools.chain(*map(trained_with, tables))
    used = [versions for condition, _, own in runs if condition in shown for versions in own]
    *others, last = (f"{count:,} steps on {env}" for env, count in STEPS.items())
    steps = f"{', '.join(others)} and {last}"
    made = (
        f"Δ is the delay in steps. Preset `matched`, {steps}, `--precision bfloat16`; {SEEDS} seeds where no other "
        "number is given. Below each normalised return stands its 95 % interval, then the raw return at the "
        "end ± the standard deviation over seeds; a seed's return is a mean of ten episodes. † acts on the true state "
        "while it trains. ° has rows from before a mistake was fixed, of which more below. VDPO has `--tokens 1280`. "
        "`critic_norm=batch` and `critic_norm=layer` are batch and layer normalisation in the critics; where none is "
        "named, any-age has the latter and the others none. "
        f"{made_on(used)} {rows_of(files, tables)}"
    )
    return f"{table(chosen, older(tables))}\n\n{made}"


def results_of(files: Iterable[Path]) -> list[Result]:
    """Return the results of all files."""
    return [result for file in files for result in results_in(file)]


@functools.cache
def results_in(file: Path) -> list[Result]:
    """Return the results of a file, which several sections of the pages read."""
    table = read_table(file)
    return [*summarise(table.rows, table.standing, table.configs).results.values()]


def ended(result: Result) -> bool:
    """Tell whether all seeds have."""
    return result.runs == result.seeds and not result.partial


def choose(results: list[Result]) -> Chosen:
    """Return what has ended for each arm and case, that with most seeds; delay-free SAC in each case of its task."""
    chosen: Chosen = {}
    for result in comparable(results):
        task, own = result.place.env, result.place.delay
        here = [case for case in CASES if name(result) in COLOURS and case[0] == task and own in (0, case[1])]
        chosen |= {(name(result), case): result for case in here}
    return chosen


def comparable(results: list[Result], arms: Collection[str] = ARMS) -> list[Result]:
    """Return the results of `arms` under one protocol, preset, precision and budget, those with most seeds last.

    Raises DelayRLError if some of a task were not evaluated at the same steps: their means over training would differ.
    """
    alike = [r for r in results if r.place.setting == Setting("corrected", "matched") and name(r) in arms and ended(r)]
    budget = [r for r in alike if r.condition.steps == STEPS.get(r.place.env)]
    same = sorted((r for r in budget if r.condition.overrides.get("precision") == "bfloat16"), key=lambda r: r.runs)
    if mixed := {env for env in STEPS if len({tuple(r.curves.steps) for r in same if r.place.env == env}) > 1}:
        raise DelayRLError(f"results on {', '.join(sorted(mixed))} have evaluations at different steps")
    return same


def older(tables: Iterable[Collected]) -> set[tuple[str, Case]]:
    """Return the arms and cases with rows of `OLDER` commits, of agents that act under the delay alone."""
    found = set()
    for condition, privileged, versions in itertools.chain(*map(trained_with, tables)):
        commits = {str(used.get("commit")).partition("-")[0] for used in versions}
        if condition.delay and not privileged and commits & OLDER:
            found.add((in_words(condition, False), (condition.env, condition.delay)))
    return found


def short(env: str) -> str:
    """Return the task without who registers it and its version."""
    return env.removeprefix("delayrl/").rpartition("-v")[0]


def name(result: Result) -> str:
    """Return the arm in words."""
    return in_words(result.condition, result.privileged)


def in_words(condition: Condition, privileged: bool) -> str:
    """Return an arm in words, without the options of its budget; † marks what reads the true state."""
    words = [word for word in arm(condition).split(", ") if word.strip("`").split("=")[0] not in BUDGET]
    return ", ".join(words) + (" †" if privileged else "")


def table(chosen: Chosen, marked: Collection[tuple[str, Case]] = ()) -> str:
    """Return a Markdown table: a row for each arm, with ° where it is `marked`; a variant at least after its agent."""

    def rank(label: str) -> tuple[float, str]:
        known = [arm for arm in (label, label.partition(",")[0]) if (arm, CASES[1]) in chosen]
        return -chosen[known[0], CASES[1]].curves.final.mean() if known else np.inf, label

    head = ["", *(f"{short(env)}, Δ = {delay}" for env, delay in CASES)]
    labels = sorted(dict.fromkeys(label for label, _ in chosen), key=rank)
    places = [[(label, case) for case in CASES] for label in labels]
    cells = [[cell(chosen.get(place), " °" if place in marked else "") for place in row] for row in places]
    return markdown_table(head, [[label, *row] for label, row in zip(labels, cells, strict=True)])


def cell(result: Result | None, mark: str = "") -> str:
    """Write in lines a normalised return with its mark, its interval and the raw one; nothing for what has not run."""
    if result is None:
        return ""
    within = interval(result.final_interval, normalised)
    count = [f"{result.runs} seeds"] if result.runs != SEEDS else []
    below = "; ".join([within, *count] if within else count)
    lines = [f"**{normalised(result.final.mean())}**{mark}", *([below] if below else [])]
    return "<br>".join([*lines, raw(result.curves.final)])


def seeds(result: Result) -> str:
    """Write the number of seeds in brackets if it is another than usual."""
    return f" ({result.runs} seeds)" if result.runs != SEEDS else ""


def raw(returns: Floats) -> str:
    """Write mean ± standard deviation, small ones with a decimal."""
    return f"{returns.mean():.1f} ± {returns.std(ddof=1):.1f}" if decimals(returns) else spread(returns)


def decimals(returns: Floats) -> int:
    """Return how many decimals returns are written with."""
    return 0 if abs(returns.mean()) > 999 else 1


def draw(chosen: Chosen, out: Path) -> None:
    """Draw a panel of curves for each case."""
    figure, panels = pyplot.subplots(2, 3, figsize=(10, 6.8), layout="constrained")
    lines = {}
    for axes, case in zip(panels.flat, CASES, strict=True):
        for label, colour in COLOURS.items():
            if (label, case) in chosen:
                lines[label] = curve(axes, *chosen[label, case].curves, colour)
        axes.set_title(f"{short(case[0])}, {case[1]} steps late", fontsize=9)
        axes.locator_params(axis="x", nbins=4)
    labels = [label for label in COLOURS if label in lines]
    names = [label.replace("`", "") for label in labels]
    handles = [lines[label] for label in labels]
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(out, dpi=110)
    pyplot.close(figure)
