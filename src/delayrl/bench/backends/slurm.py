"""Slurm: run a grid as an array job.

Each element of the array runs one cell with the local backend. When its time is up, or Slurm asks it to stop, it stores
a checkpoint and requeues itself. Slurm requeues elements whose node failed.
"""

import math
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from delayrl.bench import folders
from delayrl.bench.grid import Grid
from delayrl.bench.runner import GRACE
from delayrl.errors import STOPPED, DelayRLError
from delayrl.run.cell import Cell
from delayrl.run.disk import disk_errors

SCRIPT = """#!/bin/bash
#SBATCH --job-name=delayrl-{name}
#SBATCH --array=0-{last}{at_a_time}
#SBATCH --time={minutes}
#SBATCH --signal=B:TERM@{before}
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output="{log}"
{extra}
# Written by `delayrl bench run {name} --backend slurm`.
cells=({ids})
{command} --cells "${{cells[$SLURM_ARRAY_TASK_ID]}}" &
runner=$!
trap 'kill -TERM $runner' TERM
wait $runner
status=$?
while kill -0 $runner 2>/dev/null; do # the signal ended `wait`, not the runner
    wait $runner
    status=$?
done
if [ $status -eq 143 ]; then # the signal came before the runner had begun, or as it ended
    wait $runner
    last=$?
    [ $last -eq 127 ] || status=$last
fi
if [ $status -eq {stopped} ] || [ $status -eq 143 ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit $status
"""


def script(
    grid: Grid,
    cells: Sequence[Cell],
    runs: Path,
    *,
    time_limit: float | None = None,
    workers: int | None = None,
    options: Sequence[str] = (),
    arguments: Sequence[str] = (),
) -> str:
    """Return the text of an sbatch script with one element for each cell. The nodes must share the folder `runs`.

    At most `workers` elements run at a time. An element stops and requeues itself after `time_limit` seconds (default:
    an hour). `options` go into `#SBATCH` lines, e.g. "--partition=gpu"; `arguments` go to `delayrl bench run`.

    Raises:
        DelayRLError: an option that is none.
    """
    source = grid.name if grid.is_shipped else str(grid.source.resolve())
    words = [sys.executable, "-m", "delayrl", "bench", "run", source, "--runs", str(runs.resolve()), *arguments]
    limit = 3600 if time_limit is None else time_limit
    words += ["--time-limit", f"{math.ceil(limit)}s"]
    before = int(GRACE) + 30
    for option in options:
        if not option.startswith("-") or "\n" in option:
            raise DelayRLError(f"--sbatch takes an option of sbatch, e.g. --sbatch=--partition=gpu; got {option!r}")
    return SCRIPT.format(
        name=grid.name,
        last=len(cells) - 1,
        at_a_time="" if workers is None else f"%{workers}",
        minutes=math.ceil((limit + before) / 60),
        before=before,
        log=runs.resolve() / "slurm" / f"{grid.name}-%a.log",
        extra="\n".join(f"#SBATCH {option}" for option in options),
        ids=" ".join(cell.id for cell in cells),
        command=shlex.join(words),
        stopped=STOPPED,
    )


def write(grid: Grid, cells: Sequence[Cell], runs: Path, text: str) -> Path:
    """Prepare the cells' folders and write the script. Returns its path, RUNS/slurm/NAME.sbatch."""
    for cell in cells:
        folders.prepare(runs / cell.folder, cell)
    file = runs / "slurm" / f"{grid.name}.sbatch"
    with disk_errors(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return file


def submit(file: Path) -> str:
    """Submit a script. Returns the job's number. Raises DelayRLError if sbatch is missing or refuses."""
    if shutil.which("sbatch") is None:
        raise DelayRLError(f"there is no sbatch here; on a machine that has it, run: sbatch {file}")
    done = subprocess.run(["sbatch", "--parsable", str(file)], capture_output=True, text=True)
    if done.returncode:
        reason = done.stderr.strip().partition("\n")[0] or "no reason given"
        raise DelayRLError(f"sbatch refuses {file}: {reason}")
    return done.stdout.strip().split(";")[0]
