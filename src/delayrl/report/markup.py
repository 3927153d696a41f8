"""Pieces of Markdown, for programs that need nothing else of a report, nor JAX."""

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], body: Iterable[Sequence[object]]) -> str:
    """Write a table of cells that are Markdown already."""
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in (head, ["---" for _ in head], *body))
