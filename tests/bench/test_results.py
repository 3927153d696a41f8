"""Rows of a grid and the published table: none lost, none twice, with the versions that made them."""

import contextlib
import json
import re
import shutil
import sqlite3
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from support import tiny

import delayrl
from delayrl.bench import folders
from delayrl.bench.grid import Grid, load_grid
from delayrl.bench.results import cells_done, collect, configs_of, read_table, rows_of
from delayrl.bench.status import progress, seconds_left, standing
from delayrl.bench.worker import Outcome, work
from delayrl.cli.main import main
from delayrl.run import provenance
from delayrl.run.cell import Cell, Progress
from delayrl.run.disk import lock
from delayrl.run.folder import RunFolder

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
MIXED = """
description = "Two protocols"
preset = "small"
seeds = 2
tasks = ["Reacher-v5"]
delays = [2]
[overrides]
steps = 60
random_steps = 20
replay_capacity = 50
evaluate_every = 30
evaluation_episodes = 2
[[product]]
agents = ["random"]
[[product]]
agents = ["random"]
protocol = "official"
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Grid, Path]:
    """A grid with one cell that was trained in this process, and one that has not begun."""
    home = tmp_path_factory.mktemp("finished")
    grid = load_grid(tiny(home, text=MIXED, name="mixed"))
    assert work_on(grid.cells[0], home / "runs") == Outcome("done", "")
    return grid, home / "runs"


def work_on(cell: Cell, runs: Path) -> Outcome:
    folders.prepare(runs / cell.folder, cell)
    return work(runs / cell.folder)


def test_round_trip(finished, tmp_path: Path) -> None:
    """A table returns exactly the rows of the folders, and lists cells that have not begun."""
    grid, runs = finished
    expected = list(rows_of(grid.cells[:1], runs))
    assert len(expected) == 2 * 2 * 2
    assert expected[0] | {"cell": grid.cells[0].id} == expected[0]
    assert collect(grid, runs, tmp_path / "mixed.sqlite") == len(expected)
    rows, cells, configs, description = read_table(tmp_path / "mixed.sqlite")
    assert rows == expected
    assert cells == standing(grid.cells, runs)
    assert configs == configs_of(grid.cells, runs)
    assert configs[0]["versions"]["cores"]
    assert description == grid.description
    assert [config["seed"] for config in configs] == [0, 1]
    assert {row["configuration"] for row in rows} == {config["configuration"] for config in configs}
    assert configs[0]["cost"] == {"parameters": 0, "gradient_steps": {}, "batches": [], "flops": 0.0}
    assert [(p.state, p.step) for _, p in cells] == [("done", 60), ("todo", 0)]
    assert [progress(cell, runs).state for cell in grid.cells] == ["done", "todo"]


def test_the_same_rows_give_the_same_bytes(finished, tmp_path: Path) -> None:
    grid, runs = finished
    for name in ("a.sqlite", "b.sqlite", "b.sqlite"):
        collect(grid, runs, tmp_path / name)
    assert (tmp_path / "a.sqlite").read_bytes() == (tmp_path / "b.sqlite").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.sqlite", "b.sqlite"]


def test_columns_of_other_versions_and_provenance(finished, tmp_path: Path) -> None:
    """A table keeps unknown columns, constant or not, and the versions of every start."""
    grid, runs = finished
    cell = replace(grid.cells[0], id="0123")
    run = RunFolder(runs / cell.folder / "seed0")
    source = RunFolder(runs / grid.cells[0].folder / "seed0")
    run.create(source.config | {"later_versions": [{"jax": "0.10", "device": "other"}]})
    rows = source.read("rows")
    for i, row in enumerate(rows):
        run.append("rows", [row | {"physics": "ab12", "mujoco": "3.2.7" if i else "3.5.0", "return": 0.1 + 1e-17 * i}])
    alone = Grid("alone", "", Path("alone.toml"), (cell,))
    collect(alone, runs, tmp_path / "t.sqlite")
    assert read_table(tmp_path / "t.sqlite")[0] == list(rows_of([cell], runs))
    table = sqlite3.connect(tmp_path / "t.sqlite")
    config, versions = table.execute("SELECT config, versions FROM runs").fetchone()
    table.close()
    assert json.loads(config)["hyperparameters"] == source.config["hyperparameters"]
    assert [v.get("jax") for v in json.loads(versions)] == [source.config["versions"]["jax"], "0.10"]
    assert {"commit", "device", "mujoco", "gymnasium"} <= set(json.loads(versions)[0])


@pytest.mark.parametrize(
    ("table", "grid", "count"),
    [("first", "first", 3360), ("updates-per-call", BENCHMARKS / "updates-per-call.toml", 720)],
)
def test_committed_tables(table: str, grid: str | Path, count: int) -> None:
    """They open, and their cells are still those of their grids."""
    rows, cells, *_ = read_table(BENCHMARKS / "results" / f"{table}.sqlite")
    assert [cell.id for cell, _ in cells] == [cell.id for cell in load_grid(grid).cells]
    assert all((p.state, p.step) == ("done", cell.condition.steps) for cell, p in cells)
    assert len(rows) == count
    assert {row["cell"] for row in rows} == {cell.id for cell, _ in cells}


def test_plain_sql(finished, tmp_path: Path) -> None:
    """The table can be read without this library."""
    grid, runs = finished
    collect(grid, runs, tmp_path / "t.sqlite")
    table = sqlite3.connect(tmp_path / "t.sqlite")
    query = "SELECT agent, env, delay, avg(return) FROM results WHERE step = 60 GROUP BY agent, env, delay"
    (row,) = table.execute(query).fetchall()
    table.close()
    returns = [row["return"] for row in rows_of(grid.cells, runs) if row["step"] == 60]
    assert row[:3] == ("random", "Reacher-v5", 2)
    assert row[3] == pytest.approx(sum(returns) / len(returns))


def test_bad_tables(finished, tmp_path: Path) -> None:
    """Each fails with one line and leaves the file as it was."""
    grid, runs = finished
    file = tmp_path / "t.sqlite"
    with pytest.raises(delayrl.DelayRLError, match="there is no table"):
        read_table(file)
    collect(grid, runs, file)
    with sqlite3.connect(file) as table:
        table.execute("UPDATE meta SET value = '2' WHERE key = 'schema'")
    table.close()
    before = file.read_bytes()
    for what in (lambda: read_table(file), lambda: collect(grid, runs, file)):
        with pytest.raises(delayrl.DelayRLError, match="schema version 2, this program reads 1") as error:
            what()
        assert "\n" not in str(error.value)
    assert file.read_bytes() == before
    for content in (b"", b"not a table", before[: len(before) // 2], before[:5000] + b"\0" * (len(before) - 5000)):
        file.write_bytes(content)
        with pytest.raises(delayrl.DelayRLError, match="no table of results, or damaged"):
            read_table(file)
    file.unlink()
    collect(grid, runs, file)
    with pytest.raises(delayrl.DelayRLError, match="the table of the grid 'mixed'"):
        collect(Grid("other", "", grid.source, grid.cells), runs, file)
    before = file.read_bytes()
    gone = rf"rows of 1 cell that mixed has no more \({grid.cells[0].id}\); give another --out, and --also"
    with pytest.raises(delayrl.DelayRLError, match=gone):
        collect(replace(grid, cells=grid.cells[1:]), runs, file)
    assert file.read_bytes() == before
    other = replace(grid, cells=[replace(grid.cells[1], id="0123")])
    with pytest.raises(delayrl.DelayRLError, match=r"give another --out$"):  # no cell is left to take from it
        collect(other, runs, file)
    with pytest.raises(delayrl.DelayRLError, match="has no cell of mixed: it is the table of an earlier version of it"):
        collect(other, runs, tmp_path / "new.sqlite", [file])
    with pytest.raises(delayrl.DelayRLError, match=r"is a folder; give a file, such as .*/mixed\.sqlite"):
        collect(grid, runs, tmp_path)
    with pytest.raises(delayrl.DelayRLError, match="there is no table"):
        collect(grid, runs, file, [tmp_path / "nowhere.sqlite"])
    with pytest.raises(delayrl.DelayRLError, match="has no cell of mixed: it is the table of 'first'"):
        collect(grid, runs, file, [BENCHMARKS / "results" / "first.sqlite"])
    with pytest.raises(
        delayrl.DelayRLError, match=r"has no rows .* `delayrl bench run .*\.toml --runs .*elsewhere` makes"
    ):
        collect(grid, tmp_path / "elsewhere", tmp_path / "none.sqlite")
    assert not (tmp_path / "none.sqlite").exists()


def test_what_is_collected_stays(finished, tmp_path: Path) -> None:
    """Where run folders are gone, or hold less, the table's own cells stay, to the last byte."""
    grid, runs = finished
    file, part = tmp_path / "t.sqlite", tmp_path / "part"
    shutil.copytree(runs, part)
    rows = part / grid.cells[0].folder / "seed1" / "rows.jsonl"
    rows.write_text("".join(rows.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(delayrl.DelayRLError, match="seed1 ended, but rows of the last evaluation are missing"):
        collect(grid, part, file)
    assert collect(grid, runs, file) == 8
    whole = file.read_bytes()
    for folder in (part, tmp_path / "gone", runs):
        assert collect(grid, folder, file) == 8
        assert file.read_bytes() == whole
    less = changed(file, "DELETE FROM rows WHERE step = 60 AND run = (SELECT id FROM runs WHERE seed = 1)")
    assert len(read_table(less).rows) == 6
    assert collect(grid, runs, less) == 8
    assert less.read_bytes() == whole
    (part / grid.cells[0].folder / "seed0" / "config.json").unlink()
    words = r"seed0 has lost its config\.json: move .*[0-9a-f]{12} elsewhere"
    with pytest.raises(delayrl.DelayRLError, match=words):
        collect(grid, part, file)


def changed(file: Path, query: str) -> Path:
    """The table after a change, in a copy."""
    copy = file.with_name(f"changed-{file.name}")
    shutil.copy(file, copy)
    with contextlib.closing(sqlite3.connect(copy)) as table:
        table.execute(query)
        table.commit()
    return copy


def test_of_equal_rows_those_that_have_ended_count(finished, tmp_path: Path) -> None:
    """A cell that was running when it was collected is done once another table, or its run folder, says so."""
    grid, runs = finished
    file, gone = tmp_path / "t.sqlite", tmp_path / "gone"
    collect(grid, runs, file)
    whole = file.read_bytes()
    for again in (lambda copy: collect(grid, runs, copy), lambda copy: collect(grid, gone, copy, [file])):
        copy = changed(file, "UPDATE cells SET state = 'running' WHERE state = 'done'")
        assert cells_done(copy) == 0
        again(copy)
        assert copy.read_bytes() == whole
    copy = changed(file, "UPDATE cells SET state = 'running', step = 30 WHERE state = 'todo'")
    collect(grid, gone, copy)
    assert [p.state for _, p in read_table(copy).standing] == ["done", "running"]
    folders.prepare(gone / grid.cells[1].folder, grid.cells[1])
    folders.note(gone / grid.cells[1].folder, "failed", line="it diverged")  # before the step at which it was seen
    collect(grid, gone, copy)
    assert [(p.state, p.step) for _, p in read_table(copy).standing] == [("done", 60), ("failed", 0)]


@pytest.mark.parametrize(
    "query",
    [
        "DELETE FROM cells WHERE number = 0",
        "UPDATE cells SET state = 'well'",
        "UPDATE cells SET steps_per_second = 'fast'",
        "UPDATE cells SET step = 9e999",
        "UPDATE cells SET cell = json_set(cell, '$.seeds', json('[]'))",
        "UPDATE runs SET config = '{'",
        "UPDATE runs SET config = '[]'",
        "UPDATE runs SET config = json_set(config, '$.cost', 1)",
        "UPDATE runs SET config = json_set(config, '$.configuration', json('[1]'))",
        "UPDATE runs SET shared = json_remove(shared, '$.agent')",
        "UPDATE runs SET versions = '{}'",
        "UPDATE rows SET return = NULL",
        "UPDATE rows SET step = step || 'x'",
        "UPDATE rows SET more = '[]'",
    ],
)
def test_a_damaged_table_replaces_nothing(finished, tmp_path: Path, query: str) -> None:
    grid, runs = finished
    out = tmp_path / "ours.sqlite"
    collect(grid, runs, tmp_path / "t.sqlite")
    with pytest.raises(delayrl.DelayRLError, match=r"changed-t\.sqlite (is no table of results, or|has no cell)"):
        collect(replace(grid, cells=grid.cells[:1]), tmp_path / "gone", out, [changed(tmp_path / "t.sqlite", query)])
    assert not out.exists()


@pytest.mark.parametrize("step", ["'x'", "NULL"])
def test_a_damaged_step_is_compared_with_none(finished, tmp_path: Path, step: str) -> None:
    """Of a cell with as many rows elsewhere, the steps decide."""
    grid, runs = finished
    collect(grid, runs, tmp_path / "t.sqlite")
    with pytest.raises(delayrl.DelayRLError, match=r"changed-t\.sqlite is no table of results, or damaged: "):
        collect(grid, runs, changed(tmp_path / "t.sqlite", f"UPDATE cells SET step = {step}"))


def test_only_one_collects_into_a_folder(finished, tmp_path: Path) -> None:
    grid, runs = finished
    with lock(tmp_path), pytest.raises(delayrl.DelayRLError, match="another program is collecting into"):
        collect(grid, runs, tmp_path / "t.sqlite")


def test_cells_of_other_tables(finished, tmp_path: Path) -> None:
    """A grid that shares a cell takes it from the other's table, with all that the table knows of it."""
    grid, runs = finished
    collect(grid, runs, tmp_path / "theirs.sqlite")
    ours = Grid("ours", "", Path("ours.toml"), grid.cells[::-1])
    with pytest.raises(delayrl.DelayRLError, match="has no rows"):
        collect(ours, tmp_path / "gone", tmp_path / "ours.sqlite")
    assert collect(ours, tmp_path / "gone", tmp_path / "ours.sqlite", [tmp_path / "theirs.sqlite"]) == 8
    one, other = (read_table(tmp_path / f"{name}.sqlite") for name in ("ours", "theirs"))
    assert one.standing == other.standing[::-1]
    assert (one.rows, one.configs) == (other.rows, other.configs)
    (tmp_path / "theirs.sqlite").unlink()
    before = (tmp_path / "ours.sqlite").read_bytes()
    collect(ours, tmp_path / "gone", tmp_path / "ours.sqlite")
    assert (tmp_path / "ours.sqlite").read_bytes() == before


def test_an_episode_twice(finished, tmp_path: Path) -> None:
    grid, runs = finished
    cell = replace(grid.cells[0], id="4567")
    run, source = (RunFolder(runs / c.folder / "seed0") for c in (cell, grid.cells[0]))
    run.create({k: v for k, v in source.config.items() if k != "format"})
    run.append("rows", source.read("rows")[:2] + source.read("rows")[:1])
    with pytest.raises(delayrl.DelayRLError, match="holds an episode twice"):
        collect(Grid("twice", "", Path("twice.toml"), (cell,)), runs, tmp_path / "t.sqlite")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("rows.jsonl", "", "ended, but rows of the last evaluation are missing"),
        ("config.json", "hi\n", "config.json is damaged"),
    ],
)
def test_a_damaged_cell_is_not_done(finished, name: str, text: str, words: str, tmp_path: Path, capsys) -> None:
    """All commands say so, and what to do; the report shows the others."""
    grid, runs = finished
    file, home = tiny(tmp_path, text=MIXED, name="mixed"), tmp_path / "runs"
    shutil.copytree(runs, home)
    cell = grid.cells[0]
    (home / cell.folder / "seed1" / name).write_text(text)
    assert progress(cell, home).state == "failed"
    line = rf"seed1.*{words}.*: move .*{cell.folder} elsewhere, and run the cell again"
    for words_of in (["collect"], ["run", "--workers", "1", "--cells", cell.id]):
        with pytest.raises(SystemExit) as ended:
            main(["bench", words_of[0], str(file), "--runs", str(home), *words_of[1:]])
        assert ended.value.code == 2
        assert re.search(line, capsys.readouterr().err)
    main(["bench", "report", str(file), "--runs", str(home)])
    assert re.search(f"failed: .*{line}", capsys.readouterr().err)
    main(["bench", "status", str(file), "--runs", str(home)])
    assert re.search(f"failed: .*{line}", capsys.readouterr().out)


