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
from delayrl.run.disk import disk_errors, write_file


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
    with disk_errors(out):
        pictures = figures.draw(summary, out / "img")
        text = markdown(summary, title, pictures, description)
        write_file(out / "report.md", text.encode(errors="replace"))
        text = page(summary, title, description)
        write_file(out / "report.html", text.encode(errors="replace"))
    return out / "report.html"
