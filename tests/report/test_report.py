"""The files of a report, its command, and what it refuses."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import small

from delayrl.errors import DelayRLError
from delayrl.report.__main__ import main
from delayrl.report.report import report
from delayrl.report.rows import read_rows

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def test_nothing_to_report(tmp_path: Path) -> None:
    with pytest.raises(DelayRLError, match="nothing to report"):
        report([], [], tmp_path)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DelayRLError, match="cannot be written"):
        report([], list(small().values()), tmp_path / "file")


def test_report_of_committed_rows(tmp_path: Path) -> None:
    files = [RESULTS / f"{name}.jsonl" for name in ("pendulum", "reacher", "walk")]
    out = report(read_rows(files), [], tmp_path)
    text = (tmp_path / "report.md").read_text()
    for picture in re.findall(r"\]\((img/.*?)\)", text):
        assert (tmp_path / picture).stat().st_size > 10_000
    assert "**1.02 ± 0.03**<br>0.97 to 1.07<br>area 0.99 ± 0.01<br>raw -7.40 ± 0.95" in text  # bpql on Reacher-v5
    assert out.stat().st_size < 1_000_000


def test_command(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "delayrl.report", str(RESULTS / "pendulum.jsonl"), "--out", str(tmp_path / "out")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.parametrize("content", ['{"step": 1', "[1]", '{"config": 5}', "\ud800"])
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