def test_a_run_that_went_on_is_not_of_its_cell(finished, tmp_path: Path) -> None:
    grid, runs = finished
    cell = replace(grid.cells[0], id="6789")
    run, source = (RunFolder(runs / c.folder / "seed0") for c in (cell, grid.cells[0]))
    config = {k: v for k, v in source.config.items() if k != "format"}
    run.create(config | {"schedule": config["schedule"] | {"steps": 2 * cell.condition.steps}})
    run.append("rows", source.read("rows"))
    alone = Grid("alone", "", Path("alone.toml"), (cell,))
    for what in (lambda: collect(alone, runs, tmp_path / "t.sqlite"), lambda: list(rows_of([cell], runs))):
        with pytest.raises(delayrl.DelayRLError, match=r"was trained for .* steps, and its cell for "):
            what()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("change", ["{}", "5", '"step": null', '"return": NaN', '"return": "1"'])
def test_a_damaged_row(finished, tmp_path: Path, change: str) -> None:
    """Reading and collecting fail with one line, and no table is written."""
    grid, runs = finished
    cell = replace(grid.cells[0], id="5678")
    run, source = (RunFolder(runs / c.folder / "seed0") for c in (cell, grid.cells[0]))
    run.remove()
    run.create({k: v for k, v in source.config.items() if k != "format"})
    run.append("rows", source.read("rows"))
    line = json.dumps(source.read("rows")[0] | json.loads(f"{{{change}}}")) if ":" in change else change
    with open(run.path / "rows.jsonl", "a") as file:
        file.write(line + "\n")
    alone = Grid("alone", "", Path("alone.toml"), (cell,))
    for what in (lambda: collect(alone, runs, tmp_path / "t.sqlite"), lambda: list(rows_of([cell], runs))):
        with pytest.raises(delayrl.DelayRLError, match=r"rows.jsonl (holds a damaged row|is damaged): ") as error:
            what()
        assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "line",
    [b"[1]", b"[]", b"null", b"\xff", b"[" * 3000, b'{"step": "x", "steps_per_second": "fast"}', b'{"step": 1e999}'],
)
def test_damaged_lines_of_journal_and_metrics(finished, tmp_path: Path, line: bytes) -> None:
    """They are as if they were not there."""
    grid, runs = finished
    shutil.copytree(runs, tmp_path / "runs")
    home = tmp_path / "runs" / grid.cells[0].folder
    for file in (home / "journal.jsonl", home / "seed0" / "metrics.jsonl"):
        with open(file, "ab") as end:
            end.write(line + b"\n")
    assert folders.journal(home) == folders.journal(runs / grid.cells[0].folder)
    assert progress(grid.cells[0], tmp_path / "runs") == Progress("done", 60)
    with folders.hold_cell(home):
        assert progress(grid.cells[0], tmp_path / "runs")[:2] == ("running", 60)


