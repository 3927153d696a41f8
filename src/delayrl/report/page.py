"""The report as one HTML page that needs no network.

Text from rows and grids is data, and escaped. The page's policy lets no other script run than its own.
"""

import base64
import hashlib
import html
import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from importlib import resources
from typing import Any

from delayrl.report import figures, wording
from delayrl.report.comparisons import Comparison
from delayrl.report.results import Result, Setting, agent_order, delay_order
from delayrl.report.statistics import mean_std
from delayrl.report.summary import THRESHOLDS, Aggregate, Summary
from delayrl.report.tables import Table

Names = dict[str, list[Any]]  # the data holds indices into these lists


def page(summary: Summary, title: str, description: str = "") -> str:
    """Write the page: the template with title and data, and a policy that allows its own script alone."""
    template = resources.files("delayrl.report").joinpath("report.html").read_text("utf-8")
    script = template.split("<script>")[1].split("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    data = json.dumps(payload(summary, title, description), separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":  # none of them can end the data's element, or begin another
        data = data.replace(sign, f"\\u{ord(sign):04x}")
    values = {"title": html.escape(title), "digest": digest, "data": data}
    return re.sub(r"\{\{(title|digest|data)\}\}", lambda match: values[match[1]], template)


def payload(summary: Summary, title: str, description: str = "") -> dict[str, Any]:
    """Return what the page draws: plain lists, numbers and texts."""
    results = list(summary.results.values())
    anchored: dict[tuple[Setting, str, int], Result] = {}
    for result in results:
        anchored.setdefault(_anchor_key(result), result)
    agents = sorted({*summary.labels, *(c for t in summary.tables for c in t.columns)}, key=agent_order)
    delays = sorted({r.place.delay for r in results}, key=delay_order)
    tasks, settings = sorted({r.place.env for r in results}), summary.settings
    names: Names = {"settings": settings, "tasks": tasks, "delays": delays, "agents": agents, "anchors": [*anchored]}
    seeds = {s: wording.seeds(r for r in results if r.place.setting == s) for s in settings}
    styles = figures.styles(agents)
    return {
        "title": title,
        "state": wording.states(summary),
        "counts": Counter(r.progress.state for r in results),
        "remarks": [*filter(None, [description]), *wording.remarks(summary)],
        "notes": wording.made_with(summary.versions),
        "paper": wording.paper(summary).replace("`", ""),
        "settings": [s._asdict() | {"seeds": seeds[s]} for s in settings],
        "tasks": tasks,
        "delays": delays,
        "agents": [{"label": label, "name": summary.name(label), "style": styles[label]} for label in agents],
        "results": [_result(r, results, names) for r in results],
        "anchors": [_anchors(r, names) for r in anchored.values()],
        "tables": [_table(t, names) for t in summary.tables],
        "costs": [wording.costs(summary, s) for s in settings],
        "costHead": wording.COST_HEAD,
        "costCaption": wording.COST_CAPTION,
        "cellsCaption": wording.CELLS_CAPTION,
        "thresholds": _rounded(THRESHOLDS),
        "aggregateCaption": wording.AGGREGATE_CAPTION,
        "aggregates": [_aggregate(a, names) for a in summary.aggregates],
        "comparisons": [_comparison(c, names) for half in summary.comparisons for c in (half, half.turned())],
        "comparisonCaption": wording.COMPARISON_CAPTION,
    }


def _rounded(value: Any, digits: int = 12) -> Any:
    """Round to what JSON can hold: lists and numbers, whole numbers as integers, NaN as null.

    Five digits are enough for curves. Numbers that the page writes are rounded there, and not twice.
    """
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return _rounded(value.tolist(), digits)
    return [_rounded(x, digits) for x in value] if isinstance(value, list | tuple) else value


def _result(r: Result, results: Sequence[Result], names: Names) -> dict[str, Any]:
    curves = r.curves
    return {
        "setting": names["settings"].index(r.place.setting),
        "task": names["tasks"].index(r.place.env),
        "delay": names["delays"].index(r.place.delay),
        "agent": names["agents"].index(r.place.label),
        "status": r.progress.state,
        "progress": r.unfinished or r.progress.state,
        "partial": r.partial,
        "isAnchor": r.is_anchor,
        "runs": r.runs,
        "seeds": r.seeds,
        "total": r.condition.steps,
        "hours": [wording.hours(r.hours), _rounded(r.hours)],
        "raw": _rounded(mean_std(curves.final)),
        "normalised": _rounded(mean_std(r.final)),
        "interval": wording.interval(r.final_interval, wording.normalised),
        "area": _rounded(mean_std(r.area)),
        "reached": _rounded(r.steps_to_threshold),
        "missed": r.missed,
        "reachedInterval": wording.interval(r.steps_interval, wording.steps),
        "anchor": names["anchors"].index(_anchor_key(r)),
        "longer": next((i for i, o in enumerate(results) if o.curves is r.longer_reference.curves), None),
        "steps": curves.steps.tolist(),
        "mean": _rounded(curves.mean, 5) if r.runs else [],
        "std": _rounded(curves.returns.std(0, ddof=1), 5) if r.runs > 1 else [],
        "each": _rounded(curves.returns, 5) if r.runs > 1 else [],
    }


def _anchor_key(r: Result) -> tuple[Setting, str, int]:
    return r.place.setting, r.place.env, r.condition.steps


def _anchors(r: Result, names: Names) -> dict[str, Any]:
    setting, task = names["settings"].index(r.place.setting), names["tasks"].index(r.place.env)
    anchors = {"random": r.random_anchor, "reference": r.reference_anchor}
    values = {
        name: {"value": _rounded(a.value), "text": wording.anchor(a), "source": a.source} for name, a in anchors.items()
    }
    return {"setting": setting, "task": task, "total": r.condition.steps, "threshold": wording.threshold(r), **values}


def _table(table: Table, names: Names) -> dict[str, Any]:
    rows = []
    for env, delay in table.rows:
        entries = [table.entries[env, delay, column] for column in table.columns]
        texts = [[_rounded(e.value), e.partial, *wording.entry_texts(table, e)] for e in entries]
        rows.append([names["tasks"].index(env), names["delays"].index(delay), texts])
    caption = " ".join(filter(None, (wording.caption(table), wording.source(table))))
    labels = {"kind": table.kind, "title": table.title, "caption": caption}
    columns = [names["agents"].index(column) for column in table.columns]
    return labels | {"setting": names["settings"].index(table.setting), "columns": columns, "rows": rows}


def _comparison(c: Comparison, names: Names) -> dict[str, Any]:
    return {
        "setting": names["settings"].index(c.setting),
        "delay": None if c.delay is None else names["delays"].index(c.delay),
        "one": names["agents"].index(c.one),
        "other": names["agents"].index(c.other),
        "sort": _rounded(c.probability.value),
        "clear": c.clear,
        "texts": wording.comparison_texts(c),
    }


def _aggregate(a: Aggregate, names: Names) -> dict[str, Any]:
    return {
        "setting": names["settings"].index(a.setting),
        "delay": None if a.delay is None else names["delays"].index(a.delay),
        "agent": names["agents"].index(a.label),
        "iqm": _rounded([a.iqm, a.low, a.high]),
        "counts": wording.aggregate_counts(a),
        "profile": _rounded([a.profile, a.profile_low, a.profile_high], 5),
    }
