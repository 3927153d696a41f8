"""Sections of the docs' pages, which scripts write. Needs neither JAX nor matplotlib."""

from pathlib import Path

HERE = Path(__file__).parent


def insert(page: Path, key: str, text: str) -> None:
    """Replace the text between `<!-- key -->` and `<!-- /key -->` in a page."""
    content = page.read_text()
    begin, end = f"<!-- {key} -->", f"<!-- /{key} -->"
    head, rest = content.split(begin)
    page.write_text(head + begin + "\n" + text + "\n" + end + rest.split(end)[1])