def test_random_steps_say_nothing_of_the_time_left(finished, tmp_path: Path) -> None:
    """They are fast: a cell has a speed from its first update on, and another when it is done."""
    grid, runs = finished
    done, begun = grid.cells
    shutil.copytree(runs, tmp_path / "runs")
    home = tmp_path / "runs" / begun.folder
    folders.prepare(home, begun)
    (home / "seed0").mkdir(exist_ok=True)
    lines = [{"step": 20, "steps_per_second": 1000.0}, {"step": 30, "steps_per_second": 9.0}]
    lines[1]["learning_steps_per_second"] = 5.0
    with folders.hold_cell(home):
        for metrics, speed, left in zip(lines, (None, 5.0), (None, 6.0), strict=True):
            (home / "seed0" / "metrics.jsonl").write_text(json.dumps(metrics) + "\n")
            now = progress(begun, tmp_path / "runs")
            assert now[:3] == ("running", metrics["step"], speed)
            assert seconds_left([(begun, now)], 1) == left
    (tmp_path / "runs" / done.folder / "seed0" / "metrics.jsonl").write_text(json.dumps(lines[1]) + "\n")
    assert progress(done, tmp_path / "runs").speed == 9


def test_worker(finished, tmp_path: Path) -> None:
    """The worker leaves finished and locked cells alone; an error is one line."""
    grid, runs = finished
    home = runs / grid.cells[0].folder
    before = (home / "journal.jsonl").read_text()
    assert work(home) == Outcome("done", "")
    assert (home / "journal.jsonl").read_text() == before
    (home / "journal.jsonl").write_text(before.splitlines(keepends=True)[0])  # killed before it could say "done"
    for _ in range(2):
        assert work(home) == Outcome("done", "")
        assert [event["event"] for event in folders.journal(home)] == ["begun", "done"]
    with folders.hold_cell(home):
        assert work(home).kind == "locked"
        assert progress(grid.cells[0], runs).state == "running"
    wrong = replace(grid.cells[0], id="89ab", condition=replace(grid.cells[0].condition, delay=51))
    assert work_on(wrong, tmp_path).kind == "failed"
    assert "longer than an episode" in work(tmp_path / wrong.folder).line
    (tmp_path / wrong.folder / "cell.json").write_text("{")
    assert work(tmp_path / wrong.folder).kind == "failed"  # as a mistake in somebody's agent: it would come back
    (tmp_path / wrong.folder / "cell.json").unlink()
    assert work(tmp_path / wrong.folder).kind == "died"  # as where a disk does not answer


