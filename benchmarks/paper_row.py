"""Pusher, 5 steps late, at the paper's size: the table of docs/benchmarks.md, from the cells of `evidence-1-paper`."""

from pathlib import Path

from front import ended, raw, results_of
from ladder import read_table, rows_of

from delayrl.report.markup import markdown_table
from delayrl.report.results import PAPER_ORDER, Result
from delayrl.report.tables import published_values

TASK, DELAY = "Pusher-v4", 5
PROTOCOLS = ("corrected", "official")


def section(file: Path) -> str:
    """Return the table, with where its rows are."""
    return f"{table(results_of([file]))}\n\n{rows_of([file], [read_table(file)])}"


def table(results: list[Result]) -> str:
    """Return a Markdown table: each agent's returns at the step at which the paper's reached that of SAC, and after it.

    Beside them stands what SAC without a delay returns at that step. A delayed agent is there once all its seeds have
    ended, SAC once one has.
    """
    at = {(r.condition.agent, r.place.setting.protocol): r for r in results if r.runs and not r.partial}
    body = []
    for protocol in PROTOCOLS:
        sac = at.get(("sac", protocol))
        for agent in PAPER_ORDER:
            step = int(published_values()["steps", TASK, str(DELAY), agent, ""].value)
            own = at.get((agent, protocol))
            if own and ended(own):
                cells = [f"{step:,}", then(own, step), then(sac, step), last(own)]
                body.append([f"`{agent}`" + " †" * own.privileged, f"`{protocol}`", *cells])
        if sac:
            body.append(["`sac`, no delay", f"`{protocol}`", "", "", "", last(sac)])
    return markdown_table(
        ["agent", "protocol", "the paper's steps", "returns then", "SAC then", "returns at the end"], body
    )


def then(result: Result | None, step: int) -> str:
    """Write the returns of the evaluation at a step; empty without one."""
    if result is None or step not in result.curves.steps:
        return ""
    return written(result, list(result.curves.steps).index(step))


def last(result: Result) -> str:
    """Write the returns of the last evaluation, with its step."""
    return f"{written(result, -1)}, {result.curves.steps[-1]:,} steps"


def written(result: Result, index: int) -> str:
    """Write the returns of an evaluation, with the number of seeds where some have not ended."""
    returns = result.curves.returns[:, index]
    text = raw(returns) if returns.size > 1 else f"{returns[0]:.1f}"
    return text + ("" if result.runs == result.seeds else f" ({result.runs} of {result.seeds} seeds)")
