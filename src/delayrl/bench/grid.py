"""Grids: a TOML file (agents × tasks × delays × seeds × overrides) becomes cells.

```toml
description = "…"
preset = "small"                     # and protocol = "corrected" (default) or "official"
seeds = 3                            # 0, 1, 2; or a list of consecutive ones
tasks = ["delayrl/Reacher-v4"]       # what stands here holds for every product that does not say otherwise

[overrides]                          # hyperparameters and schedule, of all agents …
steps = 5_000
[overrides.vdpo]                     # … and of one
width = 64

[[product]]
agents = ["vdpo", "bpql"]
delays = [5, 25]

[[product]]
agents = ["sac"]
delays = [0]
```

A cell is one lockstep group of seeds. Its id is the hash of all that it is made of, defaults included: how it is
written in a file does not matter, and two grids that hold the same cell share it.
"""

import functools
import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

from delayrl.agents.base import Agent, Schedule
from delayrl.agents.registry import AGENTS
from delayrl.delays import as_delay
from delayrl.envs import delay_of, make
from delayrl.errors import DelayRLError
from delayrl.play.evaluation import check_seed
from delayrl.run.configuration import values_of
from delayrl.training.train import check_fit, find_agent, resolve

PRODUCT = {
    "agents": list,
    "tasks": list,
    "delays": list,
    "seeds": int | list,
    "lockstep": int,
    "preset": str,
    "protocol": str,
    "overrides": dict,
}
GRID = {**PRODUCT, "name": str, "description": str, "include": list, "product": list}
DEFAULTS: dict[str, Any] = {"preset": "paper", "protocol": "corrected", "seeds": 1, "overrides": {}}


@dataclass(frozen=True)
class Cell:
    """One lockstep group of seeds of one agent on one delayed task."""

    agent: str
    env: str
    delay: int | str
    """Environment steps, or a delay law in words."""
    preset: str
    protocol: str
    seeds: tuple[int, ...]
    overrides: dict[str, Any]
    steps: int
    """Environment steps that each seed trains."""
    id: str

    @property
    def label(self) -> int | str:
        """The delay as rows name it: a long list of numbers is shortened."""
        return as_delay(self.delay).label()

    @property
    def folder(self) -> str:
        """Name of its folder: readable, and of its own."""
        return re.sub(r"[^\w.-]+", "-", f"{self.env}-delay{self.label}-{self.agent}-{self.id}")

    def __str__(self) -> str:
        first, last = self.seeds[0], self.seeds[-1]
        seeds = f"seed {first}" if first == last else f"seeds {first}-{last}"
        return f"{self.agent} on {self.env}, delay {self.label}, {seeds}"


@dataclass(frozen=True)
class Grid:
    """A grid file: its name, where it was read, its cells in the order in which they are worked off."""

    name: str
    description: str
    source: Path
    cells: tuple[Cell, ...]

    @property
    def is_shipped(self) -> bool:
        """Whether it comes with the package."""
        return self.source in shipped().values()

    @property
    def ids(self) -> list[str]:
        """The cells' ids."""
        return [cell.id for cell in self.cells]


def shipped() -> dict[str, Path]:
    """The grids that come with the package, by name."""
    home = Path(str(files("delayrl.bench") / "grids"))
    return {path.stem: path for path in sorted(home.glob("*.toml"))}


def load_grid(grid: str | Path) -> Grid:
    """A grid by the path of its TOML file, or by the name of one that comes with the package.

    Raises:
        DelayRLError: no such grid, no TOML, an unknown key, agent, task or hyperparameter, nothing to run, a cell
            that cannot be trained, the same run in two cells.
    """
    return _load(grid, Path(), included=False)