def test_commands(finished, tmp_path: Path, capsys, monkeypatch) -> None:
    """Plan, status and collect on the command line."""
    grid, runs = finished
    words = [str(grid.source), "--runs", str(runs)]
    main(["bench", "plan", *words])
    out = capsys.readouterr().out
    assert all(cell.id in out for cell in grid.cells)
    assert "\nall cells: evaluate_every=30, evaluation_episodes=2, random_steps=20, replay_capacity=50\n" in out
    assert "mixed: 2 cells, 4 runs, 240 steps" in out
    main(["bench", "status", *words])
    out = capsys.readouterr().out
    assert "60 / 60" in out
    assert "1/2 cells · 50 % of the steps" in out
    folders.prepare(runs / grid.cells[1].folder, grid.cells[1])
    folders.note(runs / grid.cells[1].folder, "failed", line="the disk is full")
    main(["bench", "status", *words])
    out = capsys.readouterr().out
    assert f"failed: {grid.cells[1]} ({grid.cells[1].id}): the disk is full" in out
    (runs / grid.cells[1].folder / "journal.jsonl").unlink()
    main(["bench", "collect", *words, "--out", str(tmp_path / "t.sqlite")])
    assert "8 rows; 1 of 2 cells are done" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["table", "table.db", "table.toml"])
