"""Running a grid on this machine: cells are skipped, resumed, tried again, stopped, locked."""

import contextlib
import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support import assert_same_results, bench, finish, tiny, worker_of

import delayrl
from delayrl.bench import folders
from delayrl.bench.backends.local import LocalBackend
from delayrl.bench.grid import load_grid
from delayrl.bench.runner import Completion, run_cells
from delayrl.bench.status import line, seconds_left, standing
from delayrl.bench.worker import Outcome, work
from delayrl.cli.bench import idle, time_limit
from delayrl.cli.main import main
from delayrl.run.cell import Cell, Progress
from delayrl.run.condition import Condition
from delayrl.run.disk import disk_errors


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The tiny grid and its finished runs."""
    home = tmp_path_factory.mktemp("undisturbed")
    file = tiny(home)
    finish(bench("run", file, "--runs", home / "runs"))
    return file, home / "runs"


def chaos(file: Path, runs: Path, kills: int, workers: int, within: float) -> int:
    """Run a grid and kill random workers, some seconds apart. Returns how many were killed."""
    cells, rng, killed = load_grid(file).cells, random.Random(kills), 0
    process = bench("run", file, "--runs", runs, "--workers", workers, "--tries", kills + 1)
    try:
        next_kill = time.monotonic() + rng.uniform(0, within)
        while process.poll() is None:
            time.sleep(0.05)
            busy = [pid for cell in cells if (pid := worker_of(runs / cell.folder))]
            if killed < kills and busy and time.monotonic() > next_kill:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(rng.choice(busy), signal.SIGKILL)
                    killed += 1
                next_kill = time.monotonic() + rng.uniform(0, within)
        finish(process)
    finally:
        process.kill()
        process.communicate()
    return killed


def ends(runs: Path, file: Path) -> list[int]:
    """Return how often each cell's journal notes its end."""
    cells = load_grid(file).cells
    return [sum(e["event"] == "done" for e in folders.journal(runs / cell.folder)) for cell in cells]


@pytest.mark.thorough
def test_workers_killed(undisturbed, tmp_path: Path) -> None:
    """Every cell ends once, with the rows and parameters of the undisturbed grid."""
    file, expected = undisturbed
    assert chaos(file, tmp_path / "runs", kills=2, workers=2, within=1) == 2
    assert_same_results(file, tmp_path / "runs", expected)
    assert ends(tmp_path / "runs", file) == [1, 1]


@pytest.mark.slow
def test_workers_killed_twenty_times(tmp_path: Path) -> None:
    file = tiny(tmp_path, steps=3000)
    finish(bench("run", file, "--runs", tmp_path / "expected"))
    assert chaos(file, tmp_path / "runs", kills=20, workers=2, within=8) == 20
    assert_same_results(file, tmp_path / "runs", tmp_path / "expected")
    assert ends(tmp_path / "runs", file) == [1, 1]


def test_finished_cells_are_skipped(undisturbed) -> None:
    file, runs = undisturbed
    before = {path: path.stat().st_mtime_ns for path in runs.rglob("*.jsonl")}
    assert "2 of 2 cells done" in finish(bench("run", file, "--runs", runs))
    assert before == {path: path.stat().st_mtime_ns for path in runs.rglob("*.jsonl")}


@pytest.mark.thorough
def test_time_limit(tmp_path: Path) -> None:
    """The grid stops at a checkpoint with status 75 and releases its cells; the same command resumes it."""
    file, runs = tiny(tmp_path, steps=60_000), tmp_path / "runs"
    cells, reached = load_grid(file).cells, 0
    for advances in range(2):
        for _ in range(6):  # on a slow machine compiling takes all the time
            said = finish(bench("run", file, "--runs", runs, "--time-limit", "10s"), 75)
            assert "0 of 2 cells done" in said
            assert "the same command resumes it" in said
            now = [p for _, p in standing(cells, runs)]
            assert [p.state for p in now] == ["begun" if p.step else "todo" for p in now]
            before, reached = reached, sum(p.step for p in now)
            assert reached >= before
            if reached > before:
                break
        else:
            pytest.fail(f"nothing new after {advances} times")
    assert "stopped" in [e["event"] for e in folders.journal(runs / cells[0].folder)]