def _load(grid: str | Path, beside: Path, included: bool) -> Grid:
    source = _find(str(grid), beside)
    try:
        table = tomllib.loads(source.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DelayRLError(f"{source} is no TOML file: {error}") from error
    try:
        return _parse(table, source, included)
    except DelayRLError as error:
        raise DelayRLError(f"{source.name}: {error}" if not included else str(error)) from error


def _find(grid: str, beside: Path) -> Path:
    if grid.endswith(".toml") or "/" in grid:
        path = beside / grid
        if not path.is_file():
            raise DelayRLError(f"there is no grid file {path}")
        return path
    if grid not in shipped():
        raise DelayRLError(f"unknown grid {grid!r}; give a .toml file, or one of {', '.join(shipped())}")
    return shipped()[grid]


def _parse(table: dict[str, Any], source: Path, included: bool) -> Grid:
    _check_keys(table, GRID, "the grid")
    name = table.get("name", source.stem)
    if not re.fullmatch(r"[\w.-]+", name):
        raise DelayRLError(f"a grid's name has letters, digits, '.', '_' and '-'; got {name!r}")
    cells: list[Cell] = []
    if included and "include" in table:
        raise DelayRLError(f"{source.name} includes other grids, and so cannot be included")
    for other in table.get("include", []):
        cells += _load(other, source.parent, included=True).cells
    own = [key for key in ("agents", "tasks", "delays") if key in table]
    products = table.get("product", [{}] if own or not cells else [])
    if not all(isinstance(item, dict) for item in products):
        raise DelayRLError("products are written as [[product]]")
    shared: dict[str, Any] = DEFAULTS | {key: value for key, value in table.items() if key in PRODUCT}
    for number, item in enumerate(products, 1):
        try:
            _check_keys(item, PRODUCT, "a product")
            merged = shared | item | {"overrides": _merge(shared["overrides"], item.get("overrides", {}))}
            cells += _cells(merged)
        except DelayRLError as error:
            raise DelayRLError(f"product {number}: {error}" if "product" in table else str(error)) from error
    if not cells:
        raise DelayRLError("there are no products, so nothing to run")
    _check_overlap(cells)
    tasks = {cell.env: i for i, cell in reversed(list(enumerate(cells)))}
    cells.sort(key=lambda cell: tasks[cell.env])  # a task is finished before the next one begins
    return Grid(name, " ".join(table.get("description", "").split()), source, tuple(cells))


def _check_keys(table: Mapping[str, Any], known: Mapping[str, Any], what: str) -> None:
    for key, value in table.items():
        if key not in known:
            raise DelayRLError(f"unknown key {key!r} of {what}; there are {', '.join(known)}")
        if not isinstance(value, known[key]) or isinstance(value, bool):
            words = {list: "a list", dict: "a table", str: "a text", int: "a whole number"}
            raise DelayRLError(f"{key} must be {words.get(known[key], 'a number or a list')}; got {value!r}")


def _merge(*tables: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides of all, then of a product; an agent's own table is merged, not replaced."""
    merged: dict[str, Any] = {}
    for table in tables:
        for key, value in table.items():
            known = merged.get(key, value)
            if isinstance(known, dict) != isinstance(value, dict):
                raise DelayRLError(f"overrides: {key} is a table in one place and a value in another")
            merged[key] = known | value if isinstance(value, dict) else value
    return merged


def _cells(table: dict[str, Any]) -> Iterable[Cell]:
    for key in ("agents", "tasks", "delays"):
        if not table.get(key):
            raise DelayRLError(f"there are no {key}, so nothing to run")
    for key, kind in (("agents", str), ("tasks", str), ("delays", int | float | str)):
        for item in table[key]:
            if not isinstance(item, kind) or isinstance(item, bool):
                raise DelayRLError(f"{key} cannot hold {item!r}")
    for agent in table["agents"]:
        find_agent(agent)
    for name, value in table["overrides"].items():
        if isinstance(value, dict) and name not in AGENTS:
            find_agent(name)
    shared = {name: value for name, value in table["overrides"].items() if not isinstance(value, dict)}
    groups = _groups(table["seeds"], table.get("lockstep"))
    for env, delay, agent in product(table["tasks"], table["delays"], table["agents"]):
        overrides = shared | table["overrides"].get(agent, {})
        for seeds in groups:
            try:
                yield _cell(agent, env, delay, table["preset"], table["protocol"], seeds, overrides)
            except DelayRLError as error:
                raise DelayRLError(f"{agent} on {env}, delay {delay}: {error}") from error


def _groups(seeds: int | list[int], lockstep: int | None) -> list[tuple[int, ...]]:
    numbers = list(range(seeds)) if isinstance(seeds, int) else seeds
    if not numbers:
        raise DelayRLError("there are no seeds, so nothing to run")
    if any(isinstance(seed, bool) or not isinstance(seed, int) for seed in numbers):
        raise DelayRLError(f"seeds are whole numbers; got {seeds!r}")
    if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        raise DelayRLError(f"seeds of one product follow each other, as in [3, 4, 5]; got {seeds!r}")
    check_seed(numbers[0])
    check_seed(numbers[-1])
    size = len(numbers) if lockstep is None else lockstep
    if size < 1:
        raise DelayRLError(f"lockstep must be at least 1 seed; got {lockstep}")
    return [tuple(numbers[i : i + size]) for i in range(0, len(numbers), size)]


def _cell(
    agent: str, env: str, delay: Any, preset: str, protocol: str, seeds: tuple[int, ...], overrides: dict[str, Any]
) -> Cell:
    config, schedule = resolve(agent, preset, protocol, overrides)
    delay = _check(config, schedule, env, delay)
    whole = {
        "agent": agent,
        "env": env,
        "delay": delay,
        "preset": preset,
        "protocol": protocol,
        "seeds": seeds,
        "hyperparameters": values_of(config),
        "schedule": values_of(schedule),
    }
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    return Cell(agent, env, delay, preset, protocol, seeds, overrides, schedule.steps, digest[:12])


@functools.cache
def _check(agent: Agent, schedule: Schedule, env: str, delay: int | str) -> int | str:
    """The delay as runs write it down; DelayRLError where the cell could not be trained."""
    late = delay_of(env, delay)
    task = make(env, late.observed())
    check_fit(agent, schedule, task)
    task.close()
    return late.plain()


def _check_overlap(cells: list[Cell]) -> None:
    """No run may be in two cells: its rows would count twice."""
    seen: dict[str, Cell] = {}
    for cell in cells:
        config, schedule = resolve(cell.agent, cell.preset, cell.protocol, cell.overrides)
        names = [field.name for field in fields(Cell) if field.name not in ("seeds", "overrides", "id")]
        what = json.dumps([[getattr(cell, n) for n in names], values_of(config), values_of(schedule)])
        for seed in cell.seeds:
            key = f"{what} {seed}"
            if key in seen:
                raise DelayRLError(f"two cells hold the same run: {cell} ({cell.id}) and {seen[key]} ({seen[key].id})")
            seen[key] = cell
