"""Tables in the paper's layout, and the paper's values beside ours."""

import math
from typing import Any

import pytest
from synthetic import row, rows, small, standing

from delayrl.bench.grid import load_grid
from delayrl.report.markdown import markdown
from delayrl.report.summary import summarise
from delayrl.report.tables import TableEntry, published_values
from delayrl.report.wording import captions
from delayrl.run.cell import Progress
from delayrl.run.condition import resolve
from delayrl.run.rows import CONFIGURATION


def test_columns_that_were_not_run_are_empty_beside_the_papers_value() -> None:
    normalised, steps = summarise([], [*small(steps=1_000_000).values()]).tables
    table = normalised
    assert table.columns == ["a-sac", "dcac", "dida", "bpql", "ad-sac", "vdpo"]
    entry = table.entries["delayrl/Ant-v4", 5, "bpql"]
    assert math.isnan(entry.value)
    assert math.isnan(entry.raw)
    assert entry.published == ("2", 0.96, 0.03)
    assert steps.entries["delayrl/Ant-v4", 5, "vdpo"].published[:2] == ("1", 420_000)  # type: ignore[index]


def test_rows_and_columns_without_a_number_are_left_out() -> None:
    """The list of all results has them. A place beside numbers stays, empty."""
    done = [standing("bpql", "Ant-v4", 5, preset="small"), standing("vdpo", "Ant-v4", 25, preset="small")]
    late = [("dida", 5), ("bpql", 50)]
    todo = [standing(agent, "Ant-v4", delay, preset="small", state="todo", step=0) for agent, delay in late]
    summary = summarise(rows(done), [*done, *todo])
    for table in summary.tables:
        assert (table.rows, table.columns) == ([("Ant-v4", 5), ("Ant-v4", 25)], ["bpql", "vdpo"])
        assert table.entries["Ant-v4", 25, "bpql"] == TableEntry()
    assert "| Ant-v4 | 50 | bpql |" in markdown(summary, "", {})
    assert not summarise([], todo).tables


def test_an_ablation_has_only_rows_of_a_variant() -> None:
    """The plain agent's number is in another table, and what the entries are is said once."""
    plain = [standing("bpql", "Ant-v4", delay, preset="small") for delay in (5, 25)]
    variants = [
        standing("bpql", "Ant-v4", delay, preset="small", overrides={"n_steps": 1}, state="todo", step=0)
        for delay in (5, 25)
    ]
    assert not [t for t in summarise(rows(plain), [*plain, *variants]).tables if t.kind == "ablation"]
    variants[0] = standing("bpql", "Ant-v4", 5, preset="small", overrides={"n_steps": 1})
    summary = summarise(rows([*plain, variants[0]]), [*plain, *variants])
    (table,) = [t for t in summary.tables if t.kind == "ablation"]
    assert (table.rows, table.columns) == ([("Ant-v4", 5)], ["bpql", "bpql n_steps=1"])
    first, steps, ablation = captions(summary.tables)
    assert first.startswith("Final return")
    assert steps.startswith("First evaluation")
    assert ablation == "Entries are written as in “Normalised return, constant delays”."
    assert [first, steps] == list(captions(summary.tables[:2]))


def test_ablation_meets_the_papers_columns() -> None:
    chosen = [standing("vdpo", "Ant-v4", 5, overrides={"representation": r}) for r in ("mlp", "transformer-no-belief")]
    summary = summarise([], [*chosen, standing("vdpo", "Ant-v4", 5), standing("vdpo", "Ant-v4", 25)])
    (table,) = [t for t in summary.tables if t.kind == "ablation"]
    assert table.rows == [("Ant-v4", 5)]
    published = {c: table.entries["Ant-v4", 5, c].published for c in table.columns}
    assert {label: value[:2] for label, value in published.items() if value} == {
        "vdpo": ("3", 1.11),
        "vdpo representation=mlp": ("3", 0.86),
        "vdpo representation=transformer-no-belief": ("3", 1.09),
    }


@pytest.mark.parametrize("changes", [{"preset": "small"}, {"steps": 20_000}, {"overrides": {"n_steps": 1}}])
def test_the_papers_values_stand_only_beside_runs_like_the_papers(changes: dict[str, Any]) -> None:
    """Of the paper's preset, for as many steps, with its hyperparameters; no column is there for its agents either."""
    cells = [standing("vdpo", "delayrl/Ant-v4", 5, **changes), standing("bpql", "delayrl/Ant-v4", 5, **changes)]
    for table in summarise([], cells).tables:
        published = {label: table.entries["delayrl/Ant-v4", 5, label].published for label in table.columns}
        if "overrides" in changes:
            assert published.pop("dida").table in ("1", "2")
            assert [published[label] for label in ("vdpo", "bpql")] == [None, None]
        else:
            assert published == {"vdpo": None, "bpql": None}


@pytest.mark.parametrize(
    ("known", "ended", "steps"), [(False, True, 10**6), (True, False, 10**6), (True, True, 2 * 10**6)]
)
def test_the_papers_values_stand_beside_whole_runs_of_known_options(known: bool, ended: bool, steps: int) -> None:
    """Neither beside rows without a configuration, nor a part of a run, nor a longer one."""
    for whole in (True, False):
        end = 10**6 if whole else steps
        cell = standing(
            "vdpo", "delayrl/Ant-v4", 5, preset="paper", steps=end, step=end if whole or ended else end // 2
        )
        own = [row | {"cell": None, CONFIGURATION: "a" * 64} for row in rows([cell], 10, 1)]
        config = resolve("vdpo", "delayrl/Ant-v4", 5, "paper", "corrected", {"steps": end}).config
        config |= {CONFIGURATION: "a" * 64}
        for table in summarise(own, [], [config] if whole or known else []).tables:
            published = table.entries["delayrl/Ant-v4", 5, "vdpo"].published
            assert (published is not None) == whole, table.kind