def test_a_table_of_any_name_is_reported(finished, tmp_path: Path, name: str, capsys) -> None:
    """By its first bytes. What is only named like one is refused as a damaged table."""
    grid, runs = finished
    file = tmp_path / name
    main(["bench", "collect", str(grid.source), "--runs", str(runs), "--out", str(file)])
    main(["bench", "report", str(file)])
    assert f"open {tmp_path / 'table-report' / 'report.html'}" in capsys.readouterr().out
    text = (tmp_path / "table-report" / "report.md").read_text()
    assert "random" in text
    assert grid.description in text
    for text, words in ((b"no table", "no table of results, or damaged"), (None, "there is no table")):
        other = tmp_path / "other.sqlite"
        other.write_bytes(text) if text else other.unlink()
        with pytest.raises(SystemExit):
            main(["bench", "report", str(other)])
        assert words in capsys.readouterr().err


def test_a_grid_stays_a_grid(finished, tmp_path: Path, monkeypatch, capsys) -> None:
    """Its name is not taken by a table in the current folder."""
    grid, runs = finished
    collect(grid, runs, tmp_path / "smoke")
    monkeypatch.chdir(tmp_path)
    main(["bench", "report", "smoke"])
    assert "smoke: 0 of 10 cells are done" in capsys.readouterr().out
    (page,) = tmp_path.glob("**/smoke-report/report.html")
    for file in (page, page.with_name("report.md")):
        assert load_grid("smoke").description in file.read_text()
    main(["bench", "report", "./smoke"])
    assert "smoke: 1 of 2 cells are done" in capsys.readouterr().out