def test_stopped_or_killed_runner(tmp_path: Path) -> None:
    """Its workers store a checkpoint in both cases."""
    file, runs = tiny(tmp_path, steps=60_000), tmp_path / "runs"
    cell = load_grid(file).cells[0]
    for kind, status in ((signal.SIGTERM, 75), (signal.SIGKILL, -signal.SIGKILL)):
        step = folders.stored(runs / cell.folder, cell.seeds)[0]
        process = bench("run", file, "--runs", runs, "--cells", cell.id)
        until(lambda step=step: folders.stored(runs / cell.folder, cell.seeds)[0] > step)
        process.send_signal(kind)
        process.communicate(timeout=60)
        assert process.returncode == status
        until(lambda: folders.holder(runs / cell.folder) is None)
        assert folders.journal(runs / cell.folder)[-1]["event"] == "stopped"
        assert standing([cell], runs)[0][1].state == "begun"


def until(condition, timeout: float = 120) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.thorough
def test_two_runners(undisturbed, tmp_path: Path) -> None:
    """Two runners share a grid: each cell begins and ends once, and both runners succeed."""
    file, runs = tiny(tmp_path), tmp_path / "runs"
    both = [bench("run", file, "--runs", runs) for _ in range(2)]
    assert all("2 of 2 cells done" in finish(process) for process in both)
    for cell in load_grid(file).cells:
        assert [e["event"] for e in folders.journal(runs / cell.folder)] == ["begun", "done"]
    assert_same_results(file, runs, undisturbed[1])


SMALL_DISK = """
set -e
mkdir -p "$1"; mount -t tmpfs -o size=$2 none "$1"
shift 2; status=0; "$@" || status=$?
cp -r "$RUNS" "$KEPT"
exit $status
"""


