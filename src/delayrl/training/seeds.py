"""Which seeds a call of `train` trains, and in which folders."""

import re
from collections.abc import Sequence
from pathlib import Path

from delayrl.errors import DelayRLError
from delayrl.play.evaluation import check_seed
from delayrl.run.condition import Condition
from delayrl.run.folder import RunFolder


def seed_numbers(seed: int, seeds: int | Sequence[int]) -> list[int]:
    """Return the seeds to train: `seeds` many from `seed` on, or those listed. Raises DelayRLError for bad ones."""
    if isinstance(seeds, int):
        if seeds < 1:
            raise DelayRLError(f"seeds must be at least 1; got {seeds}")
        numbers = list(range(seed, seed + seeds))
    else:
        numbers = list(seeds)
        different = len(set(numbers)) == len(numbers) and all(isinstance(number, int) for number in numbers)
        if seed or not numbers or not different:
            raise DelayRLError(f"seeds is a number, or a list of different seeds without seed=; got {seeds!r}")
    check_seed(min(numbers))
    check_seed(max(numbers))
    return numbers


def run_folders(condition: Condition, seeds: list[int], out: str | Path | None) -> list[RunFolder]:
    """Return the run folder of each seed: below `out`, or where it is None below runs/."""
    kind = f"{condition.agent.strip('<>')}-{condition.preset}"
    if condition.protocol != "corrected":
        kind += f"-{condition.protocol}"
    task, kind = (re.sub(r"[^\w.=+@-]+", "-", name) for name in (condition.place, kind))
    home = Path(out) if out is not None else Path("runs") / task / kind
    if out is not None and len(seeds) == 1:
        return [RunFolder(home)]
    return [RunFolder(home / f"seed{seed}") for seed in seeds]
