"""The report as Markdown with pictures. Text from rows and grids is data, and escaped."""

import html
import re
from collections.abc import Iterable, Mapping, Sequence

from delayrl.report import wording
from delayrl.report.comparisons import Comparison
from delayrl.report.markup import markdown_table
from delayrl.report.results import Result, Setting, agent_order
from delayrl.report.statistics import mean_std
from delayrl.report.summary import Aggregate, Summary
from delayrl.report.tables import Table

Pictures = Mapping[tuple[Setting, str], list[str]]
GREY = '<span style="color:#888">{}</span>'


def markdown(summary: Summary, title: str, pictures: Pictures, description: str = "") -> str:
    """Write the report; pictures by setting and kind, as `figures.draw` returns them."""
    legend = "† acts on the true state while it trains. ± is the standard deviation over seeds."
    parts = [
        f"# {_escape(title)}",
        _escape(description),
        f"{wording.states(summary)}. {legend} {wording.paper(summary)}".strip(),
    ]
    parts.append("\n".join(f"- {_escape(line)}" for line in wording.remarks(summary)))
    parts.append("[report.html](report.html), in the same folder, has these tables with sorting and filters.")
    for setting in summary.settings:
        results = [r for r in summary.results.values() if r.place.setting == setting]
        protocol, preset = _escape(setting.protocol), _escape(setting.preset)
        parts.append(f"## Protocol {protocol}, preset {preset}, {wording.seeds(results)}")
        tables = [table for table in summary.tables if table.setting == setting]
        for table, caption in zip(tables, wording.captions(tables), strict=True):
            parts += [f"### {_escape(table.title)}", _escape(caption), _paper_table(summary, table)]
            parts.append(wording.source(table))
        aggregates = [a for a in summary.aggregates if a.setting == setting]
        if aggregates:
            parts += ["### Interquartile mean of the normalised return over tasks", wording.AGGREGATE_CAPTION]
            parts.append(_aggregates(summary, aggregates))
        alternative = "Interquartile means and performance profiles"
        parts += [f"![{alternative}](img/{file})" for file in pictures.get((setting, "aggregates"), [])]
        if comparisons := [c for c in summary.comparisons if c.setting == setting]:
            parts += ["### Which is better", wording.COMPARISON_CAPTION, _comparisons(summary, comparisons)]
        for kind, name in (("curves", "Learning curves"), ("delay", "Return against delay")):
            files = pictures.get((setting, kind), [])
            if files:
                parts += [f"### {name}", *(f"![{name}](img/{file})" for file in files)]
        if costs := wording.costs(summary, setting):
            body = [[_escape(text) for text in line] for line in costs]
            parts += ["### Cost of an agent", wording.COST_CAPTION, markdown_table(wording.COST_HEAD, body)]
        parts += ["### Anchors", _anchors(results), "### All results", _results(summary, results)]
    if made := wording.made_with(summary.versions):
        parts += ["## Versions", *map(_escape, made)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _escape(text: object) -> str:
    """Make text that Markdown and its tables take literally."""
    plain = html.escape(" ".join(str(text).split()), quote=False)
    return re.sub(r"([\\`*_\[\]|~$#!])", r"\\\1", plain)


def _paper_table(summary: Summary, table: Table) -> str:
    body = []
    for env, delay in table.rows:
        line = [_escape(env), _escape(delay)]
        for column in table.columns:
            texts = wording.entry_texts(table, table.entries[env, delay, column])
            shown = ("**{}**", "{}", "area {}", "raw {}", "{}", GREY.format("paper {}"))
            parts = texts._replace(note=_escape(texts.note))
            line.append("<br>".join(form.format(text) for form, text in zip(shown, parts, strict=True) if text))
        body.append(line)
    return markdown_table(["Task", "Δ", *(_escape(summary.name(column)) for column in table.columns)], body)


def _aggregates(summary: Summary, aggregates: Sequence[Aggregate]) -> str:
    by_place = {(a.delay, a.label): a for a in aggregates}
    labels = sorted({a.label for a in aggregates}, key=agent_order)
    body = []
    for delay in dict.fromkeys(a.delay for a in aggregates):
        line = [_escape(wording.delay(delay))]
        for label in labels:
            a = by_place.get((delay, label))
            if a is None:
                line.append("")
                continue
            interval = wording.interval((a.low, a.high), wording.normalised)
            counts = GREY.format(wording.aggregate_counts(a))
            line.append("<br>".join(filter(None, (f"**{wording.normalised(a.iqm)}**", interval, counts))))
        body.append(line)
    return markdown_table(["Δ", *(_escape(summary.name(label)) for label in labels)], body)


def _comparisons(summary: Summary, comparisons: Sequence[Comparison]) -> str:
    at = {(c.delay, c.one, c.other): c for half in comparisons for c in (half, half.turned())}
    labels, body = sorted({one for _, one, _ in at}, key=agent_order), []
    for delay in dict.fromkeys(c.delay for c in comparisons):
        for one in labels:
            if not any((delay, one, other) in at for other in labels):
                continue
            line = [_escape(wording.delay(delay)), _escape(summary.name(one))]
            for other in labels:
                c = at.get((delay, one, other))
                if c is None:
                    line.append("")
                    continue
                p, interval, *more = wording.comparison_texts(c)
                parts = [f"**{p}**" if c.clear else p, interval, *(GREY.format(text) for text in more if text)]
                line.append("<br>".join(filter(None, parts)))
            body.append(line)
    return markdown_table(["Δ", "Agent", *(f"over {_escape(summary.name(label))}" for label in labels)], body)


def _anchors(results: Iterable[Result]) -> str:
    body = {}
    for r in results:
        anchors = (r.random_anchor, r.reference_anchor)
        values = [wording.anchor(a) or "none" for a in anchors]
        key = r.place.env, r.condition.steps
        names = (r.reference_anchor.source, wording.threshold(r) or "none")
        body[key] = (_escape(r.place.env), f"{r.condition.steps:,}", *values, *map(_escape, names))
    return markdown_table(("Task", "Steps", "Random", "Ret_df", "Ret_df is the return of", "Threshold"), body.values())


def _results(summary: Summary, results: Iterable[Result]) -> str:
    body = []
    for r in results:
        names = [_escape(text) for text in (r.place.env, r.place.delay, summary.name(r.place.label))]
        raw = wording.spread(*mean_std(r.curves.final))
        normalised, area = (wording.spread(*mean_std(x), wording.normalised) for x in (r.final, r.area))
        seeds, state = f"{r.runs}/{r.seeds}", r.unfinished or r.progress.state
        final = "<br>".join(filter(None, (normalised, wording.interval(r.final_interval, wording.normalised))))
        first = "×" if r.missed else wording.steps(r.steps_to_threshold)
        reached = "<br>".join(filter(None, (first, wording.interval(r.steps_interval, wording.steps))))
        body.append((*names, raw, final, area, reached, seeds, f"{r.condition.steps:,}", wording.hours(r.hours), state))
    heads = "Task", "Δ", "Agent", "Return", "Normalised", "Area", "Steps to Ret_df", "Seeds", "Steps", "Hours", "State"
    return f"{wording.CELLS_CAPTION}\n\n{markdown_table(heads, body)}"