@pytest.mark.thorough
def test_full_disk(undisturbed, tmp_path: Path) -> None:
    """A full disk fails with one line and is not tried again; with room the grid resumes without loss."""
    file, expected = undisturbed
    if subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    disk, kept = tmp_path / "disk", tmp_path / "kept"
    command = [
        sys.executable,
        "-m",
        "delayrl",
        "bench",
        "run",
        str(file),
        "--runs",
        str(disk / "runs"),
        "--workers",
        "1",
    ]
    done = subprocess.run(
        ["unshare", "-rm", "bash", "-c", SMALL_DISK, "-", str(disk), "280k", *command],
        env=os.environ | {"RUNS": str(disk / "runs"), "KEPT": str(kept)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("delayrl: ")
    assert "No space left on device" in last or "the disk is full" in last
    step = [folders.stored(kept / cell.folder, cell.seeds)[0] for cell in load_grid(file).cells]
    assert any(0 < n < 240 for n in step)
    finish(bench("run", file, "--runs", kept))
    assert_same_results(file, kept, expected)


# -- without training ------------------------------------------------------------------------------------------------


class Script:
    """A backend whose cells end as scripted."""

    def __init__(self, **outcomes: list[Outcome]):
        self.outcomes, self.running, self.started = outcomes, list[Cell](), list[str]()

    def room(self) -> int:
        return 1 - len(self.running)

    def start(self, cell: Cell) -> None:
        self.running.append(cell)
        self.started.append(cell.condition.agent)

    def ended(self) -> list[tuple[Cell, Outcome]]:
        running, self.running = self.running, []
        return [(cell, self.outcomes[cell.condition.agent].pop(0)) for cell in running]

    def stop(self) -> None: ...
    def close(self) -> None: ...


def cells(*agents: str) -> list[Cell]:
    return [Cell(Condition(agent, "Reacher-v5", 0, "small", steps=100), (0,), agent) for agent in agents]


DIED, DONE, WRONG = Outcome("died", "killed by SIGKILL"), Outcome("done", ""), Outcome("failed", "discount: no")


@pytest.fixture(autouse=True)
def short_pause(monkeypatch) -> None:
    monkeypatch.setattr("delayrl.bench.runner.PAUSE", 0.01)


def test_tries_are_bounded(tmp_path: Path) -> None:
    """Only tries in a row that store nothing new count; errors are not tried again; other cells continue."""
    backend = Script(sac=[DIED] * 9, bpql=[DIED, DIED, DONE], vdpo=[WRONG, DONE])
    began = time.monotonic()
    completion = run_cells(cells("sac", "bpql", "vdpo"), tmp_path, backend, tries=3)
    assert time.monotonic() - began > 2 + 4  # the wait grows
    assert [backend.started.count(agent) for agent in ("sac", "bpql", "vdpo")] == [3, 3, 1]
    assert [cell.condition.agent for cell in completion.done] == ["bpql"]
    assert completion.failed == {
        "sac": "3 deaths, and nothing new was stored; the last: killed by SIGKILL",
        "vdpo": "discount: no",
    }
    now = standing(cells("sac", "bpql", "vdpo"), tmp_path)
    assert [p.state for _, p in now] == ["failed", "todo", "failed"]
    assert now[0][1].line == completion.failed["sac"]
    assert "2 failed" in line(now, 1)


def test_only_deaths_count_as_tries(tmp_path: Path, monkeypatch) -> None:
    """A worker that somebody stops has not died."""
    monkeypatch.setattr("delayrl.bench.runner.RETRY", 0.01)
    stopped = Outcome("stopped", "stopped before it began")
    backend = Script(sac=[stopped] * 4 + [DIED, stopped, DONE], bpql=[DIED, stopped, DIED])
    completion = run_cells(cells("sac", "bpql"), tmp_path, backend, tries=2)
    assert [cell.condition.agent for cell in completion.done] == ["sac"]
    assert list(completion.failed) == ["bpql"]


def test_workers_reach_a_checkpoint_if_their_runner_fails(tmp_path: Path, monkeypatch) -> None:
    """As they do if it is killed: they are asked to stop, and are not killed at once."""
    save = "import pathlib, signal, sys, time\n"
    save += "signal.signal(signal.SIGTERM, lambda *_: (time.sleep(0.5), pathlib.Path(sys.argv[1]).touch(), exit()))\n"
    save += "pathlib.Path(sys.argv[1] + '-begun').touch()\ntime.sleep(60)"

    def start(folder: Path, device: str | None, core: int | None) -> subprocess.Popen:
        words = [sys.executable, "-c", save, str(tmp_path / "saved")]
        return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def tick() -> None:
        if (tmp_path / "saved-begun").exists():
            raise delayrl.DelayRLError("no")

    monkeypatch.setattr("delayrl.bench.backends.local.start_worker", start)
    with pytest.raises(delayrl.DelayRLError, match="no"):
        run_cells(cells("sac"), tmp_path, LocalBackend(tmp_path, 1), tick=tick)
    assert (tmp_path / "saved").exists()


def test_a_disk_that_does_not_answer_is_not_the_end(tmp_path: Path, monkeypatch) -> None:
    """Neither while the status is read, nor in a worker, where another try may meet a disk that does."""
    (some,) = cells("random")
    folder = tmp_path / some.folder
    folders.prepare(folder, some)

    def stale(path: Path) -> list[Path]:
        raise delayrl.DelayRLError(f"{path} cannot be read: Stale file handle")

    with monkeypatch.context() as patch:
        patch.setattr(folders, "checkpoint_folders", stale)
        assert folders.stored(folder, (0,)) == (0, False)
    for number, kind in ((errno.EIO, "died"), (errno.ENOSPC, "failed")):

        def refuse(*_: object, number: int = number) -> None:
            with disk_errors(folder):
                raise OSError(number, os.strerror(number))

        monkeypatch.setattr("delayrl.bench.worker._train", refuse)
        assert work(folder).kind == kind


def test_a_worker_that_cannot_be_started(tmp_path: Path) -> None:
    """Its cell fails, the others continue."""

    class Refuses(Script):
        def start(self, cell: Cell) -> None:
            if cell.condition.agent == "sac":
                raise delayrl.DelayRLError("the disk is full")
            super().start(cell)

    completion = run_cells(cells("sac", "bpql"), tmp_path, Refuses(bpql=[DONE]))
    assert completion.failed == {"sac": "the disk is full"}
    assert [cell.condition.agent for cell in completion.done] == ["bpql"]
    assert [p.state for _, p in standing(cells("sac"), tmp_path)] == ["failed"]


def test_tries_with_progress_do_not_count(tmp_path: Path, monkeypatch) -> None:
    steps = iter([0, 0, 0, 10, 10, 20, 20, 30])
    monkeypatch.setattr(folders, "stored", lambda *_: (next(steps), False))
    backend = Script(sac=[DIED] * 5 + [DONE])
    assert run_cells(cells("sac"), tmp_path, backend, tries=2).failed == {}
    assert len(backend.started) == 6


def test_a_disk_that_answers_again_is_no_progress(tmp_path: Path, monkeypatch) -> None:
    """While it does not answer, nothing seems to be stored; what it shows then was there before."""
    monkeypatch.setattr("delayrl.bench.runner.RETRY", 0.01)
    steps = iter([50, 50, 0, 50, 0, 50])
    monkeypatch.setattr(folders, "stored", lambda *_: (next(steps), False))
    assert run_cells(cells("sac"), tmp_path, Script(sac=[DIED] * 9), tries=3).failed


def test_a_cell_of_another_runner_is_waited_for(tmp_path: Path) -> None:
    locked = Outcome("locked", "another process works on it")
    backend = Script(sac=[locked, DONE], bpql=[DONE])
    completion = run_cells(cells("sac", "bpql"), tmp_path, backend, tries=1)
    assert backend.started == ["sac", "bpql", "sac"]
    assert len(completion.done) == 2


def test_nothing_is_started_on_a_cell_that_is_held(tmp_path: Path) -> None:
    """Starting a worker would empty the log of the worker that holds the cell."""
    backend, some = Script(sac=[DONE], bpql=[DONE]), cells("sac", "bpql")
    folders.prepare(tmp_path / some[0].folder, some[0])
    with contextlib.ExitStack() as held:
        held.enter_context(folders.hold_cell(tmp_path / some[0].folder))
        free = time.monotonic() + 0.5

        def tick() -> None:
            if time.monotonic() > free:
                held.close()
            else:
                assert "sac" not in backend.started

        assert len(run_cells(some, tmp_path, backend, tick=tick).done) == 2
    assert backend.started == ["bpql", "sac"]


def test_workers_that_do_not_stop_are_killed(tmp_path: Path, monkeypatch) -> None:
    """They are killed after the grace period, so that a queue's time limit holds."""
    sleep = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"

    def start(folder: Path, device: str | None, core: int | None) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-c", sleep], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    monkeypatch.setattr("delayrl.bench.backends.local.start_worker", start)
    monkeypatch.setattr("delayrl.bench.runner.GRACE", 1)
    began, backend = time.monotonic(), LocalBackend(tmp_path, 1)
    completion = run_cells(cells("sac", "bpql"), tmp_path, backend, time_limit=1)
    assert time.monotonic() - began < 20
    assert {cell.condition.agent for cell in completion.unfinished} == {"sac", "bpql"}


def test_the_last_line_may_be_long(tmp_path: Path) -> None:
    for size in (0, 10_000, 50_000):
        metrics = "".join(json.dumps({"step": step, "note": "x" * size}) + "\n" for step in (1, 2, 3))
        (tmp_path / "metrics.jsonl").write_text(metrics + '{"step": 4')
        assert folders.newest_metrics(tmp_path) == {"step": 3}


def test_journal_after_a_crash(tmp_path: Path) -> None:
    """A line that was cut off does not damage the next."""
    folders.note(tmp_path, "begun")
    with open(tmp_path / "journal.jsonl", "a") as file:
        file.write('{"event": "do')
    folders.note(tmp_path, "begun", step=5)
    folders.note(tmp_path, "done")
    assert [e["event"] for e in folders.journal(tmp_path)] == ["begun", "begun", "done"]
    assert folders.journal(tmp_path)[1]["step"] == 5


def test_lock(tmp_path: Path) -> None:
    """A lock has one holder and ends with its process; `holder` does not take it."""
    assert folders.holder(tmp_path) is None
    code = (
        f"from delayrl.bench.folders import *\nwith hold_cell(Path({str(tmp_path)!r})): print(1, flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "1\n"
        assert folders.holder(tmp_path).endswith(f" {other.pid}")
        with pytest.raises(folders.LockedError), folders.hold_cell(tmp_path):
            pass
        other.kill()
        other.communicate()
    assert folders.holder(tmp_path) is None
    with folders.hold_cell(tmp_path):
        assert folders.holder(tmp_path).endswith(f" {os.getpid()}")


def test_time_left(tmp_path: Path) -> None:
    """Estimated with the speed of the same agent on the same task, else of the agent, else of all."""
    some = cells("sac", "bpql", "vdpo")
    states = [("done", 100, 10.0), ("running", 50, 5.0), ("todo", 0, None)]
    now = [(cell, Progress(*state)) for cell, state in zip(some, states, strict=True)]
    assert seconds_left(now, 1) == pytest.approx(50 / 5 + 100 / 7.5)
    assert seconds_left(now, 2) == pytest.approx(100 / 7.5)  # the longest cell alone
    assert seconds_left([(some[0], Progress("todo", 0))], 1) is None
    assert seconds_left(now[:1], 1) == 0


def test_a_failed_cell_does_not_hide_those_that_are_left(tmp_path: Path, capsys, monkeypatch) -> None:
    """The status says that the same command goes on."""
    file = tiny(tmp_path)
    failed, left = load_grid(file).cells
    ended = Completion(failed={failed.id: "no"}, unfinished=[left])
    monkeypatch.setattr("delayrl.bench.runner.run_cells", lambda *_, **__: ended)
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "run", str(file), "--runs", str(tmp_path / "runs")])
    assert stopped.value.code == 75
    out, err = capsys.readouterr()
    assert "the same command resumes it" in out
    assert "1 of 2 cells failed, the first: no" in err


def test_a_small_grid_is_told_how_to_use_all_workers() -> None:
    condition = Condition("sac", "Pendulum-v1", 0, "small", "corrected", 100)
    many, two, one = (Cell(condition, seeds, "id") for seeds in [(0, 1, 2, 3, 4), (0, 1), (5,)])
    assert idle([many], 2).startswith("1 of 2 workers have no cell; with `lockstep = 2`")
    assert "2 of 4 workers" in idle([many, one], 4)
    assert "`lockstep = 1`" in idle([many, one], 4)
    for enough in ([many, one], [two, two, two], [one], []):
        assert idle(enough, 2) == ""


@pytest.mark.parametrize(("text", "value"), [("90s", 90), ("9m", 540), ("1h30m", 5400), ("2d", 172800)])
def test_times(text: str, value: int) -> None:
    assert time_limit(text) == value
    for bad in (text + "x", "", "9", "m", "0s"):
        with pytest.raises(delayrl.DelayRLError, match="a time is written as"):
            time_limit(bad)


@pytest.mark.parametrize("option", ["--submit", "--sbatch=--partition=gpu", "--address=auto", "--gpus=1"])
def test_options_of_another_backend_are_not_ignored(option: str, capsys) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "run", "smoke", option])
    assert stopped.value.code == 2
    name, backend = option.split("=")[0], "slurm" if option.startswith("--s") else "ray"
    assert capsys.readouterr().err.strip() == f"delayrl: {name} needs --backend {backend}; got --backend local"
