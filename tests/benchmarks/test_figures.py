"""The generated sections of the pages are what `benchmarks/figures.py` writes from the committed rows."""

import json
from pathlib import Path

import figures
import ppo
import pytest

from delayrl.cli.main import main as delayrl

ROOT = Path(__file__).parents[2]


def section(page: str, key: str) -> str:
    """What stands between the marks of a section."""
    return (ROOT / page).read_text().split(f"<!-- {key} -->\n")[1].split(f"\n<!-- /{key} -->")[0]


@pytest.mark.parametrize("name", ["pendulum", "reacher", "walk", "walk-random", "pusher-random"])
def test_small_comparisons(name: str) -> None:
    assert section("docs/benchmarks.md", name) == f"{figures.table(name)}\n\n{figures.provenance(name)}"


def test_tables_of_one_file_each() -> None:
    assert section("docs/protocols.md", "entropies") == figures.entropies("pusher-entropy")
    assert section("docs/delays.md", "overhead") == figures.overhead()
    for key, write in (
        ("udp", figures.udp_table),
        ("overruns", figures.overruns_table),
        ("younger", figures.younger_table),
    ):
        lines = (ROOT / "benchmarks" / "results" / f"{key}.jsonl").read_text().splitlines()
        assert section("docs/runtime.md", key) == write([json.loads(line) for line in lines])


def test_speed(tmp_path: Path) -> None:
    (tmp_path / "docs" / "img").mkdir(parents=True)
    for key, text in figures.speed.pages(tmp_path).items():
        page = "benchmarks/speed/README.md" if key in figures.DETAILS else "docs/performance.md"
        assert section(page, key) == text, key
    assert (tmp_path / "docs" / "img" / "performance-sizes.png").stat().st_size > 10_000


def tables(*names: str) -> list[Path]:
    return [ROOT / "benchmarks" / "results" / f"{name}.sqlite" for name in names]


def test_the_result(tmp_path: Path) -> None:
    """On both first pages, with the parts of any-age and lost episodes."""
    result = figures.front.section(tables("evidence-1", "evidence-2", "any-age-ladder"), tmp_path)
    assert section("README.md", "result") == section("docs/index.md", "result") == result
    arms, goals = figures.ladder.sections(*tables("any-age-ladder"), tmp_path / "ladder.png")
    assert section("docs/algorithms/any-age-results.md", "ladder") == arms
    assert section("docs/algorithms/any-age-trials.md", "goals") == goals
    assert section("docs/benchmarks.md", "paper-row") == figures.paper_row.section(*tables("evidence-1-paper"))
    assert section("docs/algorithms/vdpo.md", "questions") == figures.questions.section(*tables("evidence-3"))


@pytest.mark.thorough
def test_comparisons(tmp_path: Path) -> None:
    rows = tables("evidence-1", "evidence-2", "any-age-ladder")
    assert section("docs/algorithms/any-age-results.md", "against") == figures.against.section(rows)
    poles = figures.against.section(rows, "InvertedDoublePendulum-v5")
    assert section("docs/algorithms/any-age-results.md", "against-poles") == poles
    assert section("docs/algorithms/any-age-results.md", "added-seeds") == figures.against.added(rows)
    assert section("docs/algorithms/any-age-results.md", "simpler") == figures.against.simpler(rows)
    ended = figures.front.comparable(figures.front.results_of(rows))
    cases = {(result.place.env, figures.pairs.plant(result)) for result in ended}
    assert {case for case in cases if case[1] != 0} == {*figures.pairs.CASES.values()}  # none is left out
    for key, text in figures.pairs.sections(rows).items():
        assert section("docs/benchmarks.md", key) == text, key
    assert section("docs/benchmarks.md", "lost") == figures.lost.section(rows, tmp_path / "lost.png")


THOROUGH = [pytest.param(name, marks=pytest.mark.thorough) for name in figures.REPORTS if name != "first"]


def test_each_report_is_checked() -> None:
    assert {page.parent for page in (ROOT / "docs" / "results").rglob("report.md")} == {
        ROOT / "docs" / "results" / folder for folder in figures.REPORTS.values()
    }


@pytest.mark.parametrize("name", ["first", *THOROUGH])
def test_reports(name: str, tmp_path: Path) -> None:
    folder = ROOT / "docs" / "results" / figures.REPORTS[name]
    delayrl(["bench", "report", str(*tables(name)), "--out", str(tmp_path)])
    assert (folder / "report.md").read_text() == (tmp_path / "report.md").read_text()


def test_ppo() -> None:
    assert section("docs/simulators.md", "ppo") == ppo.table()
