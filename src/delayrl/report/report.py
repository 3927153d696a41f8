"""A report: tables, figures and one page, computed from rows and written to a folder."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.report import figures
from delayrl.report.cells import Standing
from delayrl.report.markdown import markdown
from delayrl.report.page import page
from delayrl.report.summary import summarise


def report(
    rows: Iterable[Mapping[str, Any]],
    standing: Standing,
    out: Path,
    title: str = "delayrl",
    versions: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Write report.md, report.html and img/*.png.

    Args:
        rows: as in a run's rows.jsonl, read once; see `summarise`.
        standing: the cells of a grid and how far they are; if empty, the cells are inferred from the rows.
        out: the folder.
        title: of the report.
        versions: libraries, commit and hardware that made the rows, as in a run's configuration.

    Returns:
        The HTML page.

    Raises:
        DelayRLError: damaged or double rows, nothing to show, a folder that cannot be written.
    """
    summary = summarise(rows, standing)
    if not summary.results:
        raise DelayRLError("there is nothing to report: no cells and no rows")
    out = Path(out)
    try:
        pictures = figures.draw(summary, out / "img")
        for name, text in (
            ("report.md", markdown(summary, title, pictures, versions)),
            ("report.html", page(summary, title, versions)),
        ):
            (out / name).write_text(text, encoding="utf-8", errors="replace")
    except OSError as error:
        raise DelayRLError(f"the report cannot be written to {out}: {error.strerror or error}") from error
    return out / "report.html"