def test_a_recorded_delay_is_named_as_in_its_rows(tmp_path: Path, capsys, monkeypatch) -> None:
    """The label stands for hundreds of numbers."""
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("\n".join("1234" * 100))
    file = tiny(tmp_path, text=MIXED.replace("delays = [2]", 'delays = ["recorded:log.csv"]'), name="recorded")
    cell = load_grid(file).cells[0]
    assert len(cell.condition.delay) > 400
    assert work_on(cell, Path("runs")) == Outcome("done", "")
    (label,) = {row["delay"] for row in rows_of([cell], Path("runs"))}
    for command in ("plan", "status", "report"):
        main(["bench", command, str(file), "--runs", "runs"])
        out = capsys.readouterr().out
        assert label in out or command == "report"
        assert "1,2,3,4,1" not in out
    text = Path("runs/recorded-report/report.md").read_text()
    assert label in text
    assert "1,2,3,4,1" not in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("plan nosuch", "unknown grid 'nosuch'; give a .toml file, or one of any-age-ladder, evidence-1"),
        ("plan ./nosuch.toml", "there is no grid file nosuch.toml"),
        ("report .", ". is a folder, and no grid; runs of `delayrl train` are reported by `python -m delayrl.report"),
        ("plan my.sqlite", "only `delayrl bench report` reads one"),
        ("run smoke --cells 123", "has no cell 123"),
        ("run smoke --workers 0", "--workers: must be at least 1"),
        ("run smoke --tries 0", "--tries: must be at least 1"),
        ("run smoke --time-limit 9", "a time is written as"),
        ("run smoke --backend cloud", "invalid choice"),
        ("collect smoke", "has no rows"),
        ("fly smoke", "invalid choice"),
        ("", "required"),
    ],
)
def test_bad_commands(words: str, expected: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["bench", *words.split()])
    captured = capsys.readouterr()
    assert end.value.code == 2
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert expected in captured.err
    assert list(tmp_path.iterdir()) == []


