"""The page of results, docs/mutants.md."""

from itertools import groupby
from typing import Any

from catalogue import Mutant

NOTICED = ("killed", "timeout")
"""Outcomes of a mutant that the tests noticed."""


def text(mutants: list[Mutant], rows: dict[str, dict[str, Any]], older: set[str]) -> str:
    """Return the page: a summary, the survivors with the reason of each, and how many were killed in each file.

    `older` names the results whose files have changed since.
    """
    found = [mutant for mutant in mutants if mutant.name in rows]
    survivors = [mutant for mutant in found if rows[mutant.name]["outcome"] not in NOTICED]
    killed = len(found) - len(survivors)
    dates = sorted({rows[mutant.name]["date"] for mutant in found})
    tried = " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "no day"
    seconds = sum(rows[mutant.name]["seconds"] for mutant in found)
    parts = [
        "# Mutants\n",
        "A mutant is the code with one small mistake: a sign, a mask, an off-by-one, a target from the wrong network.\n"
        "`make mutants` runs the tests on every mutant of `benchmarks/mutants/list` and writes this page.\n"
        "What killed each of them stands in `benchmarks/mutants/results.jsonl`.\n"
        "[Contributing](contributing.md#mutants) says how to add one.\n",
        f"**The tests killed {killed} of {len(found)} mutants** ({100 * killed / max(len(found), 1):.1f} %) "
        f"when each was last tried, {tried}.\n"
        f"Their tests took {seconds / 60:.0f} minutes, one after the other.\n",
    ]
    if len(found) < len(mutants):
        parts.append(f"{len(mutants) - len(found)} more mutants have no result yet.\n")
    rest = [f"| `{m.name}` | {m.breaks} | {m.survives or 'a test is missing'} |" for m in survivors]
    table = ["| mutant | what it breaks | why it survives |", "| --- | --- | --- |", *rest]
    parts.append("## Survivors\n\n" + ("\n".join(table) if rest else "None.") + "\n")
    parts.append(
        "## By file\n\nOf some mutants the file or a test file has changed since they were tried: the last column.\n"
    )
    lines = ["| file | mutants | killed | changed since |", "| --- | --- | --- | --- |"]
    for file, group in groupby(sorted(found, key=lambda mutant: mutant.file), lambda mutant: mutant.file):
        these = list(group)
        noticed = sum(mutant not in survivors for mutant in these)
        changed = sum(mutant.name in older for mutant in these)
        lines.append(f"| `{file.removeprefix('src/delayrl/')}` | {len(these)} | {noticed} | {changed} |")
    parts.append("\n".join([*lines, f"| all | {len(found)} | {killed} | {len(older)} |"]) + "\n")
    return "\n".join(parts)
