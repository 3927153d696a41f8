"""The report: Markdown with pictures, and one HTML page that needs no network. Both show the same `Summary`.

What comes from rows and grids (names, titles) is data: it is escaped for Markdown and HTML, and the page's policy
lets no other script run than its own.
"""

import argparse
import base64
import hashlib
import html
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from delayrl.errors import DelayRLError
from delayrl.report import figures
from delayrl.report.statistics import Floats, mean_std
from delayrl.report.summary import (
    THRESHOLDS,
    Aggregate,
    Anchor,
    Cell,
    Delay,
    Entry,
    Result,
    Summary,
    Table,
    agent_order,
    delay_order,
    summarise,
)

PAPER = (
    "Paper: Wu et al., Variational Delayed Policy Optimization, NeurIPS 2024; 10 seeds, 1,000,000 steps. It states no "
    "protocol; its released code has the habits of `official`."
)


def report(
    rows: Iterable[Mapping[str, Any]],
    cells: Sequence[Cell],
    out: Path,
    title: str = "delayrl",
    versions: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Write report.md, report.html and img/*.png.

    Args:
        rows: as in a run's rows.jsonl, read once; see `summarise`.
        cells: of the grid, run or not; empty: inferred from the rows.
        out: the folder.
        title: of the report.
        versions: with what the rows were made, as in a run's configuration: libraries, commit, hardware.

    Returns:
        The HTML page.

    Raises:
        DelayRLError: damaged or double rows, nothing to show, a folder that cannot be written.
    """
    summary = summarise(rows, cells)
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


# Words


def number(value: float, like: float | None = None) -> str:
    """A return: about three digits, or as many decimals as `like` gets."""
    if math.isnan(value):
        return ""
    size = abs(value if like is None else like)
    return f"{value:,.0f}" if size >= 1000 else f"{value:,.1f}" if size >= 10 else f"{value:,.2f}"


def steps(value: float, like: float | None = None) -> str:
    """Environment steps, as the paper writes them where there are many."""
    return "" if math.isnan(value) else f"{value / 1e6:.2f}M" if value >= 1e5 else f"{value:,.0f}"


def spread(value: float, std: float, write: Callable[[float, float], str] = number) -> str:
    """Mean ± standard deviation; the latter is left out where there is none."""
    return "" if math.isnan(value) else write(value, value) + ("" if math.isnan(std) else f" ± {write(std, value)}")


def _normalised(value: float, like: float = 0) -> str:
    return f"{value:.2f}"


def _count(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _words(table: Table, entry: Entry) -> tuple[str, str, str, str]:
    """Ours, raw return, note, paper's."""
    write = steps if table.kind == "steps" else _normalised
    ours = "×" if entry.missed else spread(entry.value, entry.std, write)
    figure = entry.published
    theirs = "" if figure is None else spread(figure.value, figure.std, write) or "×"
    return ours, spread(entry.raw, entry.raw_std), entry.note, theirs


def _state(summary: Summary) -> str:
    count = Counter(result.status for result in summary.results.values())
    order = ("done", "running", "failed", "todo")
    total = len(summary.results)
    return f"{_count(total, 'cell')}: " + ", ".join(f"{count[s]} {s}" for s in order if count[s])


def _shared(summary: Summary) -> list[str]:
    """What is overridden in all cells of an agent, agents that agree together."""
    same: dict[str, list[str]] = {}
    for agent, values in summary.shared.items():
        same.setdefault(", ".join(f"{k}={v}" for k, v in sorted(values.items())), []).append(agent)
    return [f"{', '.join(sorted(agents))}: {words}" for words, agents in same.items()]


def made_with(versions: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each machine and set of libraries; commits that differ in nothing else share a line."""
    commits: dict[str, list[str]] = {}
    for found in versions:
        hardware = f"{found.get('device')}, {found.get('cores')} cores, {found.get('machine')}"
        names = ("python", "jax", "mujoco", "gymnasium")
        libraries = ", ".join(f"{name} {found[name]}" for name in names if found.get(name))
        commits.setdefault(f"Made on {hardware}; {libraries}", []).append(str(found.get("commit") or "unknown"))
    return [f"{words}; commit {', '.join(dict.fromkeys(found))}." for words, found in commits.items()]


def _seeds(results: Iterable[Result]) -> str:
    counts = sorted({result.seeds for result in results})
    return _count(counts[0], "seed") if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"


# Markdown


def _md(text: object) -> str:
    """Text that Markdown and its tables take literally."""
    plain = html.escape(" ".join(str(text).split()), quote=False)
    return re.sub(r"([\\`*_\[\]|~$#!])", r"\\\1", plain)


def _rows(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "| " + " | ".join("---" for _ in head) + " |"]
    return "\n".join(lines + ["| " + " | ".join(line) + " |" for line in body])


def _grey(text: str) -> str:
    return f'<span style="color:#888">{text}</span>'


def _md_table(summary: Summary, table: Table) -> str:
    body = []
    for env, delay in table.rows:
        line = [_md(env), _md(delay)]
        for column in table.columns:
            ours, raw, note, theirs = _words(table, summary.entry(table, (env, delay), column))
            parts = [f"**{ours}**" if ours else "", f"raw {raw}" if raw else "", _md(note)]
            line.append("<br>".join(p for p in [*parts, _grey(f"paper {theirs}") if theirs else ""] if p))
        body.append(line)
    return _rows(["Task", "Δ", *(_md(summary.name(column)) for column in table.columns)], body)


def _source(summary: Summary, table: Table) -> str:
    """Where the paper has the figures of a table; nothing if it has none of them."""
    entries = [summary.entry(table, row, column) for row in table.rows for column in table.columns]
    numbers = sorted({entry.published.table for entry in entries if entry.published})
    return f"Paper: Table{'s' * (len(numbers) > 1)} {', '.join(numbers)}." if numbers else ""


def markdown(
    summary: Summary, title: str, pictures: Mapping[Any, list[str]], versions: Sequence[Mapping[str, Any]] = ()
) -> str:
    """The report as Markdown; pictures by setting and kind, as `figures.draw` gives them."""
    parts = [
        f"# {_md(title)}",
        _state(summary) + ". " + f"† reads the true state while it trains. ± is the "
        f"standard deviation over seeds. {PAPER}",
    ]
    if summary.unplaced:
        parts.append(f"{summary.unplaced:,} rows belong to no cell of the grid; they are left out.")
    parts += [f"Overridden in all cells of {_md(line)}." for line in _shared(summary)]
    parts += [_md(line) for line in made_with(versions)]
    for setting in summary.settings:
        results = [r for r in summary.results.values() if r.place.setting == setting]
        parts.append(f"## Protocol {_md(setting.protocol)}, preset {_md(setting.preset)}, {_seeds(results)}")
        for table in summary.tables:
            if table.setting == setting:
                parts += [f"### {_md(table.title)}", _md_table(summary, table), _source(summary, table)]
        aggregates = [a for a in summary.aggregates if a.setting == setting]
        if aggregates:
            parts += ["### Interquartile mean of the normalised return over tasks", _md_aggregates(summary, aggregates)]
        for kind, name in (
            ("aggregates", "Interquartile means and performance profiles"),
            ("curves", "Learning curves"),
            ("delay", "Return against delay"),
        ):
            files = pictures.get((setting, kind), [])
            parts += [f"### {name}" if kind != "aggregates" else ""] if files else []
            parts += [f"![{name}](img/{file})" for file in files]
        parts += ["### Anchors", _md_anchors(results), "### All cells", _md_results(summary, results)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _md_aggregates(summary: Summary, aggregates: Sequence[Aggregate]) -> str:
    of = {(a.delay, a.label): a for a in aggregates}
    labels = sorted({a.label for a in aggregates}, key=agent_order)
    body = []
    for delay in dict.fromkeys(a.delay for a in aggregates):
        line = ["all constant" if delay is None else _md(delay)]
        for label in labels:
            a = of.get((delay, label))
            interval = f"<br>{a.low:.2f} to {a.high:.2f}" if a and not math.isnan(a.low) else ""
            what = "condition" if delay is None else "task"
            counts = _grey(f"{_count(a.tasks, what)}, {_count(a.runs, 'run')}") if a else ""
            line.append(f"**{a.iqm:.2f}**{interval}<br>{counts}" if a else "")
        body.append(line)
    return _rows(["Δ", *(_md(summary.name(label)) for label in labels)], body)


def _md_anchors(results: Iterable[Result]) -> str:
    body = {
        (r.place.env, r.total): (
            _md(r.place.env),
            f"{r.total:,}",
            *(
                f"{number(a.value)} ({_count(a.runs, 'seed')})" if a.runs else "none"
                for a in (r.random_anchor, r.reference_anchor)
            ),
            _md(r.reference_anchor.source),
        )
        for r in results
    }
    return _rows(("Task", "Steps", "Random", "Ret_df", "Ret_df is the return of"), body.values())


def _md_results(summary: Summary, results: Iterable[Result]) -> str:
    body = []
    for r in results:
        value = mean_std(r.normalise(r.curves.final))
        state = "; ".join(r.progress) or r.status
        raw = spread(*mean_std(r.curves.final))
        line = (
            _md(r.place.env),
            _md(r.place.delay),
            _md(summary.name(r.place.label)),
            raw,
            spread(*value, _normalised),
        )
        body.append((*line, f"{r.runs}/{r.seeds}", f"{r.total:,}", state))
    return _rows(("Task", "Δ", "Agent", "Return", "Normalised", "Seeds", "Steps", "State"), body)


# HTML


def _digits(value: Any, digits: int = 12) -> Any:
    """So many digits, whole numbers (steps) all, and nothing for NaN: what JSON can say.

    Five are enough for what is drawn. What is written is rounded by the page, and not twice.
    """
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return _digits(value.tolist(), digits)
    return [_digits(x, digits) for x in value] if isinstance(value, list | tuple) else value


def _anchor(anchor: Anchor) -> dict[str, Any]:
    return {"value": _digits(anchor.value), "runs": anchor.runs, "source": anchor.source}


def payload(summary: Summary, title: str, versions: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """What the page draws: plain lists and numbers, indices into `settings`, `tasks`, `delays` and `agents`."""
    labels = sorted({*summary.labels, *(c for t in summary.tables for c in t.columns)}, key=agent_order)
    results = list(summary.results.values())
    tasks = sorted({r.place.env for r in results})
    delays = sorted({r.place.delay for r in results}, key=delay_order)
    settings, looks = summary.settings, figures.styles(labels)
    anchors: dict[Any, int] = {}
    kept: list[dict[str, Any]] = []

    def anchor_of(r: Result) -> int:
        key = (r.place.setting, r.place.env, r.total)
        if key not in anchors:
            anchors[key] = len(kept)
            kept.append(
                {
                    "setting": settings.index(r.place.setting),
                    "task": tasks.index(r.place.env),
                    "total": r.total,
                    "random": _anchor(r.random_anchor),
                    "reference": _anchor(r.reference_anchor),
                }
            )
        return anchors[key]

    def of(r: Result) -> dict[str, Any]:
        curve = r.curves
        std: Floats | list[float] = curve.returns.std(0, ddof=1) if r.runs > 1 else []
        return {
            "setting": settings.index(r.place.setting),
            "task": tasks.index(r.place.env),
            "delay": delays.index(r.place.delay),
            "agent": labels.index(r.place.label),
            "status": r.status,
            "progress": "; ".join(r.progress) or r.status,
            "running": r.status == "running",
            "partial": r.partial,
            "isAnchor": r.is_anchor,
            "runs": r.runs,
            "seeds": r.seeds,
            "total": r.total,
            "raw": _digits(mean_std(curve.final)),
            "normalised": _digits(mean_std(r.normalise(curve.final))),
            "reached": [_digits(r.steps_to_threshold), r.seeds_at_threshold],
            "anchor": anchor_of(r),
            "steps": curve.steps.tolist(),
            "mean": _digits(curve.mean, 5) if r.runs else [],
            "std": _digits(std, 5),
            "each": _digits(curve.returns, 5) if r.runs > 1 else [],
        }

    def table_of(t: Table) -> dict[str, Any]:
        def cell(row: tuple[str, Delay], column: str) -> list[Any]:
            entry = summary.entry(t, row, column)
            return [_digits(entry.value), entry.partial, *_words(t, entry)]

        return {
            "kind": t.kind,
            "title": t.title,
            "source": _source(summary, t),
            "setting": settings.index(t.setting),
            "columns": [labels.index(c) for c in t.columns],
            "rows": [[tasks.index(r[0]), delays.index(r[1]), [cell(r, c) for c in t.columns]] for r in t.rows],
        }

    return {
        "title": title,
        "state": _state(summary),
        "counts": Counter(r.status for r in results),
        "notes": [f"Overridden in all cells of {line}." for line in _shared(summary)]
        + made_with(versions)
        + ([f"{summary.unplaced:,} rows belong to no cell of the grid; left out."] if summary.unplaced else []),
        "paper": PAPER.replace("`", ""),
        "settings": [
            {"protocol": s.protocol, "preset": s.preset, "seeds": _seeds(r for r in results if r.place.setting == s)}
            for s in settings
        ],
        "tasks": tasks,
        "delays": delays,
        "agents": [{"label": label, "name": summary.name(label), "style": looks[label]} for label in labels],
        "results": [of(r) for r in results],
        "anchors": kept,
        "tables": [table_of(t) for t in summary.tables],
        "thresholds": _digits(THRESHOLDS),
        "aggregates": [
            {
                "setting": settings.index(a.setting),
                "delay": None if a.delay is None else delays.index(a.delay),
                "agent": labels.index(a.label),
                "iqm": _digits([a.iqm, a.low, a.high]),
                "tasks": a.tasks,
                "runs": a.runs,
                "profile": _digits([a.profile, a.profile_low, a.profile_high], 5),
            }
            for a in summary.aggregates
        ],
    }


def page(summary: Summary, title: str, versions: Sequence[Mapping[str, Any]] = ()) -> str:
    """The HTML page: the template with title and data put in, and a policy that allows its own script alone."""
    template = resources.files("delayrl.report").joinpath("report.html").read_text("utf-8")
    script = template.split("<script>")[1].split("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    data = json.dumps(payload(summary, title, versions), separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":  # none of them can end the data's element, or begin another
        data = data.replace(sign, f"\\u{ord(sign):04x}")
    values = {"title": html.escape(title), "digest": digest, "data": data}
    return re.sub(r"\{\{(title|digest|data)\}\}", lambda found: values[found[1]], template)


# From files, without a grid


def read(paths: Iterable[Path]) -> Iterator[dict[str, Any]]:
    """Rows of rows.jsonl files, and of files that `benchmarks/collect.py` wrote."""
    names = ("agent", "env", "delay", "preset", "protocol", "privileged", "seed")
    for path in paths:
        configs: dict[Any, dict[str, Any]] = {}
        try:
            with open(path, "rb") as file:
                for number_of_line, line in enumerate(file, 1):
                    try:
                        row = json.loads(line)
                        if not isinstance(row, dict):
                            raise TypeError
                        if "config" in row:
                            configs[row["run"]] = {name: row["config"][name] for name in names}
                        elif "step" in row:
                            yield configs.get(row.get("run"), {}) | row
                    except (ValueError, TypeError, KeyError, RecursionError):
                        raise DelayRLError(f"{path}, line {number_of_line}: this is no row of results") from None
        except OSError as error:
            raise DelayRLError(f"{path} cannot be read: {error.strerror}") from error


def main() -> None:
    """A report of files of rows."""
    parser = argparse.ArgumentParser(prog="python -m delayrl.report.report", description=main.__doc__)
    parser.add_argument("rows", type=Path, nargs="+", help="files of rows, one JSON object a line")
    parser.add_argument("--out", type=Path, required=True, help="folder of the report")
    parser.add_argument("--title", default="delayrl")
    given = parser.parse_args()
    try:
        print(report(read(given.rows), [], given.out, given.title))
    except DelayRLError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