def test_commit(tmp_path: Path, monkeypatch) -> None:
    """Our checkout's commit, marked if files changed; not that of a project with us in its environment."""

    def git(*words: str) -> str:
        author = ("-c", "user.name=a", "-c", "user.email=a@b")
        command = ["git", "-C", str(tmp_path), *author, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    package = tmp_path / "environment" / "delayrl"
    package.mkdir(parents=True)
    (package / "provenance.py").write_text("")
    monkeypatch.setattr(provenance, "__file__", str(package / "provenance.py"))
    assert provenance.commit() is None
    git("init", "--quiet")
    (tmp_path / ".gitignore").write_text("environment")
    git("add", ".gitignore")
    git("commit", "--quiet", "-m", "theirs")
    assert provenance.commit() is None
    git("add", "--force", "environment")
    git("commit", "--quiet", "-m", "ours")
    assert provenance.commit() == git("rev-parse", "--short=12", "HEAD")
    (package / "provenance.py").write_text("1")
    assert provenance.commit() == git("rev-parse", "--short=12", "HEAD") + "-changed"


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("cell", '{"agent": 5}'),
        ("cell", '{"env": null}'),
        ("cell", '{"overrides": []}'),
        ("cell", '{"steps": "x"}'),
        ("cell", '{"seeds": {}}'),
        ("state", '"gone"'),
        ("step", '"x"'),
        ("steps_per_second", '"fast"'),
        ("versions", "[5]"),
    ],
)
def test_a_table_with_wrong_types(finished, tmp_path: Path, column: str, value: str, capsys) -> None:
    """A damaged table fails with one line."""
    grid, runs = finished
    file = tmp_path / "t.sqlite"
    collect(grid, runs, file)
    with sqlite3.connect(file) as table:
        where = "runs" if column == "versions" else "cells"
        if column == "cell":
            table.execute("UPDATE cells SET cell = json_patch(cell, ?)", (value,))
        else:
            table.execute(f"UPDATE {where} SET {column} = ?", (value if column == "versions" else json.loads(value),))
    table.close()
    with pytest.raises(SystemExit) as end:
        main(["bench", "report", str(file)])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "is no table of results, or damaged: " in error
