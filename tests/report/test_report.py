"""The report: hand-computed results, what must never be said, and the page in a real browser."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import cell, full_grid, rows

from delayrl.errors import DelayRLError
from delayrl.report.report import markdown, page, payload, read, report
from delayrl.report.summary import Cell, Place, Result, Setting, Summary, paper, summarise

PAPER = Setting("corrected", "paper")
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def row(of: Cell, seed: int, step: int, value: float, episode: int = 0, policy: str = "agent") -> dict[str, Any]:
    kept = ("agent", "env", "delay", "preset", "protocol")
    return {name: getattr(of, name) for name in kept} | {
        "cell": of.id, "seed": seed, "step": step, "policy": policy, "episode": episode, "return": value,
        "privileged": of.agent == "vdpo",
    }  # fmt: skip


def curve(of: Cell, seed: int, values: list[float], policy: str = "agent") -> list[dict[str, Any]]:
    """One evaluation of two episodes, 5 above and 5 below the mean, every 100 steps."""
    return [
        row(of, seed, 100 * i, value + 5 - 10 * episode, episode, policy)
        for i, value in enumerate(values, 1)
        for episode in range(2)
    ]


def small(**changes: Any) -> dict[str, Cell]:
    given = {"total": 300, "done": 300, "seeds": 2} | changes
    return {
        "vdpo": cell("vdpo", "delayrl/Ant-v4", 5, **given),
        "sac": cell("sac", "delayrl/Ant-v4", 0, **given),
        "random": cell("random", "delayrl/Ant-v4", 0, **given),
    }


def of(
    summary: Summary, label: str, delay: int | str = 5, env: str = "delayrl/Ant-v4", setting: Setting = PAPER
) -> Result:
    return summary.results[Place(setting, env, delay, label)]


def anchored(cells: dict[str, Cell], **curves: list[list[float]]) -> list[dict[str, Any]]:
    """Random: 0 and 20, so 10. Delay-free SAC ends at 100 and 120, so 110."""
    curves = {"random": [[0.0] * 3, [20.0] * 3], "sac": [[0.0, 50, 100], [0.0, 50, 120]]} | curves
    return [r for name, runs in curves.items() for seed, c in enumerate(runs) for r in curve(cells[name], seed, c)]


# Results by hand


def test_a_table_of_the_paper_by_hand() -> None:
    cells = small()
    summary = summarise(anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]]), list(cells.values()))
    result = of(summary, "vdpo")
    assert result.curves.steps.tolist() == [100, 200, 300]
    assert result.random_anchor.value == 10
    assert result.reference_anchor[:3] == (110, 2, "sac, no delay")
    np.testing.assert_allclose(result.normalise(result.curves.final), [0.5, 1.5])
    assert result.steps_to_threshold == 200  # mean 115; it falls to 110 after, and the first time counts
    assert result.seeds_at_threshold == 2

    normalised, steps = summary.tables
    entry = summary.entry(normalised, ("delayrl/Ant-v4", 5), "vdpo")
    assert (entry.value, entry.std) == (1.0, pytest.approx(math.sqrt(0.5)))
    assert (entry.raw, entry.raw_std) == (110, pytest.approx(math.sqrt(5000)))
    assert entry.published == ("2", 1.11, 0.04)
    assert summary.entry(steps, ("delayrl/Ant-v4", 5), "vdpo").published == (
        "1",
        420_000,
        pytest.approx(math.nan, nan_ok=True),
    )
    (aggregate,) = summary.aggregates
    assert (aggregate.iqm, aggregate.tasks, aggregate.runs) == (1.0, 1, 2)


def test_columns_that_were_not_run_are_empty_beside_the_papers_figure() -> None:
    cells = small()
    summary = summarise(anchored(cells), list(cells.values()))
    table = summary.tables[0]
    assert table.columns == ["a-sac", "dcac", "dida", "bpql", "ad-sac", "vdpo"]
    entry = summary.entry(table, ("delayrl/Ant-v4", 5), "bpql")
    assert math.isnan(entry.value)
    assert math.isnan(entry.raw)
    assert entry.published == ("2", 0.96, 0.03)


def test_without_anchors_there_are_raw_returns_and_nothing_else() -> None:
    cells = small()
    for missing in ("sac", "random"):
        left = {name: c for name, c in cells.items() if name != missing}
        every = anchored(cells, vdpo=[[0.0, 1, 2], [0.0, 1, 4]])
        summary = summarise([r for r in every if r["agent"] != missing], list(left.values()))
        entry = summary.entry(summary.tables[0], ("delayrl/Ant-v4", 5), "vdpo")
        assert math.isnan(entry.value)
        assert entry.raw == 3
        assert not summary.aggregates


def test_reference_rows_anchor_where_there_is_no_sac() -> None:
    cells = small()
    del cells["sac"]
    inner = [r for seed in range(2) for r in curve(cells["vdpo"], seed, [0.0, 10, 210], "reference")]
    every = anchored(cells | small(), vdpo=[[0.0, 0, 110], [0.0, 0, 110]])
    summary = summarise([r for r in every if r["agent"] != "sac"] + inner, list(cells.values()))
    result = of(summary, "vdpo")
    assert result.reference_anchor[:3] == (210, 2, "the reference inside vdpo, Δ=5")
    np.testing.assert_allclose(result.normalise(result.curves.final), [0.5, 0.5])
    for table in summary.tables:  # not only below: the tables' heads promise the delay-free return
        assert "Ret_df: the reference inside vdpo, Δ=5" in summary.entry(table, ("delayrl/Ant-v4", 5), "vdpo").note
    assert "the reference inside vdpo" in markdown(summary, "t", {})


@pytest.mark.parametrize("change", [{"protocol": "official"}, {"total": 200, "done": 200}, {"preset": "small"}])
def test_delay_free_sac_of_another_protocol_preset_or_budget_is_no_anchor(change: dict[str, Any]) -> None:
    cells = small() | {"sac": cell("sac", "delayrl/Ant-v4", 0, 2, **{"total": 300, "done": 300} | change)}
    summary = summarise(anchored(cells, vdpo=[[0.0, 1, 2], [0.0, 1, 4]]), list(cells.values()))
    assert math.isnan(of(summary, "vdpo").reference_anchor.value)


def test_a_reference_that_is_worse_than_random_normalises_nothing() -> None:
    cells = small()
    curves = anchored(cells, sac=[[0.0, 0, 5], [0.0, 0, 5]], vdpo=[[0.0, 0, 50], [0.0, 0, 50]])
    result = of(summarise(curves, list(cells.values())), "vdpo")
    assert np.isnan(result.normalise(result.curves.final)).all()


def test_a_run_that_goes_on_is_not_compared_as_if_it_had_ended() -> None:
    cells = small()
    cells["vdpo"] = cell("vdpo", "delayrl/Ant-v4", 5, 2, total=300, done=200, status="running")
    summary = summarise(anchored(cells, vdpo=[[0.0, 100], [0.0, 100, 500]]), list(cells.values()))
    assert of(summary, "vdpo").runs == 1  # the seed that has ended; the other is not mixed in
    summary = summarise(anchored(cells, vdpo=[[0.0, 100], [0.0, 100]]), list(cells.values()))
    result = of(summary, "vdpo")
    assert result.partial
    assert not summary.aggregates
    entry = summary.entry(summary.tables[1], ("delayrl/Ant-v4", 5), "vdpo")
    assert not entry.missed  # it may yet get there
    assert "at 200 of 300 steps" in entry.note
    assert "at 200 of 300 steps" in markdown(summary, "t", {})
    ended = small()
    summary = summarise(anchored(ended, vdpo=[[0.0, 1, 2], [0.0, 1, 2]]), list(ended.values()))
    assert summary.entry(summary.tables[1], ("delayrl/Ant-v4", 5), "vdpo").missed


def test_seeds_that_are_missing_are_told() -> None:
    cells = small(seeds=3)
    summary = summarise(anchored(cells, vdpo=[[0.0, 1, 60]]), list(cells.values()))
    entry = summary.entry(summary.tables[0], ("delayrl/Ant-v4", 5), "vdpo")
    assert entry.value == 0.5
    assert math.isnan(entry.std)  # one seed
    assert "1 of 3 seeds" in entry.note
    assert math.isnan(summary.aggregates[0].low)


def test_a_failed_seed_beside_one_that_has_ended() -> None:
    """A cell of its own, as with lockstep = 1: it did not fail at the last step of the other."""
    cells = small() | {"vdpo": cell("vdpo", "delayrl/Ant-v4", 5, seeds=(0,), total=300, done=300)}
    failed = cell("vdpo", "delayrl/Ant-v4", 5, seeds=(1,), id="1", total=300, done=100, status="failed")
    todo = cell("vdpo", "delayrl/Ant-v4", 5, seeds=(2,), id="2", total=300, done=0, status="todo")
    summary = summarise(anchored(cells, vdpo=[[0.0, 1, 60]]), [*cells.values(), failed, todo])
    entry = summary.entry(summary.tables[0], ("delayrl/Ant-v4", 5), "vdpo")
    assert entry.note == "1 of 3 seeds · failed at 100 of 300 steps"


def test_over_all_delays_conditions_are_counted() -> None:
    """Or an agent that was spared the long delays would look as if it had had them."""
    late = {delay: cell("vdpo", "delayrl/Ant-v4", delay, 2, total=300, done=300) for delay in (5, 25)}
    cells = small() | {"bpql": cell("bpql", "delayrl/Ant-v4", 5, 2, total=300, done=300)}
    every = anchored(cells, vdpo=[[0.0, 0, 60], [0.0, 0, 60]], bpql=[[0.0, 0, 60], [0.0, 0, 60]])
    every += curve(late[25], 0, [0, 0, 30]) + curve(late[25], 1, [0, 0, 30])
    summary = summarise(every, [*cells.values(), late[25]])
    found = {(a.label, a.delay): (a.tasks, a.runs) for a in summary.aggregates}
    assert found == {
        ("bpql", 5): (1, 2),
        ("vdpo", 5): (1, 2),
        ("vdpo", 25): (1, 2),
        ("bpql", None): (1, 2),
        ("vdpo", None): (2, 4),
    }
    assert "2 conditions, 4 runs" in markdown(summary, "t", {})


def test_cells_that_share_all_but_their_seeds_are_one_and_others_are_not_mixed() -> None:
    cells = small()
    more = cell("vdpo", "delayrl/Ant-v4", 5, id="more", seeds=(7,), total=300, done=300)
    other = cell("vdpo", "delayrl/Ant-v4", 5, 2, id="wide", overrides={"width": 64}, total=300, done=300)
    every = anchored(cells, vdpo=[[0.0, 0, 10], [0.0, 0, 20]]) + curve(more, 7, [0, 0, 30])
    every += curve(other, 0, [0, 0, 1000]) + curve(other, 1, [0, 0, 1000])
    summary = summarise(every, [*cells.values(), more, other])
    assert of(summary, "vdpo").curves.final.tolist() == [10, 20, 30]
    assert of(summary, "vdpo width=64").curves.final.tolist() == [1000, 1000]
    assert [t.title for t in summary.tables if t.kind == "ablation"] == ["Ablation of vdpo"]
    again = cell("vdpo", "delayrl/Ant-v4", 5, 2, id="~twice", total=300, done=300)
    summary = summarise(every + curve(again, 0, [0, 0, 5]), [*cells.values(), more, again, other])
    assert of(summary, "vdpo").curves.final.tolist() == [10, 20, 30]
    assert of(summary, "vdpo #~twice").curves.final.tolist() == [5]


def test_ablation_meets_the_papers_columns() -> None:
    chosen = [cell("vdpo", "Ant-v4", 5, overrides={"representation": r}) for r in ("mlp", "transformer-no-belief")]
    summary = summarise([], [*chosen, cell("vdpo", "Ant-v4", 5), cell("vdpo", "Ant-v4", 25)])
    (table,) = [t for t in summary.tables if t.kind == "ablation"]
    assert table.rows == [("Ant-v4", 5)]
    figures = {c: summary.entry(table, ("Ant-v4", 5), c).published for c in table.columns}
    assert {label: f[:2] for label, f in figures.items() if f} == {
        "vdpo": ("3", 1.11),
        "vdpo representation=mlp": ("3", 0.86),
        "vdpo representation=transformer-no-belief": ("3", 1.09),
    }


def test_stochastic_delays_have_their_table() -> None:
    summary = summarise([], [cell("vdpo", "delayrl/Walker2d-v4", "paper-stochastic-5"), cell("bpql", "X", "walk:8")])
    (table,) = summary.tables
    assert table.kind == "stochastic"
    assert summary.entry(table, ("delayrl/Walker2d-v4", "paper-stochastic-5"), "vdpo").published.table == "4"  # type: ignore[union-attr]
    assert summary.entry(table, ("X", "walk:8"), "bpql").published is None


def test_published_figures() -> None:
    figures = paper()
    assert len(figures) == 162 + 162 + 27 + 54
    assert figures["normalised", "Walker2d-v4", "50", "bpql", ""] == ("2", 0.23, 0.10)
    assert figures["steps", "Ant-v4", "5", "vdpo", ""].value == 420_000
    assert math.isnan(figures["steps", "Ant-v4", "5", "bpql", ""].value)
    assert figures["steps", "Ant-v4", "5", "bpql", ""].table == "1"


def test_order_of_rows_does_not_matter() -> None:
    cells = small()
    every = anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]])
    mixed = [every[i] for i in np.random.default_rng(0).permutation(len(every))]
    pages = [page(summarise(some, list(cells.values())), "t") for some in (every, mixed)]
    assert pages[0] == pages[1]


# Input that is wrong


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"return": math.nan}, "damaged"),
        ({"return": "12"}, "damaged"),
        ({"step": 1.5}, "damaged"),
        ({"step": 10**30}, "damaged"),
        ({"episode": 10**9}, "damaged"),
        ({"delay": [5]}, "damaged"),
        ({"policy": {}}, "damaged"),
        ({"episode": 1, "step": 100}, "twice"),
    ],
)
def test_a_damaged_row_is_one_line(change: dict[str, Any], words: str) -> None:
    cells = small()
    every = anchored(cells)
    with pytest.raises(DelayRLError, match=f"^row {len(every) + 1} .*{words}") as error:
        summarise([*every, every[0] | {"episode": 2} | change], list(cells.values()))
    assert "\n" not in str(error.value)


def test_a_row_without_a_column() -> None:
    with pytest.raises(DelayRLError, match="row 1 of the results has no column 'seed'"):
        summarise([{k: v for k, v in anchored(small())[0].items() if k != "seed"}])


def test_rows_of_no_cell_are_counted() -> None:
    cells = small()
    stray = cell("bpql", "Ant-v4", 5, id="gone")
    summary = summarise(anchored(cells) + curve(stray, 0, [1]), list(cells.values()))
    assert summary.unplaced == 2
    assert "2 rows belong to no cell" in markdown(summary, "t", {})


def test_rows_of_two_things_under_one_cell() -> None:
    c = cell("bpql", "Ant-v4", 5)
    rows = [row(c, 0, 100, 1.0), row(c, 0, 200, 1.0) | {"env": "Hopper-v4"}]
    with pytest.raises(DelayRLError, match=r"rows of cell .* are of different things"):
        summarise(rows, [c])


def test_nothing_to_report(tmp_path: Path) -> None:
    with pytest.raises(DelayRLError, match="nothing to report"):
        report([], [], tmp_path)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DelayRLError, match="cannot be written"):
        report([], list(small().values()), tmp_path / "file")


# Markdown and the page, without a browser

EVIL = "</script><script>alert(1)</script>"
NASTY = [
    EVIL,
    "a|b `c` *d* [e](http://f)",
    "<img src=x onerror=alert(1)>",
    "{{data}}",
    "$x^2$",
    "two\nlines",
    "<!--",
    "\ud800",
]


def nasty() -> tuple[list[Cell], list[dict[str, Any]]]:
    cells = [
        cell(agent=name, env=name, delay=name, preset=EVIL, protocol=EVIL, id=name, total=200, done=200)
        for name in NASTY
    ]
    cells += [cell("random", name, 0, preset=EVIL, protocol=EVIL, total=200, done=200) for name in NASTY]
    return cells, list(rows(cells, evaluations=2, episodes=1))


def test_names_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    cells, every = nasty()
    text = report(every, cells, tmp_path, EVIL).read_text()
    assert text.count("<script") == text.count("</script>") == 2  # the data's and the page's own
    assert "<img" not in text
    assert "<!--" not in text
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert data
    assert not set(data[1]) & set("<>&")
    found = json.loads(data[1])
    assert found["title"] == EVIL
    assert set(NASTY) <= {a["label"] for a in found["agents"]}
    assert f"<title>{EVIL}" not in text
    assert not re.search(r"(src|href)=[\"']?(http|//)", text)  # nothing from elsewhere


def test_names_cannot_break_a_markdown_table() -> None:
    cells, every = nasty()
    every += [r | {"policy": "reference"} for r in every if r["agent"] in NASTY]  # which anchors, and is named for it
    text = markdown(summarise(every, cells), EVIL, {})
    assert "Ret\\_df: the reference inside" in text
    assert not re.search(r"<(?!br>|span style=\"color:#888\">|/span>)", text)
    widths: list[int] = []
    for line in text.splitlines():
        if not line.startswith("|"):
            widths = []
            continue
        widths.append(len(re.findall(r"(?<!\\)\|", line)))
        assert widths[0] == widths[-1], line


def test_the_page_says_what_the_summary_says() -> None:
    cells = small()
    summary = summarise(anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]]), list(cells.values()))
    found = payload(summary, "title")
    vdpo = next(i for i, a in enumerate(found["agents"]) if a["label"] == "vdpo")
    assert found["agents"][vdpo]["name"] == "vdpo †"
    (result,) = [r for r in found["results"] if r["agent"] == vdpo]
    assert result["mean"] == [5, 115, 110]
    assert result["normalised"] == pytest.approx([1, math.sqrt(0.5)])
    assert result["reached"] == [200, 2]
    assert found["anchors"][result["anchor"]]["random"]["value"] == 10
    json.dumps(found, allow_nan=False)


def test_steps_are_whole_and_exact() -> None:
    cells = small(total=1_234_567, done=1_234_567)
    every = [r | {"step": 1_234_567} for r in anchored(cells, vdpo=[[0.0, 0, 500], [0.0, 0, 500]]) if r["step"] == 300]
    found = payload(summarise(every, list(cells.values())), "title")
    assert [r["reached"][0] for r in found["results"] if not r["isAnchor"]] == [1_234_567]


def test_report_of_committed_rows(tmp_path: Path) -> None:
    files = [RESULTS / f"{name}.jsonl" for name in ("pendulum", "reacher", "walk")]
    out = report(read(files), [], tmp_path)
    text = (tmp_path / "report.md").read_text()
    for picture in re.findall(r"\]\((img/.*?)\)", text):
        assert (tmp_path / picture).stat().st_size > 10_000
    assert "**1.02 ± 0.03**<br>raw -7.40 ± 0.95" in text  # bpql on Reacher-v5
    assert out.stat().st_size < 1_000_000


def test_command(tmp_path: Path) -> None:
    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "delayrl.report.report", *map(str, words), "--out", str(tmp_path / "out")]
        return subprocess.run(command, capture_output=True, text=True)

    assert run(RESULTS / "pendulum.jsonl").returncode == 0
    assert (tmp_path / "out" / "report.html").is_file()
    bad = tmp_path / "bad.jsonl"
    for content in ('{"step": 1', "[1]", '{"config": 5}', "\ud800"):
        bad.write_bytes(content.encode("utf-8", "surrogatepass"))
        done = run(bad)
        assert done.returncode != 0
        assert done.stderr.count("\n") == 1, done.stderr
        assert "bad.jsonl, line 1" in done.stderr


# The page in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("no Chromium found")
    quiet = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic"]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu", *quiet])
        yield browser
        browser.close()


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Any]:
    """Open a report from disk; afterwards the console must be empty, and nothing asked of a network."""
    errors: list[str] = []
    pages = []

    def open_page(cells: list[Cell], every: list[dict[str, Any]], title: str = "Synthetic", **options: Any) -> Any:
        out = tmp_path / "report.html"
        out.write_text(page(summarise(every, cells), title))
        view = browser.new_page(**options)
        pages.append(view)
        view.on("console", lambda message: errors.append(message.text))
        view.on("pageerror", lambda error: errors.append(str(error)))
        view.on("dialog", lambda dialog: errors.append("a dialog"))
        view.on(
            "request",
            lambda request: None if request.url.startswith(("file:", "data:")) else errors.append(request.url),
        )
        view.goto(out.as_uri())
        return view

    yield open_page
    for view in pages:
        view.close()
    assert not errors


def sampled() -> tuple[list[Cell], list[dict[str, Any]]]:
    """A part of the grid: two tasks, one cell running, one failed, one not begun."""
    cells = [c for c in full_grid(3) if c.env in ("delayrl/Ant-v4", "delayrl/Hopper-v4")]
    states = {"vdpo-delayrl/Ant-v4-25-": ("running", 400_000), "bpql-delayrl/Ant-v4-50-": ("failed", 200_000)}
    states["a-sac-delayrl/Hopper-v4-5-"] = ("todo", 0)
    cells = [replace(c, status=states[c.id][0], done=states[c.id][1]) if c.id in states else c for c in cells]
    return cells, list(rows(cells, evaluations=10, episodes=1))


def column(view: Any, table: str, index: int) -> list[str]:
    return [text.strip() for text in view.locator(f"#{table} tbody tr td:nth-child({index + 1})").all_inner_texts()]


def test_page_sorts(opened: Any) -> None:
    view = opened(*sampled())
    heads = view.locator("#all thead th").all_inner_texts()
    returns = heads.index("Return")
    button = view.locator("#all thead button").nth(returns)
    for direction, sign in (("ascending", 1), ("descending", -1)):
        button.click()
        assert view.locator("#all thead th").nth(returns).get_attribute("aria-sort") == direction
        values = [float(v.split(" ")[0].replace(",", "")) for v in column(view, "all", returns) if v]
        assert len(values) > 40
        assert values == sorted(values, key=lambda v: sign * v)
    assert column(view, "all", returns)[-1] == ""  # what is missing is last in either direction
    view.locator("#all thead button").nth(1).click()  # delays: numbers, then texts
    delays = column(view, "all", 1)
    assert delays.index("5") < delays.index("25") < delays.index("50") < delays.index("paper-stochastic-5")
    view.locator("#normalised-0 thead button", has_text="vdpo").click()
    values = [float(v.split(" ")[0]) for v in column(view, "normalised-0", 7)]
    assert values == sorted(values)


def test_page_shows_whole_steps(opened: Any) -> None:
    cells = small()
    view = opened(list(cells.values()), anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]]))
    heads = view.locator("#all thead th").all_inner_texts()
    assert sorted(column(view, "all", heads.index("Steps to Ret_df"))) == ["", "200", "300"]


def test_page_rounds_once(opened: Any) -> None:
    """A return of 3,406.46 is the same in every table."""
    cells = small()
    view = opened(list(cells.values()), anchored(cells, vdpo=[[0.0, 0, 3406.46], [0.0, 0, 3406.46]]))
    assert "raw 3,406 ± 0" in view.locator("#normalised-0").inner_text()
    assert "3,406 ± 0" in view.locator("#all").inner_text()


def test_page_filters(opened: Any) -> None:
    view = opened(*sampled())
    assert set(column(view, "all", 0)) == {"delayrl/Ant-v4", "delayrl/Hopper-v4"}
    panels = view.locator("#curves figure").count()
    view.locator("#filter-task button", has_text="Hopper").click()
    assert set(column(view, "all", 0)) == {"delayrl/Hopper-v4"}
    assert view.locator("#curves figure").count() == panels // 2
    view.locator("#filter-delay button", has_text="25").click()
    view.locator("#filter-agent button", has_text="vdpo †").first.click()
    assert column(view, "all", 2) == ["vdpo †"]
    assert column(view, "all", 1) == ["25"]
    assert view.locator("#curves polyline.curve").count() == 1
    assert view.locator("#normalised-0 thead th").count() == 3
    view.locator("#filter-task button", has_text="Hopper").click()
    assert set(column(view, "all", 0)) == {"delayrl/Ant-v4", "delayrl/Hopper-v4"}


def test_page_draws_curves_and_shows_values(opened: Any) -> None:
    view = opened(*sampled())
    assert view.locator("#curves figure").count() == 8  # 2 tasks × 4 delays
    assert view.locator("#curves figure").first.locator("polyline.curve").count() == 8
    assert view.locator("#delay figure").count() == 2
    figure = view.locator("#curves figure svg").first
    figure.scroll_into_view_if_needed()
    figure.hover()
    tip = view.locator("#tip")
    assert tip.is_visible()
    assert "environment steps: 500,000" in tip.inner_text() or "environment steps: 600,000" in tip.inner_text()
    assert "vdpo †" in tip.inner_text()
    axis = figure.locator("text").all_inner_texts()
    view.locator("#curves button", has_text="normalised").click()
    assert view.locator("#curves figure svg").first.locator("text").all_inner_texts() != axis
    view.locator("#curves button", has_text="each seed").click()
    assert view.locator("#curves polyline").count() > 3 * view.locator("#curves polyline.curve").count()


def test_page_marks_what_goes_on(opened: Any) -> None:
    view = opened(*sampled())
    states = column(view, "all", 10)
    assert "at 400,000 of 1,000,000 steps" in states
    assert "failed at 200,000 of 1,000,000 steps" in states
    assert "todo" in states
    assert "1 running, 1 failed, 1 todo" in view.locator("#state").inner_text()
    assert "at 400,000 of 1,000,000 steps" in view.locator("#normalised-0").inner_text()
    assert "paper 0.56 ± 0.06" in view.locator("#normalised-0").inner_text()


def test_page_in_light_and_dark(opened: Any, tmp_path: Path) -> None:
    grounds = []
    for scheme in ("light", "dark"):
        view = opened(*sampled(), color_scheme=scheme)
        grounds.append(view.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert view.evaluate("document.documentElement.dataset.theme") == scheme
    view.locator("#theme").click()
    assert view.evaluate("getComputedStyle(document.body).backgroundColor") == grounds[0] != grounds[1]


def test_page_on_a_phone(opened: Any) -> None:
    view = opened(*sampled(), viewport={"width": 390, "height": 800})
    assert view.evaluate("document.documentElement.scrollWidth") <= 390  # tables scroll, the page does not


def test_names_run_no_script(opened: Any) -> None:
    cells, every = nasty()
    view = opened(cells, every, EVIL)
    assert view.locator("h1").inner_text() == EVIL
    assert EVIL in column(view, "all", 2)
    assert view.locator("script").count() == 2
