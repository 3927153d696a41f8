"""A grid that trains in seconds, and `delayrl bench` in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

from delayrl.bench import folders
from delayrl.bench.grid import Grid, load_grid
from short_runs import assert_same_networks

SAC = """
preset = "small"
seeds = 2
tasks = ["Reacher-v5"]
delays = [0]
[overrides]
steps = {steps}
random_steps = 100
replay_capacity = 150
evaluate_every = 30
evaluation_episodes = 1
hidden = [8, 8]
batch_size = 8
[[product]]
agents = ["sac"]
[[product]]
agents = ["bpql"]
delays = [2]
"""


def tiny(folder: Path, steps: int = 240, name: str = "tiny", text: str = SAC) -> Path:
    file = folder / f"{name}.toml"
    file.write_text(text.replace("{steps}", str(steps)))
    return file


def bench(*words: str | Path) -> subprocess.Popen:
    """A process; its workers find compiled programs where all tests keep them, so that they start sooner."""
    command = [sys.executable, "-m", "delayrl", "bench", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen, status: int = 0, timeout: float = 400) -> str:
    out, err = process.communicate(timeout=timeout)
    assert process.returncode == status, (out, err)
    assert "Traceback" not in err
    return out + err


def assert_same_results(file: Path, runs: Path, expected: Path) -> None:
    """Every cell is done, with the same rows, none twice, and the same parameters."""
    grid: Grid = load_grid(file)
    for cell in grid.cells:
        assert folders.stored(runs / cell.folder, cell.seeds) == (cell.condition.steps, True)
        pairs = (folders.seed_paths(home / cell.folder, cell.seeds) for home in (runs, expected))
        for mine, theirs in zip(*pairs, strict=True):
            text = (mine / "rows.jsonl").read_text()
            assert text == (theirs / "rows.jsonl").read_text()
            rows = [json.loads(line) for line in text.splitlines()]
            episodes = [(row["step"], row["policy"], row["episode"]) for row in rows]
            assert len(set(episodes)) == len(episodes) == cell.condition.steps // 30
            assert_same_networks(mine, theirs)


def worker_of(folder: Path) -> int | None:
    """The process that holds a cell."""
    who = folders.holder(folder)
    words = who.split() if who else []
    return int(words[-1]) if words and words[-1].isdigit() else None
