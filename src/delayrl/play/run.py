"""What users read of a run: its configuration, its rows, its curve, its policy."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from delayrl.delays import short_label
from delayrl.errors import DelayRLError
from delayrl.run.folder import RunFolder, RunLike, is_config, path_of
from delayrl.run.rows import whole_evaluations

if TYPE_CHECKING:  # they take JAX, and listing runs does not
    from delayrl.envs.task import TaskLike
    from delayrl.play.policy import Policy
    from delayrl.run.agents import AgentLike


class Curve(NamedTuple):
    """Returns of a policy against the environment steps of its training."""

    steps: NDArray[np.int64]  # [evaluations]
    returns: NDArray[np.float64]  # [evaluations, episodes]


class Run:
    """A run, finished or not. It is a path too, and stands wherever a run folder does.

    Attributes:
        path: its folder, as it was given.
    """

    def __init__(self, path: RunLike) -> None:
        self.path = path_of(path)
        self._folder = RunFolder(self.path.absolute())  # the process may change its directory

    def __fspath__(self) -> str:
        return str(self._folder.path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Run) and self._folder.path == other._folder.path

    def __hash__(self) -> int:
        return hash(self._folder.path)

    @property
    def config(self) -> dict[str, Any]:
        """What was trained, on what, with which versions. Raises DelayRLError if the folder is no run."""
        return self._folder.config

    @property
    def delay(self) -> int | str:
        """The delay that it was trained under, as its rows name it: of a recording, a checksum."""
        return short_label(self.config["delay"])

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each evaluation episode: what was trained, step, start state, return, length.

        As the functions below, it raises DelayRLError if the folder is no run.
        """
        return self._read("rows")

    def metrics(self) -> list[dict[str, Any]]:
        """Return losses and speed, a row for every 1,000 steps: none of a shorter run."""
        return self._read("metrics")

    def episodes(self) -> list[dict[str, Any]]:
        """Return one row for each finished episode of training: step of its end, seed, number, return, length."""
        return self._read("episodes")

    def curve(self, policy: str = "agent") -> Curve:
        """Return the returns of each evaluation of the agent, or of its delay-free "reference".

        An evaluation that a crash cut off has fewer episodes than the others, and is left out.
        """
        if policy not in ("agent", "reference"):
            raise DelayRLError(f'a curve is that of "agent" or "reference"; got {policy!r}')
        returns: dict[int, list[float]] = {}
        for row in self.rows():
            if row["policy"] == policy:
                returns.setdefault(row["step"], []).append(row["return"])
        steps = whole_evaluations(returns)
        episodes = len(returns[steps[0]]) if steps else 0
        table = np.array([returns[step] for step in steps]).reshape(len(steps), episodes)
        return Curve(np.array(steps, np.int64), table)

    def _read(self, name: str) -> list[dict[str, Any]]:
        self._folder.check_exists()
        return self._folder.read(name)

    def policy(
        self,
        env: TaskLike | None = None,
        *,
        env_kwargs: Mapping[str, Any] | None = None,
        agent: AgentLike | None = None,
    ) -> Policy:
        """Return its newest policy, as `delayrl.load` does, with the same arguments and errors."""
        from delayrl.play.policy import load

        return load(self, env, env_kwargs=env_kwargs, agent=agent)


def runs(folder: str | Path = "runs") -> list[Run]:
    """Return all runs in a folder and below it, by their paths. Raises DelayRLError if there is no such folder."""
    if not isinstance(folder, str | PathLike) or not Path(folder).is_dir():
        raise DelayRLError(f"there is no folder {folder}")
    return [Run(file.parent) for file in sorted(Path(folder).rglob("config.json")) if is_config(file)]