def test_the_ablation_shows_no_value_of_another_variant() -> None:
    """Table 3 varies the representation alone: its transformer is not `direction=forward`."""
    overrides = [{}, {"direction": "forward"}, {"representation": "mlp"}, {"evaluate_every": 20_000}]
    summary = summarise([], [standing("vdpo", "Ant-v4", 5, overrides=o) for o in overrides])
    (table,) = [table for table in summary.tables if table.kind == "ablation"]
    published = {label: table.entries["Ant-v4", 5, label].published for label in table.columns}
    assert published["vdpo direction=forward"] is None
    assert published["vdpo"] == published["vdpo evaluate_every=20000"] == ("3", 1.11, 0.04)
    assert published["vdpo representation=mlp"] is not None


def test_stochastic_delays_have_their_table() -> None:
    summary = summarise(
        [], [standing("vdpo", "delayrl/Walker2d-v4", "paper-stochastic-5"), standing("bpql", "X", "walk:8")]
    )
    (table,) = summary.tables
    assert table.kind == "stochastic"
    assert table.entries["delayrl/Walker2d-v4", "paper-stochastic-5", "vdpo"].published.table == "4"  # type: ignore[union-attr]
    assert table.entries["X", "walk:8", "bpql"].published is None


def test_the_papers_row_shows_its_number() -> None:
    """Steps to the delay-free return under both protocols, from a reference that is longer than every learner."""
    cells = [(cell, Progress("done", cell.condition.steps)) for cell in load_grid("evidence-1-paper").cells]
    every = [
        row(cell, seed, step, {"sac": 100.0, "random": 0.0}.get(condition.agent, 300 * step / condition.steps))
        for cell in cells
        for condition in [cell[0].condition]
        for seed in cell[0].seeds
        for step in range(condition.steps // 10, condition.steps + 1, condition.steps // 10)
    ]
    summary = summarise(every, cells)
    tables = [table for table in summary.tables if table.kind == "steps"]
    assert {table.setting.protocol for table in tables} == {"corrected", "official"}
    for table in tables:
        (entries,) = [[table.entries[at, delay, label] for label in table.columns] for at, delay in table.rows]
        reached = {label: entry.value for label, entry in zip(table.columns, entries, strict=True)}
        late = {"vdpo": 36_000, "ad-sac": 36_000, "dcac": 36_000, "dida": 120_000, "a-sac": 120_000, "bpql": 180_000}
        assert reached == late  # the mean of five evaluations up to six tenths of the steps: 300 × 0.4 is above 100
        assert all("reference of 1,000,000 steps" in entry.note for entry in entries)
        published = {label: entry.published for label, entry in zip(table.columns, entries, strict=True)}
        assert {label: value.value for label, value in published.items() if value} == {
            "vdpo": 10_000,
            "ad-sac": 40_000,
            "dcac": 20_000,
            "dida": 100_000,
            "a-sac": 170_000,
            "bpql": 270_000,
        }  # the reference, not the learner, is as long as the paper's
    for table in summary.tables:
        if table.kind == "normalised":
            assert {entry.published for entry in table.entries.values()} == {None}
    text = markdown(summary, "t", {})
    threshold = "100.0 ± 0.0 (sac, no delay, 1,000,000 steps)"
    assert text.count(f"| delayrl/Pusher-v4 | 60,000 | 0.00 ± 0.00 (3 seeds) | none |  | {threshold} |") == 2
    assert "and its steps are noted" in text


@pytest.mark.parametrize(
    ("steps", "reference", "shown"), [(1_000, 1_000, True), (60, 1_000, True), (1_000, 2_000, False)]
)
def test_the_papers_steps_need_a_reference_of_its_budget(steps: int, reference: int, shown: bool) -> None:
    """In thousands of steps. A longer reference is another threshold."""
    env = "delayrl/Ant-v4"
    known = [("vdpo", 5, steps, 200.0), ("sac", 0, reference, 100.0), ("random", 0, steps, 0.0)]
    cells = [standing(agent, env, delay, steps=count * 1000) for agent, delay, count, _ in known]
    rows = [row(c, s, c[0].condition.steps, x[3]) for c, x in zip(cells, known, strict=True) for s in c[0].seeds]
    (table,) = [table for table in summarise(rows, cells).tables if table.kind == "steps"]
    entry = table.entries[env, 5, "vdpo"]
    assert entry.value == steps * 1000
    assert (entry.published is not None) == shown


def test_other_settings_leave_the_paper_where_it_is() -> None:
    """A variant with another preset takes no published value from an empty place of the paper's."""
    cells = [standing("vdpo", "delayrl/Ant-v4", 25), standing("bpql", "delayrl/Ant-v4", 50)]
    other = standing("vdpo", "delayrl/HalfCheetah-v4", 25, preset="small", overrides={"discount": 0.9})
    for more in ([], [other]):
        (table,) = (
            t for t in summarise([], cells + more).tables if (t.kind, t.setting.preset) == ("normalised", "paper")
        )
        assert table.entries["delayrl/Ant-v4", 50, "vdpo"].published is not None


def test_published_values() -> None:
    values = published_values()
    assert len(values) == 162 + 162 + 27 + 54
    assert values["normalised", "Walker2d-v4", "50", "bpql", ""] == ("2", 0.23, 0.10)
    assert values["steps", "Ant-v4", "5", "vdpo", ""].value == 420_000
    assert math.isnan(values["steps", "Ant-v4", "5", "bpql", ""].value)
    assert values["steps", "Ant-v4", "5", "bpql", ""].table == "1"
