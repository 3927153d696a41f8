"""Where a grid stands: progress, speed, time left, failures."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from delayrl.bench import folders
from delayrl.bench.folders import Progress, State
from delayrl.bench.grid import Cell, Grid

Standing = Sequence[tuple[Cell, Progress]]


def progress(cell: Cell, runs: Path) -> Progress:
    """How far a cell is."""
    return folders.progress(runs / cell.folder, cell.seeds)


def status(cell: Cell, runs: Path) -> State:
    """In one word."""
    return progress(cell, runs).state


def standing(cells: Sequence[Cell], runs: Path) -> list[tuple[Cell, Progress]]:
    """How far each cell is."""
    return [(cell, progress(cell, runs)) for cell in cells]


def seconds_left(standing: Standing, workers: int) -> float | None:
    """A guess: what is left at the speeds measured until now; None before any was.

    A cell that has not begun is taken to be as fast as its agent on the same task, else as its agent, else as all.
    """
    measured = [(cell, p.speed) for cell, p in standing if p.speed]
    left = [(cell, cell.steps - p.step, p.speed) for cell, p in standing if p.state in ("todo", "running")]
    if not left:
        return 0.0
    if not measured:
        return None
    seconds = []
    for cell, steps, own in left:
        alike = [
            [s for c, s in measured if (c.agent, c.env, c.delay) == (cell.agent, cell.env, cell.delay)],
            [s for c, s in measured if (c.agent, c.env) == (cell.agent, cell.env)],
            [s for c, s in measured if c.agent == cell.agent],
            [s for c, s in measured],
        ]
        seconds.append(steps / (own or median(next(speeds for speeds in alike if speeds))))
    return max(sum(seconds) / workers, max(seconds))


def line(standing: Standing, workers: int) -> str:
    """A grid in one line."""
    counts = Counter(p.state for _, p in standing)
    steps, whole = sum(p.step for _, p in standing), sum(cell.steps for cell, _ in standing)
    parts = [f"{counts['done']}/{len(standing)} cells", f"{100 * steps / max(whole, 1):.0f} % of the steps"]
    if counts["failed"]:
        parts.append(f"{counts['failed']} failed")
    left = seconds_left(standing, workers)
    if left:
        parts.append(f"about {duration(left)} left")
    running = [
        f"{cell.agent} {cell.env} {100 * p.step // cell.steps} %" for cell, p in standing if p.state == "running"
    ]
    return " · ".join([*parts, *([", ".join(running)] if running else [])])


def table(grid: Grid, runs: Path, workers: int) -> str:
    """A grid in full, for `delayrl bench status`."""
    now = standing(grid.cells, runs)
    head = ("id", "agent", "task", "delay", "seeds", "state", "steps", "steps/s", "time left")
    rows = [head]
    for cell, p in now:
        left = seconds_left([(cell, p)], 1) if p.state in ("running", "todo") else None
        seeds = f"{cell.seeds[0]}-{cell.seeds[-1]}" if len(cell.seeds) > 1 else str(cell.seeds[0])
        steps = f"{p.step:,} / {cell.steps:,}"
        speed = f"{p.speed:.0f}" if p.speed else ""
        rows.append(
            (
                cell.id,
                cell.agent,
                cell.env,
                str(cell.label),
                seeds,
                p.state,
                steps,
                speed,
                duration(left) if left else "",
            )
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    text = ["  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    text += ["", f"{grid.name}: {line(now, workers)}"]
    text += [f"failed: {cell} ({cell.id}): {p.line}" for cell, p in now if p.state == "failed"]
    return "\n".join(text)


def duration(seconds: float) -> str:
    """Seconds in words: 40 s, 12 min, 3 h 20 min, 2 d 5 h."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 24 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"
