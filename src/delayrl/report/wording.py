"""Numbers and sentences that Markdown and page share."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from delayrl.report.results import Result
from delayrl.report.summary import Summary
from delayrl.report.tables import Table, TableEntry

PAPER = (
    "Paper: Wu et al., Variational Delayed Policy Optimization, NeurIPS 2024; 10 seeds, 1,000,000 steps. It states no "
    "protocol; its released code has the habits of `official`."
)


def number(value: float, like: float | None = None) -> str:
    """Write a return with about three digits, or with as many decimals as `like` gets."""
    if math.isnan(value):
        return ""
    size = abs(value if like is None else like)
    return f"{value:,.0f}" if size >= 1000 else f"{value:,.1f}" if size >= 10 else f"{value:,.2f}"


def normalised(value: float, like: float = 0) -> str:
    """Write a normalised return."""
    return f"{value:.2f}"


def steps(value: float, like: float = 0) -> str:
    """Write environment steps, large numbers in millions as the paper does."""
    return "" if math.isnan(value) else f"{value / 1e6:.2f}M" if value >= 1e5 else f"{value:,.0f}"


def spread(value: float, std: float, write: Callable[[float, float], str] = number) -> str:
    """Write mean ± standard deviation; a deviation of NaN is left out."""
    return "" if math.isnan(value) else write(value, value) + ("" if math.isnan(std) else f" ± {write(std, value)}")


def count(number: int, noun: str) -> str:
    """Write a number of things, in the plural unless there is one."""
    return f"{number} {noun}{'s' * (number != 1)}"


def entry_texts(table: Table, entry: TableEntry) -> tuple[str, str, str, str]:
    """Write our value, the raw return, the note and the paper's value."""
    write = steps if table.kind == "steps" else normalised
    ours = "×" if entry.missed else spread(entry.value, entry.std, write)
    published = entry.published
    theirs = "" if published is None else spread(published.value, published.std, write) or "×"
    return ours, spread(entry.raw, entry.raw_std), entry.note, theirs


def source(table: Table) -> str:
    """Name the paper's tables that the published values of a table are from; empty if it has none."""
    numbers = sorted({entry.published.table for entry in table.entries.values() if entry.published})
    return f"Paper: Table{'s' * (len(numbers) > 1)} {', '.join(numbers)}." if numbers else ""


def paper(summary: Summary) -> str:
    """Name the paper if a table shows values of it."""
    return PAPER if any(source(table) for table in summary.tables) else ""


def states(summary: Summary) -> str:
    """Write how many cells are done, running, failed and to do."""
    number_of = Counter(result.progress.state for result in summary.results.values())
    parts = [f"{number_of[state]} {state}" for state in ("done", "running", "failed", "todo") if number_of[state]]
    return f"{count(len(summary.results), 'cell')}: {', '.join(parts)}"


def overrides(summary: Summary) -> list[str]:
    """Write the overrides that all cells of an agent share, a sentence for agents that agree."""
    agents_with: dict[str, list[str]] = {}
    for agent, values in summary.shared.items():
        agents_with.setdefault(", ".join(f"{k}={v}" for k, v in sorted(values.items())), []).append(agent)
    return [f"Overridden in all cells of {', '.join(sorted(a))}: {values}." for values, a in agents_with.items()]


def made_with(versions: Sequence[Mapping[str, Any]]) -> list[str]:
    """Write a sentence for each machine and set of libraries; commits that differ in nothing else share one."""
    commits: dict[str, list[str]] = {}
    for used in versions:
        hardware = f"{used.get('device')}, {used.get('cores')} cores, {used.get('machine')}"
        names = ("python", "jax", "mujoco", "gymnasium")
        libraries = ", ".join(f"{name} {used[name]}" for name in names if used.get(name))
        commits.setdefault(f"Made on {hardware}; {libraries}", []).append(str(used.get("commit") or "unknown"))
    return [f"{words}; commit {', '.join(dict.fromkeys(hashes))}." for words, hashes in commits.items()]


def seeds(results: Iterable[Result]) -> str:
    """Write how many seeds the results have."""
    counts = sorted({result.seeds for result in results})
    return count(counts[0], "seed") if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"
