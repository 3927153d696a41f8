"""The page: its data, what must never break out of it, and the page in a real browser."""

import functools
import json
import math
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from synthetic import EVIL, NASTY, anchored, full_grid, longer_reference, nasty, rows, small, standing, two_lengths

from delayrl.report.page import page, payload
from delayrl.report.report import report
from delayrl.report.summary import Summary, summarise
from delayrl.run.cell import Progress


def test_names_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    cells, every = nasty()
    text = report(every, cells, tmp_path, EVIL).read_text()
    assert text.count("<script") == text.count("</script>") == 2  # the data's and the page's own
    assert "<img" not in text
    assert "<!--" not in text
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert data
    assert not set(data[1]) & set("<>&")
    shown = json.loads(data[1])
    assert shown["title"] == EVIL
    assert set(NASTY) <= {a["label"] for a in shown["agents"]}
    assert f"<title>{EVIL}" not in text
    assert not re.search(r"(src|href)=[\"']?(http|//)", text)  # nothing from elsewhere


def test_the_page_says_what_the_summary_says() -> None:
    cells = small()
    summary = summarise(anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]]), [*cells.values()])
    shown = payload(summary, "title")
    vdpo = next(i for i, a in enumerate(shown["agents"]) if a["label"] == "vdpo")
    assert shown["agents"][vdpo]["name"] == "vdpo †"
    (result,) = [r for r in shown["results"] if r["agent"] == vdpo]
    assert result["mean"] == [5, 115, 110]
    assert result["normalised"] == pytest.approx([1, math.sqrt(0.5)])
    assert (result["reached"], result["missed"]) == (200, False)
    assert result["area"] == pytest.approx([(0.5 + 5 / 6) / 2, math.sqrt(2) / 6])
    assert shown["anchors"][result["anchor"]]["random"]["value"] == 10
    json.dumps(shown, allow_nan=False)


def test_steps_are_integers_and_exact() -> None:
    cells = small(steps=1_234_567)
    every = [r | {"step": 1_234_567} for r in anchored(cells, vdpo=[[0.0, 0, 500], [0.0, 0, 500]]) if r["step"] == 300]
    shown = payload(summarise(every, [*cells.values()]), "title")
    assert [r["reached"] for r in shown["results"] if not r["isAnchor"]] == [1_234_567]


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

    def open_page(summary: Summary, title: str = "Synthetic", description: str = "", **options: Any) -> Any:
        out = tmp_path / "report.html"
        out.write_text(page(summary, title, description=description))
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


@functools.cache
def sampled() -> Summary:
    """Of a part of the grid: two tasks, one cell running, one failed, one not begun."""
    progress = {
        "vdpo-delayrl/Ant-v4-25-": Progress("running", 400_000),
        "bpql-delayrl/Ant-v4-50-": Progress("failed", 200_000),
        "a-sac-delayrl/Hopper-v4-5-": Progress("todo", 0),
    }
    cells = [(cell, progress.get(cell.id, ended)) for cell, ended in full_grid(3, ["Ant", "Hopper"])]
    return summarise(list(rows(cells, evaluations=10, episodes=1)), cells)


def column(view: Any, table: str, index: int) -> list[str]:
    return [text.strip() for text in view.locator(f"#{table} tbody tr td:nth-child({index + 1})").all_inner_texts()]


@pytest.mark.thorough
def test_page_sorts(opened: Any) -> None:
    view = opened(sampled())
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


def test_page_shows_all_digits_of_steps(opened: Any) -> None:
    cells = small()
    every = anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]])
    view = opened(summarise(every, [*cells.values()]))
    heads = view.locator("#all thead th").all_inner_texts()
    assert sorted(column(view, "all", heads.index("Steps to Ret_df"))) == ["", "", "200\n200 to 200"]


def test_page_rounds_once(opened: Any) -> None:
    """A return of 3,406.46 is the same in every table."""
    cells = small()
    every = anchored(cells, vdpo=[[0.0, 0, 3406.46], [0.0, 0, 3406.46]])
    view = opened(summarise(every, [*cells.values()]))
    assert "raw 3,406 ± 0" in view.locator("#normalised-0").inner_text()
    assert "3,406 ± 0" in view.locator("#all").inner_text()


def test_page_keeps_each_seed_within_its_picture(opened: Any) -> None:
    """One far above the others leaves their mean ± std, and must not leave the chart."""
    cells = small(seeds=5)
    every = anchored(cells, vdpo=[[0.0, 0, 9000], *([[0.0, 0, 60]] * 4)])
    view = opened(summarise(every, [*cells.values()]))
    view.locator("#curves button", has_text="each seed").click()
    assert view.evaluate("document.activeElement.textContent") == "each seed"  # the focus stays
    drawn = [line.get_attribute("points").split() for line in view.locator("#curves svg polyline").all()]
    assert min(float(point.split(",")[1]) for line in drawn for point in line) >= 0


