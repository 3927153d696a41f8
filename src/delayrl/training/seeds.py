"""Which seeds a call of `train` trains, and in which folders."""

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError
from delayrl.play.evaluation import check_seed
from delayrl.run.condition import Condition
from delayrl.run.folder import RunFolder

Seeds = int | Sequence[int] | NDArray[np.integer[Any]]
"""How many, or which."""
MOST = 10_000
"""Seeds that one call may train: they are trained in lockstep."""


def seed_numbers(seed: int, seeds: Seeds | None) -> list[int]:
    """Return the seeds to train: `seeds` many from `seed` on, those listed, or one. Raises DelayRLError if bad."""
    check_seed(seed)
    if seeds is None:
        return [int(seed)]
    if isinstance(seeds, int | np.integer):
        if not 1 <= seeds <= MOST:
            raise DelayRLError(f"seeds must be from 1 to {MOST:,}; got {seeds}")
        numbers: list[Any] = list(range(seed, seed + seeds))
    else:
        given = seeds.tolist() if isinstance(seeds, np.ndarray) else seeds
        numbers = list(given) if isinstance(given, Sequence) and not isinstance(given, str | bytes) else []
        if seed:
            raise DelayRLError(f"seeds that are listed are given without seed=; got seed={seed}, seeds={seeds!r}")
    for number in numbers:
        check_seed(number)
    if not numbers or len({*numbers}) < len(numbers):
        raise DelayRLError(f"seeds is a number, or a list of different seeds; got {seeds!r}")
    return [int(number) for number in numbers]


def run_folders(condition: Condition, seeds: list[int], out: str | Path | None) -> list[RunFolder]:
    """Return the run folder of each seed: below `out`, or where it is None below runs/.

    Raises DelayRLError if several were to lie within a run.
    """
    if not isinstance(out, str | PathLike | None):
        raise DelayRLError(f"out is the path of a folder; got {out!r}")
    kind = f"{condition.agent.strip('<>')}-{condition.preset}"
    if condition.protocol != "corrected":
        kind += f"-{condition.protocol}"
    task, kind = (re.sub(r"[^\w.=+@-]+", "-", name) for name in (condition.folder_name, kind))
    home = Path(out) if out is not None else Path("runs") / task / kind
    if out is not None and len(seeds) == 1:
        return [RunFolder(home)]
    if RunFolder(home).exists:
        raise DelayRLError(f"{home} is a run: several seeds need a folder of their own; give another --out")
    return [RunFolder(home / f"seed{seed}") for seed in seeds]
