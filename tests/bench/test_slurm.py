"""Slurm: the script, and a real Slurm with one node. Skipped where slurm-wlm and munge are not installed."""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import assert_same_results, bench, finish, tiny

import delayrl
from delayrl.bench import folders
from delayrl.bench.backends.slurm import script, submit
from delayrl.bench.grid import load_grid
from delayrl.cli.main import main
from delayrl.run.cell import Progress

NODE = Path(__file__).with_name("slurm_node.sh")
PROGRAMS = ("slurmctld", "slurmd", "munged")
PATH = f"{os.environ['PATH']}:/usr/sbin"
needs_slurm = pytest.mark.skipif(
    not all(shutil.which(name, path=PATH) for name in PROGRAMS), reason="Slurm is not installed"
)


def test_script(tmp_path: Path) -> None:
    """The script is valid bash: one array element for each cell, with time to stop before the queue's limit."""
    grid = load_grid(tiny(tmp_path))
    text = script(grid, grid.cells, tmp_path / "my runs", time_limit=600, options=["--partition=gpu"])
    assert "#SBATCH --array=0-1\n" in text
    assert "#SBATCH --array=0-1%3\n" in script(grid, grid.cells, tmp_path, workers=3)
    assert "#SBATCH --partition=gpu\n" in text
    assert "#SBATCH --requeue\n" in text
    assert f"cells=({' '.join(grid.ids)})" in text
    assert "--time-limit 600s" in text
    minutes, before = (int(re.search(f"{key}(\\d+)", text).group(1)) for key in ("--time=", "B:TERM@"))
    assert minutes * 60 - before >= 600
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)
    with pytest.raises(delayrl.DelayRLError, match="--sbatch takes an option"):
        script(grid, grid.cells, tmp_path, options=["--x\nrm"])


def test_a_signal_before_the_runner_has_begun_requeues(tmp_path: Path, monkeypatch) -> None:
    """While it reads its grid the signal ends it, before it could say that it goes on later."""
    grid, begun, requeued = load_grid(tiny(tmp_path)), tmp_path / "begun", tmp_path / "requeued"
    programs = {"python": f'touch "{begun}"\nexec sleep 30', "scontrol": f'echo "$@" > "{requeued}"'}
    for name, text in programs.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    env = os.environ | {"PATH": f"{tmp_path}:{PATH}", "SLURM_ARRAY_TASK_ID": "0", "SLURM_JOB_ID": "7"}
    process = subprocess.Popen(["bash", "-c", script(grid, grid.cells, tmp_path)], env=env)
    for _ in range(400):
        if begun.exists():
            break
        time.sleep(0.05)
    process.terminate()
    assert process.wait(20) == 143
    assert requeued.read_text() == "requeue 7\n"


def test_written_for_another_machine(tmp_path: Path, capsys, monkeypatch) -> None:
    """Without --submit nothing is submitted; a missing sbatch is one line; finished cells are skipped."""
    file = tiny(tmp_path)
    words = ["bench", "run", str(file), "--runs", str(tmp_path / "runs"), "--backend", "slurm"]
    main(words)
    path = tmp_path / "runs" / "slurm" / "tiny.sbatch"
    assert capsys.readouterr().out == f"{path}: 2 cells\nnext: sbatch {path}\n"
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(delayrl.DelayRLError, match="there is no sbatch here"):
        submit(path)
    monkeypatch.setattr("delayrl.cli.bench.progress", lambda *_: Progress("done", 0, None))
    main(words)
    assert "all 2 cells are done" in capsys.readouterr().out


@pytest.fixture
def node(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Start a Slurm with one node. Yields the environment in which its commands reach it."""
    home = tmp_path / "slurm"
    with socket.create_server(("", 0)) as control, socket.create_server(("", 0)) as worker:
        ports = [str(server.getsockname()[1]) for server in (control, worker)]
    process = subprocess.Popen(
        [NODE, home, *ports], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    environment = os.environ | {"SLURM_CONF": str(home / "slurm.conf")}
    try:
        deadline = time.monotonic() + 60
        while "idle" not in subprocess.run(["sinfo"], capture_output=True, text=True, env=environment).stdout:
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.5)
        yield environment
    finally:
        process.stdin.close()
        process.wait(30)


@needs_slurm
@pytest.mark.slow
def test_a_real_slurm(node: dict[str, str], tmp_path: Path, monkeypatch) -> None:
    """A job that the time limit and a signal stop is requeued each time, and the results are the same."""
    file, runs = tiny(tmp_path, steps=3000), tmp_path / "runs"
    finish(bench("run", file, "--runs", tmp_path / "expected"))
    monkeypatch.setenv("SLURM_CONF", node["SLURM_CONF"])

    def scontrol(*words: str) -> str:
        return subprocess.run(["scontrol", *words], capture_output=True, text=True, check=True).stdout

    words = ["run", file, "--runs", runs, "--backend", "slurm", "--time-limit", "12s", "--submit"]
    job = re.search(r"job (\d+)", finish(bench(*words))).group(1)
    cells, restarts, signalled, released = load_grid(file).cells, 0, False, {(0, "0"), (1, "0")}
    deadline = time.monotonic() + 900
    while not all(folders.stored(runs / cell.folder, cell.seeds)[1] for cell in cells):
        assert time.monotonic() < deadline, scontrol("show", "job", job)
        for number, cell in enumerate(cells):
            shown = subprocess.run(
                ["scontrol", "show", "job", f"{job}_{number}"], capture_output=True, text=True
            ).stdout
            counted = re.search(r"Restarts=(\d+)", shown)
            restarts = max(restarts, int(counted.group(1)) if counted else 0)
            if "JobState=PENDING" in shown and counted and (number, counted.group(1)) not in released:
                released.add((number, counted.group(1)))  # two minutes otherwise; a node needs some seconds to forget
                scontrol("update", f"JobId={job}_{number}", "StartTime=now+15")
            halfway = folders.stored(runs / cell.folder, cell.seeds)[0] > 1500
            if "JobState=RUNNING" in shown and halfway and not signalled and folders.holder(runs / cell.folder):
                subprocess.run(["scancel", "--batch", "--signal=TERM", f"{job}_{number}"], check=True)
                signalled = True
        time.sleep(0.5)
    assert restarts >= 1
    assert signalled
    assert any("stopped at a checkpoint" in log.read_text() for log in (runs / "slurm").glob("tiny-*.log"))
    time.sleep(3)  # the last job ends
    assert_same_results(file, runs, tmp_path / "expected")
