"""The files of a report, its command, and what it refuses."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import small

from delayrl.errors import DelayRLError
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
    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "delayrl.report", *map(str, words), "--out", str(tmp_path / "out")]
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
