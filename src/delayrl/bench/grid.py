"""Grids: expand a TOML file of agents, tasks, delays, seeds and overrides into cells. docs/experiments.md has the keys.

A cell is one lockstep group of seeds. Its id hashes the resolved configuration, defaults included. So the way a file is
written does not change ids, and grids that contain the same cell share its results.
"""

import contextlib
import functools
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from delayrl.envs.making import make
from delayrl.envs.task import as_task, closing_quietly
from delayrl.errors import DelayRLError, did_you_mean, near_names
from delayrl.play.evaluation import check_seed
from delayrl.play.policy import spec_of
from delayrl.run.agents import find_agent
from delayrl.run.cell import Cell
from delayrl.run.condition import Setup, resolve
from delayrl.run.configuration import check_names, options
from delayrl.training.checks import check_fit, replay_bytes
from delayrl.training.seeds import MOST

LISTS = {"agents": list, "tasks": list, "delays": list}
TASK = {"env_kwargs": dict, "wrappers": list, "flatten": bool}
PRODUCT = {**LISTS, **TASK, "seeds": int | list, "lockstep": int, "preset": str, "protocol": str, "overrides": dict}
GRID = {**PRODUCT, "name": str, "description": str, "include": list, "product": list}
DEFAULTS: dict[str, Any] = {"preset": "paper", "protocol": "corrected", "seeds": 1, "overrides": {}}


class Planned(NamedTuple):
    """A cell, what it resolves to, and the size of its replays."""

    setup: Setup
    cell: Cell
    replay_bytes: int


@dataclass(frozen=True)
class Grid:
    """A grid that was read from a file. Its cells are in the order in which they start."""

    name: str
    description: str
    source: Path
    cells: tuple[Cell, ...]
    replay_bytes: int = 0  # of the cell with the largest replays, of all its seeds

    @property
    def is_shipped(self) -> bool:
        """Whether it comes with the package."""
        return self.source in shipped().values()

    @property
    def ids(self) -> list[str]:
        """The ids of its cells."""
        return [cell.id for cell in self.cells]


def shipped() -> dict[str, Path]:
    """Return the files of the grids that come with the package, by name."""
    home = Path(str(files("delayrl.bench") / "grids"))
    return {path.stem: path for path in sorted(home.glob("*.toml"))}


def load_grid(grid: str | Path) -> Grid:
    """Read a grid and check that every cell can be trained.

    Args:
        grid: the path of a TOML file, or the name of a grid that comes with the package.

    Raises:
        DelayRLError: no such grid, invalid TOML, an unknown key, agent, task or hyperparameter, nothing to run, a cell
            that cannot be trained, the same run in two cells.
    """
    source, table = _read(str(grid), Path())
    try:
        cells = _expand(table, source)
        name = table.get("name", source.stem)
        if not re.fullmatch(r"[\w.-]+", name):
            raise DelayRLError(f"a grid's name has letters, digits, '.', '_' and '-'; got {name!r}")
        _check_overlap(cells)
    except DelayRLError as error:
        raise DelayRLError(f"{source.name}: {error}") from error
    tasks = [planned.cell.condition.env for planned in cells]
    ordered = sorted(cells, key=lambda planned: tasks.index(planned.cell.condition.env))  # task by task
    largest = max(planned.replay_bytes for planned in cells)
    description = " ".join(table.get("description", "").split())
    return Grid(name, description, source, tuple(planned.cell for planned in ordered), largest)


