"""The files of a report, its command, and what it refuses."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from synthetic import longer_reference, rows, small, standing, two_lengths

from delayrl.errors import DelayRLError
from delayrl.report import figures
from delayrl.report.__main__ import main
from delayrl.report.configurations import read_configs
from delayrl.report.report import report
from delayrl.report.rows import read_rows
from delayrl.report.summary import summarise
from delayrl.run.rows import CONDITION

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def test_nothing_to_report(tmp_path: Path) -> None:
    with pytest.raises(DelayRLError, match="nothing to report"):
        report([], [], tmp_path)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DelayRLError, match="cannot write to "):
        report([], list(small().values()), tmp_path / "file")


def test_report_of_committed_rows(tmp_path: Path) -> None:
    files = [RESULTS / f"{name}.jsonl" for name in ("pendulum", "reacher", "walk")]
    out = report(read_rows(files), [], tmp_path)
    text = (tmp_path / "report.md").read_text()
    for picture in re.findall(r"\]\((img/.*?)\)", text):
        assert (tmp_path / picture).stat().st_size > 10_000
    assert "**1.02 ± 0.03**<br>0.97 to 1.07<br>area 0.99 ± 0.01<br>raw -7.40 ± 0.95" in text  # bpql on Reacher-v5
    assert out.stat().st_size < 1_000_000


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are drawn, in the place of files."""
    made: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: made.append(figure))
    return made


def words(text: Any) -> str:
    """A text without its line breaks."""
    return " ".join(text.get_text().split())


def test_pictures_keep_alike_names_apart_and_titles_whole(tmp_path: Path, drawn: list[Any]) -> None:
    """What tells them apart may stand at the end of a long name, or in its middle."""
    law, long = "my_laws:Busy(slow=4, fast=1, busy=0.25, quiet=0.125, seed=12)@fifo", dict.fromkeys("abcdefghij", 0.001)
    cells = [standing("bpql", "Ant", law, overrides=long | {"e": x, "z": y}) for x in (1, 2) for y in (1, 2)]
    cells += [standing("bpql", "Ant", law), standing("sac", "Ant", 0), standing("random", "Ant", 0)]
    summary = summarise(rows(cells, evaluations=4, episodes=1), cells)
    figures.draw(summary, tmp_path)
    assert len(summary.labels) == 7
    for figure in drawn:
        assert {words(text) for text in figure.legends[0].get_texts()} >= {*summary.labels} - {"sac", "random"}
    titles = [[words(panel.title) for panel in figure.axes] for figure in drawn]
    assert titles == [[f"Ant, Δ = {law}"], [f"IQM, Δ = {law}", f"Profile, Δ = {law}"]]


def test_pictures_draw_the_delay_free_line_of_each_length(tmp_path: Path, drawn: list[Any]) -> None:
    cells, every = two_lengths()
    figures.draw(summarise(every, cells), tmp_path)
    marks = [[text.get_text() for text in figure.axes[0].texts] for figure in drawn]
    assert marks == [["400 steps", "800 steps"], [], ["400 steps", "800 steps"], []]
    lines = {round(line.get_ydata()[0]) for line in drawn[0].axes[0].lines if line.get_label() == figures.SAC[0]}
    assert len(lines) == 2


def test_pictures_draw_the_curve_of_a_longer_reference_as_far_as_the_learners(tmp_path: Path, drawn: list[Any]) -> None:
    cells, every = longer_reference()
    figures.draw(summarise(every, cells), tmp_path)
    name = f"{figures.SAC[0]} (500 steps)"
    (line,) = [line for line in drawn[0].axes[0].lines if line.get_label() == name]
    assert (line.get_xdata().tolist(), line.get_ydata().tolist()) == ([100, 200, 300, 400], [10, 30, 50, 70])
    assert {name, figures.SAC[0]} <= {words(text) for text in drawn[0].legends[0].get_texts()}  # and the line of 300
    assert len(drawn[0].axes[0].collections) == 3  # its band too


def test_command(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "delayrl.report", str(RESULTS / "pendulum.jsonl"), "--out", str(tmp_path / "out")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert (tmp_path / "out" / "report.html").is_file()


def test_command_of_a_missing_file_and_of_the_base_alone(tmp_path: Path) -> None:
    words = ["none.jsonl", "--out", "out"]
    command = [sys.executable, "-m", "delayrl.report", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, "delayrl: none.jsonl cannot be read: No such file or directory\n")
    code = (
        "import sys; sys.modules['scipy'] = None; import runpy; runpy.run_module('delayrl.report', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "scipy" in done.stderr


@pytest.mark.parametrize("content", ['{"step": 1', '{"a": 1}', "[1]", '{"config": 5}', "\ud800"])
def test_command_of_a_bad_file(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.jsonl"
    bad.write_bytes(content.encode("utf-8", "surrogatepass"))
    monkeypatch.setattr(sys, "argv", ["report", str(bad), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1, said
    assert "bad.jsonl, line 1" in said


def test_a_line_that_a_crash_cut_is_left_out(tmp_path: Path) -> None:
    """The last one, if it has no end; as run folders are read."""
    whole = json.dumps({name: "x" for name in CONDITION} | {"step": 1})
    (tmp_path / "rows.jsonl").write_text(f'{whole}\n{{"agent": "sac", "st')
    assert [row["step"] for row in read_rows([tmp_path / "rows.jsonl"])] == [1]
    collected = tmp_path / "collected" / "rows.jsonl"
    collected.parent.mkdir()
    collected.write_text(f'{whole}\n{{"run": 3, "config": {{"agent": "s')
    assert (len(list(read_rows([collected]))), list(read_configs([collected]))) == (1, [])
    for last in ("[1, 2]", '{"agent": "sac"}', "[" * 100_000):  # whole or deep, but no row
        collected.write_text(f"{whole}\n{last}")
        with pytest.raises(DelayRLError, match="line 2: this is no row"):
            list(read_rows([collected]))
    (tmp_path / "rows.jsonl").write_text(f'{whole}\n{{"agent": "sac", "st\n')
    with pytest.raises(DelayRLError, match="line 2: this is no row"):
        list(read_rows([tmp_path / "rows.jsonl"]))
