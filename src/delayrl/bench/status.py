"""Where a grid stands: progress, speed, time left, failures."""

from collections import Counter
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from statistics import median

from delayrl.bench import folders
from delayrl.run.cell import Cell, Progress, Standing

HEAD = ("id", "agent", "task", "delay", "seeds", "state", "steps", "steps/s", "time left")


def progress(cell: Cell, runs: Path) -> Progress:
    """Read from disk how far a cell is."""
    folder = runs / cell.folder
    step, complete = folders.stored(folder, cell.seeds)
    holder, events = folders.holder(folder), folders.journal(folder)
    metrics = folders.newest_metrics(folders.seed_paths(folder, cell.seeds)[0])
    # random steps are fast: they count in the time of a finished cell, not in what is left of another
    speed = metrics.get("steps_per_second" if complete else "learning_steps_per_second")
    if holder is not None:
        return Progress("running", max(step, int(metrics.get("step", 0))), speed, holder)
    if complete:
        damage = folders.damage(folder, cell)
        return Progress("failed" if damage else "done", step, speed, damage)
    if events and events[-1]["event"] == "failed":
        return Progress("failed", step, speed, str(events[-1].get("line", "")))
    return Progress("begun" if step else "todo", step, speed)


def is_damaged(cell: Cell, runs: Path, progress: Progress) -> bool:
    """Tell whether a cell is complete and damaged. One that failed otherwise goes on from what it stored."""
    return progress.state == "failed" and folders.stored(runs / cell.folder, cell.seeds)[1]


def standing(cells: Sequence[Cell], runs: Path) -> list[tuple[Cell, Progress]]:
    """Read from disk how far each cell is."""
    return [(cell, progress(cell, runs)) for cell in cells]


def seconds_left(standing: Standing, workers: int) -> float | None:
    """Estimate the time left from the speeds measured so far, or return None if there are none yet.

    A cell that has not learned yet is taken to be as fast as the median of the cells most like it that have: the same
    agent, task and delay, else the same agent and task, else the same agent, else all.
    """
    measured = [(cell, p.speed) for cell, p in standing if p.speed]
    unfinished = [(cell, p) for cell, p in standing if p.state not in ("done", "failed")]
    if not unfinished:
        return 0.0
    if not measured:
        return None
    seconds = [(cell.condition.steps - p.step) / (p.speed or _speed_like(cell, measured)) for cell, p in unfinished]
    return max(sum(seconds) / workers, max(seconds))


def _speed_like(cell: Cell, measured: list[tuple[Cell, float]]) -> float:
    for names in (("agent", "env", "delay"), ("agent", "env"), ("agent",)):
        values = attrgetter(*names)
        alike = [speed for other, speed in measured if values(other.condition) == values(cell.condition)]
        if alike:
            return median(alike)
    return median(speed for _, speed in measured)


def line(standing: Standing, workers: int) -> str:
    """Summarise a grid in one line."""
    counts = Counter(p.state for _, p in standing)
    steps, total = sum(p.step for _, p in standing), sum(cell.condition.steps for cell, _ in standing)
    parts = [f"{counts['done']}/{len(standing)} cells", f"{100 * steps / max(total, 1):.0f} % of the steps"]
    if counts["failed"]:
        parts.append(f"{counts['failed']} failed")
    left = seconds_left(standing, workers)
    if left:
        parts.append(f"about {duration(left)} left")
    running = [(cell.condition, p.step) for cell, p in standing if p.state == "running"]
    if running:
        parts.append(", ".join(f"{c.agent} {c.env} {100 * step // c.steps} %" for c, step in running))
    return " · ".join(parts)


def table(standing: Standing) -> list[list[str]]:
    """Return one row for each cell, with the columns of HEAD."""
    rows = []
    for cell, p in standing:
        condition, first, last = cell.condition, cell.seeds[0], cell.seeds[-1]
        names = [cell.id, condition.agent, condition.env, str(condition.short_delay)]
        seeds, steps = f"{first}-{last}" if last > first else str(first), f"{p.step:,} / {condition.steps:,}"
        left = seconds_left([(cell, p)], 1)
        times = [f"{p.speed:.0f}" if p.speed else "", duration(left) if left else ""]
        rows.append([*names, seeds, p.state, steps, *times])
    return rows


def closing_lines(name: str, standing: Standing, workers: int) -> list[str]:
    """Return the lines below the table: the standing of the grid, and its failures."""
    return [f"{name}: {line(standing, workers)}", *failures(standing)]


def failures(standing: Standing) -> list[str]:
    """Return a line for each cell that failed."""
    failed = [(cell, p) for cell, p in standing if p.state == "failed"]
    return [f"failed: {cell} ({cell.id})" + (f": {p.line}" if p.line else "") for cell, p in failed]


def duration(seconds: float) -> str:
    """Write a time in words: 40 s, 12 min, 3 h 20 min, 2 d 5 h."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 24 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"
