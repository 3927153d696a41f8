"""The page of results, docs/mutants.md."""

from collections import Counter
from itertools import groupby
from typing import Any

from catalogue import Mutant


def text(mutants: list[Mutant], rows: dict[str, dict[str, Any]], older: set[str]) -> str:
    """Return the page: a summary, the survivors with the reason of each, and all mutants by file.

    `older` names the results whose files have changed since.
    """
    found = [mutant for mutant in mutants if mutant.name in rows]
    outcome = {mutant.name: rows[mutant.name]["outcome"] for mutant in found}
    survivors = [mutant for mutant in found if outcome[mutant.name] not in ("killed", "timeout")]
    killed = len(found) - len(survivors)
    dates, commits = ({rows[mutant.name][key] for mutant in found} for key in ("date", "commit"))
    at = f", at commit {min(commits)}" if len(commits) == 1 else ""
    seconds = sum(rows[mutant.name]["seconds"] for mutant in found)
    parts = [
        "# Mutants\n",
        "A mutant is the code with one small mistake: a sign, a mask, an off-by-one, a target from the wrong network.\n"
        "`make mutants` runs the tests on every mutant of `benchmarks/mutants/list` and writes this page.\n"
        "[Contributing](contributing.md#mutants) says how to add one.\n",
        f"**The tests killed {killed} of {len(found)} mutants** ({100 * killed / max(len(found), 1):.1f} %) "
        f"when each was last tried, on {' and '.join(sorted(dates))}{at}.\n"
        f"Their tests took {seconds / 60:.0f} minutes, one after the other.\n",
    ]
    if len(found) < len(mutants):
        parts.append(f"{len(mutants) - len(found)} more mutants have no result yet.\n")
    if older:
        parts.append(f"Since then the mutated file or a test file of {len(older)} of them has changed.\n")
    rest = [f"| `{m.name}` | {m.breaks} | {m.survives or 'a test is missing'} |" for m in survivors]
    table = ["| mutant | what it breaks | why it survives |", "| --- | --- | --- |", *rest]
    parts.append("## Survivors\n\n" + ("\n".join(table) if rest else "None.") + "\n")
    parts.append("## All mutants by file\n")
    for file, group in groupby(found, lambda mutant: mutant.file):
        these = list(group)
        counts = Counter(outcome[mutant.name] in ("killed", "timeout") for mutant in these)
        parts.append(f"### {file.removeprefix('src/delayrl/')}\n\n{counts[True]} of {len(these)} killed.\n")
        lines = ["| what it breaks | killed by |", "| --- | --- |"]
        lines += [f"| {mutant.breaks} | {killer(rows[mutant.name])} |" for mutant in these]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def killer(row: dict[str, Any]) -> str:
    """Return the test that noticed a mutant, without its folder and parameters."""
    if row["outcome"] == "timeout":
        return "the time limit"
    if row["outcome"] != "killed":
        return "none"
    file, _, test = row["by"].partition("::")
    return f"`{file.rpartition('/')[2]}::{test.partition('[')[0]}`"