def test_page_sorts_costs_by_size_and_keeps_the_order(opened: Any) -> None:
    cells = small() | {name: standing(name, "delayrl/Ant-v4", 5, 2, steps=300) for name in ("bpql", "a-sac")}
    every = anchored(cells, **{name: [[0.0, 0, 60]] * 2 for name in ("vdpo", "bpql", "a-sac")})
    configs = [
        cells[name][0].condition.columns
        | {"cell": cells[name][0].id, "configuration": name, "schedule": {"steps": 300}, "hyperparameters": {}}
        | {"cost": {"parameters": 9, "gradient_steps": {"a": 1.0}, "batches": [8], "flops": flops}}
        for name, flops in (("vdpo", 1.4e9), ("bpql", 3e8), ("a-sac", 2e3))
    ]
    named = [row | {"configuration": row["agent"]} for row in every]
    view = opened(summarise(named, [*cells.values()], configs))
    view.locator("#cost-table button", has_text="FLOP").click()
    assert column(view, "cost-table", 5) == ["2k", "300M", "1.4G"]
    view.locator("#filter-agent .chip", has_text="bpql").click()
    assert column(view, "cost-table", 5) == ["300M"]
    view.locator("#filter-agent .chip", has_text="bpql").click()
    assert column(view, "cost-table", 5) == ["2k", "300M", "1.4G"]


def test_page_draws_the_curve_of_a_longer_reference_as_far_as_the_learners(opened: Any) -> None:
    cells, every = longer_reference()
    view = opened(summarise(every, cells))
    curves = view.locator("#curves polyline.curve")
    points = [line.get_attribute("points").split() for line in curves.all()]
    assert sorted(map(len, points)) == [3, 4, 4]
    view.locator("#curves figure svg").hover()
    assert "delay-free SAC (500 steps)\n30.0 (15.9 to 44.1)" in view.locator("#tip").inner_text()
    view.locator("#curves button", has_text="each seed").click()
    assert view.locator("#curves svg polyline").count() == 3 + 6
    view.locator("#curves button", has_text="normalised").click()
    assert curves.count() == 1  # of vdpo alone: the longer one is no anchor


@pytest.mark.thorough
def test_page_filters(opened: Any) -> None:
    view = opened(sampled())
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


@pytest.mark.thorough
def test_page_compares_each_two_agents(opened: Any) -> None:
    view, shown = opened(sampled()), payload(sampled(), "")
    lines = {(c["delay"], c["one"]) for c in shown["comparisons"]}
    assert view.locator("#comparison tbody tr").count() == len(lines)
    assert view.locator("#comparison tbody td b").count() == sum(c["clear"] for c in shown["comparisons"])
    first = view.locator("#comparison thead th").all_inner_texts()[2].removeprefix("over ")
    assert first == shown["agents"][min(c["other"] for c in shown["comparisons"])]["name"]


def test_page_draws_curves_and_shows_values(opened: Any) -> None:
    view = opened(sampled())
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


def test_page_draws_the_delay_free_line_of_each_length(opened: Any) -> None:
    """Two labelled ones, where results of two lengths share a panel; normalised both are 1."""
    cells, every = two_lengths()
    view = opened(summarise(every, cells))
    marks = [sorted(figure.locator("text.mark").all_text_contents()) for figure in view.locator("#curves figure").all()]
    assert marks == [["400 steps", "800 steps"], []]  # at Δ = 5, and at 25, where there is one agent
    assert sorted(view.locator("#delay text.mark").all_text_contents()) == ["400 steps", "800 steps"]
    view.locator("#curves button", has_text="normalised").click()
    assert view.locator("text.mark").count() == 0


@pytest.mark.thorough
def test_page_marks_what_goes_on(opened: Any) -> None:
    view = opened(sampled())
    states = column(view, "all", 3)
    assert "at 400,000 of 1,000,000 steps" in states
    assert "failed at 200,000 of 1,000,000 steps" in states
    assert "todo" in states
    assert "1 running, 1 failed, 1 todo" in view.locator("#state").inner_text()
    assert "at 400,000 of 1,000,000 steps" in view.locator("#normalised-0").inner_text()
    assert "paper 0.72 ± 0.03" in view.locator("#normalised-0").inner_text()
    assert "paper 0.56 ± 0.06" not in view.locator("#normalised-0").inner_text()  # of the cell that runs


def test_page_in_light_and_dark(opened: Any, tmp_path: Path) -> None:
    grounds = []
    for scheme in ("light", "dark"):
        view = opened(sampled(), color_scheme=scheme)
        grounds.append(view.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert view.evaluate("document.documentElement.dataset.theme") == scheme
    view.locator("#theme").click()
    assert view.evaluate("getComputedStyle(document.body).backgroundColor") == grounds[0] != grounds[1]


@pytest.mark.thorough
def test_page_on_a_phone(opened: Any) -> None:
    view = opened(sampled(), viewport={"width": 390, "height": 800})
    assert view.evaluate("document.documentElement.scrollWidth") <= 390  # tables scroll, the page does not


def test_page_begins_with_what_must_be_known(opened: Any) -> None:
    """The grid's description, and what is overridden in all cells; machines and libraries come last."""
    cells = [standing("bpql", "Ant", 5, 1, steps=200, overrides={"width": 8})]
    view = opened(summarise(rows(cells, evaluations=2, episodes=1), cells), description=f"Wide or not {EVIL}.")
    assert view.locator("#head p").all_inner_texts()[1:] == [
        f"Wide or not {EVIL}.",
        "Returns on Ant are not normalised: the random policy has no rows of this protocol.",
        "Overridden in all cells of bpql: width=8.",
    ]


def test_names_run_no_script(opened: Any) -> None:
    cells, every = nasty()
    view = opened(summarise(every, cells), EVIL)
    assert view.locator("h1").inner_text() == EVIL
    assert EVIL in column(view, "all", 2)
    assert view.locator("script").count() == 2