def _read(grid: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Return the file of a grid, and what it holds. A path is relative to the folder."""
    is_path = grid.endswith(".toml") or "/" in grid
    source = folder / grid if is_path else shipped().get(grid)
    if (folder / grid).is_dir() and (is_path or source is None):
        hint = f"python -m delayrl.report {grid}/*/*/seed*/rows.jsonl --out report"
        raise DelayRLError(f"{grid} is a folder, and no grid; runs of `delayrl train` are reported by `{hint}`")
    if grid.endswith(".sqlite"):
        raise DelayRLError(f"{grid} is a table of results: only `delayrl bench report` reads one")
    if source is None:
        raise DelayRLError(f"unknown grid {grid!r}; give a .toml file, or one of {', '.join(shipped())}")
    try:
        return source, tomllib.loads(source.read_text())
    except FileNotFoundError as error:
        raise DelayRLError(f"there is no grid file {source}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise DelayRLError(f"{source} is not a valid TOML file: {error}") from error


def _expand(table: dict[str, Any], source: Path, included: bool = False) -> list[Planned]:
    """Return the cells of a grid's table and of the grids that it includes."""
    _check_keys(table, GRID, "the grid")
    if included and "include" in table:
        raise DelayRLError(f"{source.name} includes other grids, so it cannot be included")
    cells: list[Planned] = []
    for other in table.get("include", []):
        path, included_table = _read(str(other), source.parent)
        cells += _expand(included_table, path, included=True)
    products = table.get("product", [{}] if LISTS.keys() & table.keys() or not cells else [])
    if not all(isinstance(item, dict) for item in products):
        raise DelayRLError("products are written as [[product]]")
    if cells and not products and (unused := next((key for key in table if key in PRODUCT), None)):
        line = f"{unused} is for the grid's own products, and it has none"
        raise DelayRLError(f"{line}; the cells it includes keep theirs")
    shared: dict[str, Any] = DEFAULTS | {key: value for key, value in table.items() if key in PRODUCT}
    wholes = []
    for number, item in enumerate(products, 1):
        with _in_product(number if "product" in table else 0):
            _check_keys(item, PRODUCT, "a product")
            own = item.get("overrides", {})
            whole = shared | item | {"overrides": _merge(shared["overrides"], own)}
            _check_lists(whole)
            _check_overrides(own, whole["agents"])
            wholes.append(whole)
    if not cells and not wholes:
        raise DelayRLError("there are no products, so nothing to run")
    _check_overrides(shared["overrides"], [agent for whole in wholes for agent in whole["agents"]])
    for number, whole in enumerate(wholes, 1):
        with _in_product(number if "product" in table else 0):
            cells += _cells(whole)
    return cells


@contextlib.contextmanager
def _in_product(number: int) -> Iterator[None]:
    """Name the product in errors, unless its number is 0."""
    try:
        yield
    except DelayRLError as error:
        raise DelayRLError(f"product {number}: {error}" if number else str(error)) from error


def _check_keys(table: Mapping[str, Any], known: Mapping[str, Any], what: str) -> None:
    for key, value in table.items():
        if key not in known:
            hint = did_you_mean(near_names(key, known), f"allowed are {', '.join(known)}")
            raise DelayRLError(f"unknown key {key!r} of {what}{hint}")
        if not isinstance(value, known[key]) or (isinstance(value, bool) and known[key] is not bool):
            words = {list: "a list", dict: "a table", str: "a string", int: "a whole number", bool: "true or false"}
            raise DelayRLError(f"{key} must be {words.get(known[key], 'a number or a list')}; got {value!r}")


def _merge(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Merge overrides; a product's own win, over shared tables of agents too. Tables of the same agent are merged."""
    merged = {
        name: {key: x for key, x in value.items() if key not in own} if isinstance(value, dict) else value
        for name, value in shared.items()
    }
    for key, value in own.items():
        known = merged.get(key, value)
        if isinstance(known, dict) != isinstance(value, dict):
            raise DelayRLError(f"overrides: {key} is a table in one place and a value in another")
        merged[key] = known | value if isinstance(value, dict) else value
    return merged


def _check_overrides(overrides: Mapping[str, Any], agents: Sequence[str]) -> None:
    """Raise DelayRLError for an override that would be ignored: of no agent's option, or of an agent not there."""
    presets = [preset for agent in agents for preset in find_agent(agent).presets.values()]
    names = [name for name, value in overrides.items() if not isinstance(value, dict)]
    check_names(names, *(config for preset in presets for config in preset))
    for name, value in overrides.items():
        if isinstance(value, dict) and name not in agents:
            raise DelayRLError(f"there are overrides of {name}, which is not among the agents {', '.join(agents)}")


def _applicable(overrides: Mapping[str, Any], agent: str) -> dict[str, Any]:
    """Return those overrides of all agents whose option this agent has."""
    known = {option.name for preset in find_agent(agent).presets.values() for c in preset for option in options(c)}
    return {name: value for name, value in overrides.items() if name in known}


def _check_lists(table: Mapping[str, Any]) -> None:
    """Raise DelayRLError if a product has no agents, tasks or delays, one of another type, or an unknown agent."""
    for key, kind in (("agents", str), ("tasks", str), ("delays", int | float | str)):
        if not table.get(key):
            raise DelayRLError(f"there are no {key}, so nothing to run")
        for item in table[key]:
            if not isinstance(item, kind) or isinstance(item, bool):
                raise DelayRLError(f"{key} cannot hold {item!r}")
    for agent in [*table["agents"], *_tables(table)]:
        find_agent(agent)


def _tables(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a product's overrides for single agents."""
    return {name: value for name, value in table["overrides"].items() if isinstance(value, dict)}


def _cells(table: Mapping[str, Any]) -> Iterator[Planned]:
    """Yield the cells of one product."""
    tables = _tables(table)
    shared = {name: value for name, value in table["overrides"].items() if name not in tables}
    groups = _seed_groups(table["seeds"], table.get("lockstep"))
    around = table.get("env_kwargs"), table.get("wrappers", ()), table.get("flatten", False)
    tasks = [str(as_task(env, *around)) for env in table["tasks"]]
    for env, delay, agent in product(tasks, table["delays"], table["agents"]):
        overrides = json.dumps(_applicable(shared, agent) | tables.get(agent, {}), default=str)
        try:
            setup, replay_bytes = _setup(agent, env, delay, table["preset"], table["protocol"], overrides)
        except DelayRLError as error:
            raise DelayRLError(f"{agent} on {env}, delay {delay}: {error}") from error
        for seeds in groups:
            cell = Cell(setup.condition, seeds, setup.cell_id(seeds))
            yield Planned(setup, cell, len(seeds) * replay_bytes)


def _seed_groups(seeds: int | list[int], lockstep: int | None) -> list[tuple[int, ...]]:
    if isinstance(seeds, int) and seeds > MOST:
        raise DelayRLError(f"seeds must be from 1 to {MOST:,}; got {seeds}")
    numbers = list(range(seeds)) if isinstance(seeds, int) else seeds
    if not numbers:
        raise DelayRLError("there are no seeds, so nothing to run")
    if any(isinstance(seed, bool) or not isinstance(seed, int) for seed in numbers):
        raise DelayRLError(f"seeds must be whole numbers; got {seeds!r}")
    if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        raise DelayRLError(f"seeds of one product must be consecutive, as in [3, 4, 5]; got {seeds!r}")
    check_seed(numbers[0])
    check_seed(numbers[-1])
    size = len(numbers) if lockstep is None else lockstep
    if size < 1:
        raise DelayRLError(f"lockstep must be at least 1 seed; got {lockstep}")
    return [tuple(numbers[i : i + size]) for i in range(0, len(numbers), size)]


@functools.cache  # it builds the task; overrides are JSON to be a key of the cache
def _setup(agent: str, env: str, delay: float | str, preset: str, protocol: str, overrides: str) -> tuple[Setup, int]:
    """Resolve a condition. Returns the bytes of a seed's replay too. Raises DelayRLError if it cannot be trained."""
    setup = resolve(agent, env, delay, preset, protocol, json.loads(overrides))
    with closing_quietly(make(env, setup.delay.observed())) as task:
        check_fit(setup, task)
        spec = spec_of(task)
        return setup, replay_bytes(spec, setup.replay_rows(spec))


def _check_overlap(cells: list[Planned]) -> None:
    """Raise DelayRLError if a run is in two cells: its rows would count twice."""
    first: dict[tuple[str, int], Cell] = {}
    for setup, cell, _ in cells:
        configuration = setup.cell_id(())
        for seed in cell.seeds:
            other = first.setdefault((configuration, seed), cell)
            if other is cell:
                continue
            if other.id == cell.id:
                raise DelayRLError(
                    f"a cell is in the grid twice, {cell} ({cell.id}): products overlap (an override that is the "
                    "default changes nothing), or an agent, task or delay is listed twice, perhaps written in two "
                    "ways, or included again"
                )
            raise DelayRLError(f"two cells hold the same run: {cell} ({cell.id}) and {other} ({other.id})")
