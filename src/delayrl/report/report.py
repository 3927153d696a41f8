"""A report: tables, figures and one page, computed from rows and written to a folder."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.report import figures
from delayrl.report.markdown import markdown
from delayrl.report.page import page
from delayrl.report.summary import summarise
from delayrl.run.cell import Standing


def report(
    rows: Iterable[Mapping[str, Any]],
    standing: Standing,
    out: str | Path,
    title: str = "delayrl",
    configs: Iterable[Mapping[str, Any]] = (),
    description: str = "",
) -> Path:
    """Write report.md, report.html and img/*.png, and return the path of the page.

    Args:
        rows: as for `summarise`.
        standing: as for `summarise`; may be empty.
        out: the folder.
        title: the heading.
        configs: as for `summarise`; may be empty.
        description: what stands below the heading, such as that of a grid.

    Raises:
        DelayRLError: damaged or double rows, nothing to show, a folder that cannot be written.
    """
    out, summary = Path(out), summarise(rows, standing, configs)
    if not summary.results:
        raise DelayRLError("there is nothing to report: no cells and no rows")
    try:
        pictures = figures.draw(summary, out / "img")
        text = markdown(summary, title, pictures, description)
        (out / "report.md").write_text(text, encoding="utf-8", errors="replace")
        text = page(summary, title, description)
        (out / "report.html").write_text(text, encoding="utf-8", errors="replace")
    except OSError as error:
        raise DelayRLError(f"the report cannot be written to {out}: {error.strerror or error}") from error
    return out / "report.html"
