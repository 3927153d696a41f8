"""Grids: what a TOML file stands for, and what is refused."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.bench.folders import claim
from delayrl.bench.grid import load_grid, shipped
from delayrl.cli.main import main
from delayrl.run.configuration import values_of
from delayrl.training.train import resolve

BASIC = """
preset = "small"
seeds = 2
agents = ["bpql", "a-sac"]
tasks = ["Reacher-v5", "Pendulum-v1"]
delays = [2, 3]
"""


def write(folder: Path, text: str, name: str = "grid") -> Path:
    file = folder / f"{name}.toml"
    file.write_text(text)
    return file


def test_product(tmp_path: Path) -> None:
    """Every combination once, task by task; ids differ and name the folders."""
    grid = load_grid(write(tmp_path, BASIC))
    wanted = [(t, d, a) for t in ("Reacher-v5", "Pendulum-v1") for d in (2, 3) for a in ("bpql", "a-sac")]
    assert [(c.env, c.delay, c.agent) for c in grid.cells] == wanted
    assert len(set(grid.ids)) == len({cell.folder for cell in grid.cells}) == 8
    assert all(cell.seeds == (0, 1) and cell.steps == 15_000 and cell.id in cell.folder for cell in grid.cells)
    assert (grid.name, grid.is_shipped) == ("grid", False)


def test_tasks_are_finished_one_after_the_other(tmp_path: Path) -> None:
    text = BASIC + '[[product]]\nagents = ["sac"]\ndelays = [0]\n[[product]]\n'
    cells = load_grid(write(tmp_path, text)).cells
    assert [cell.env for cell in cells] == ["Reacher-v5"] * 5 + ["Pendulum-v1"] * 5
    assert [cell.agent for cell in cells[:2]] == ["sac", "bpql"]


def ids(folder: Path, text: str) -> set[str]:
    return set(load_grid(write(folder, text)).ids)


def test_the_id_is_the_configuration(tmp_path: Path) -> None:
    """Not how it is written: order, defaults spelled out, where an override stands. Anything else changes it."""
    first = ids(tmp_path, BASIC)
    assert first == ids(tmp_path, "\n".join(reversed(BASIC.splitlines())))
    assert first == ids(tmp_path, BASIC.replace("seeds = 2", "seeds = [0, 1]").replace("[2, 3]", "[3.0, 2]"))
    assert first == ids(tmp_path, BASIC + "[overrides]\nsteps = 15000\ndiscount = 0.99\nhidden = [256, 256]\n")
    assert first == ids(tmp_path, BASIC + 'protocol = "corrected"\n[overrides.bpql]\nbatch_size = 128.0\n')
    product = BASIC + "[[product]]\n[product.overrides.bpql]\nbatch_size = 128\n"
    assert first == ids(tmp_path, product)
    for change in ("[overrides]\nsteps = 15001\n", "[overrides]\ndiscount = 0.98\n", 'protocol = "official"\n'):
        assert not first & ids(tmp_path, BASIC + change)
    assert not first & ids(tmp_path, BASIC.replace("seeds = 2", "seeds = 3"))
    some = ids(tmp_path, BASIC + "[overrides.bpql]\nbatch_size = 64\n")
    assert len(first & some) == 4


def test_ids_stay(tmp_path: Path) -> None:
    """Runs are found by them: an id that changes where no option or default of `random` did is a defect."""
    text = 'preset = "small"\nagents = ["random"]\ntasks = ["Reacher-v5"]\ndelays = [0]\n'
    assert load_grid(write(tmp_path, text)).ids == ["b39efaf6cbf4"]


@settings(max_examples=20, deadline=None)
@given(seeds=st.integers(1, 7), lockstep=st.integers(1, 9), first=st.integers(0, 5))
def test_lockstep_groups(seeds: int, lockstep: int, first: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Every seed once, in groups of at most so many."""
    numbers = list(range(first, first + seeds))
    text = f'preset = "small"\nagents = ["random"]\ntasks = ["Reacher-v5"]\ndelays = [0]\nseeds = {numbers}\n'
    grid = load_grid(write(tmp_path_factory.mktemp("grid"), text + f"lockstep = {lockstep}\n"))
    assert [seed for cell in grid.cells for seed in cell.seeds] == numbers
    assert all(len(cell.seeds) <= lockstep for cell in grid.cells)


def test_overrides_of_all_of_a_product_and_of_an_agent(tmp_path: Path) -> None:
    text = """
    preset = "small"
    agents = ["bpql", "vdpo"]
    tasks = ["Reacher-v5"]
    [overrides]
    steps = 5000
    [overrides.vdpo]
    width = 8
    layers = 1
    [[product]]
    delays = [2]
    [[product]]
    delays = [3]
    [product.overrides]
    steps = 6000
    [product.overrides.vdpo]
    width = 16
    """
    cells = {(c.agent, c.delay): c for c in load_grid(write(tmp_path, text)).cells}
    assert cells["bpql", 2].overrides == {"steps": 5000}
    assert cells["vdpo", 2].overrides == {"steps": 5000, "width": 8, "layers": 1}
    assert cells["bpql", 3].overrides == {"steps": 6000}
    assert cells["vdpo", 3].overrides == {"steps": 6000, "width": 16, "layers": 1}
    assert cells["vdpo", 3].steps == 6000


def test_included_grids(tmp_path: Path) -> None:
    write(tmp_path, BASIC, "one")
    both = load_grid(write(tmp_path, 'include = ["one.toml"]\n[[product]]\nagents = ["sac"]\n' + extra, "both"))
    assert set(both.ids) > ids(tmp_path, BASIC)
    assert len(both.cells) == 9
    write(tmp_path, 'include = ["./both.toml"]', "three")
    with pytest.raises(delayrl.DelayRLError, match="cannot be included"):
        load_grid(tmp_path / "three.toml")


extra = 'tasks = ["Reacher-v5"]\ndelays = [0]\npreset = "small"\n'


@pytest.mark.parametrize("name", shipped())
def test_shipped_grids(name: str) -> None:
    grid = load_grid(name)
    assert grid.is_shipped
    assert grid.name == name
    assert grid.description
    assert grid.cells
    assert {"sac", "random"} <= {cell.agent for cell in grid.cells if cell.delay == 0}  # what normalises


def test_grids_of_the_paper() -> None:
    """Its tables' cells, ten seeds, its preset unchanged; runs that tables share are one."""
    table = load_grid("paper-table2")
    late = {(c.env, c.delay, c.agent) for c in table.cells if c.delay}
    agents = ("a-sac", "dcac", "dida", "bpql", "ad-sac", "vdpo")
    tasks = {cell.env for cell in table.cells}
    assert len(tasks) == 9
    assert late == {
        (t, d, a) for t in tasks for d in (5, 25, 50) for a in agents if (t, d) != ("delayrl/Reacher-v4", 50)
    }
    assert all(cell.seeds == tuple(range(10)) for cell in table.cells)
    order = [cell.env.removeprefix("delayrl/").removesuffix("-v4") for cell in table.cells]
    wanted = "Pusher Hopper Swimmer HumanoidStandup Walker2d Ant HalfCheetah Humanoid Reacher"
    assert list(dict.fromkeys(order)) == wanted.split()
    for cell in table.cells:
        if cell.agent != "random":
            config, schedule = resolve(cell.agent, cell.preset, cell.protocol, cell.overrides)
            assert (config, schedule) == tuple(AGENTS[cell.agent].presets["paper"])
    first = load_grid("paper-table1")
    assert first.ids == [cell.id for cell in table.cells if cell.delay in (0, 5)]
    assert [cell.agent for cell in first.cells[:5]] == ["sac", "random", "vdpo", "bpql", "ad-sac"]
    ablation = load_grid("paper-ablation")
    kinds = [values_of(resolve(c.agent, c.preset, c.protocol, c.overrides)[0]) for c in ablation.cells if c.delay]
    names = [kind["representation"] for kind in kinds]
    assert {name: names.count(name) for name in names} == {"transformer": 9, "transformer-no-belief": 9, "mlp": 9}
    assert sum(cell.id in first.ids for cell in ablation.cells) == 27  # the anchors, and VDPO itself


BAD = [
    ("agents = [", "is no TOML file"),
    ("product = []", "there are no products, so nothing to run"),
    (BASIC + "product = []", "there are no products, so nothing to run"),
    ('agent = ["bpql"]\n', "unknown key 'agent' of the grid"),
    (BASIC.replace("bpql", "bqpl"), "unknown agent 'bqpl'; did you mean bpql"),
    (BASIC.replace("Reacher-v5", "Reacher-v9"), "unknown task 'Reacher-v9'"),
    (BASIC.replace('["bpql", "a-sac"]', "[]"), "there are no agents, so nothing to run"),
    (BASIC.replace("[2, 3]", "[]"), "there are no delays"),
    (BASIC.replace("seeds = 2", "seeds = 0"), "there are no seeds"),
    (BASIC.replace("seeds = 2", "seeds = [0, 2]"), "follow each other"),
    (BASIC.replace("seeds = 2", "seeds = true"), "must be a number or a list"),
    (BASIC.replace("[2, 3]", "[2.5]"), "whole environment steps"),
    (BASIC.replace("[2, 3]", "[[2]]"), "delays cannot hold [2]"),
    (BASIC.replace("[2, 3]", "[50]"), "no shorter than an episode"),
    (BASIC.replace("[2, 3]", "3"), "delays must be a list"),
    (BASIC.replace('"bpql"', '"sac"'), "delay-free reference"),
    (BASIC + "[overrides]\nbatch_sise = 3\n", "did you mean batch_size"),
    (BASIC + "[overrides]\nreplay_capacity = 5\n", "replay_capacity must be at least"),
    (BASIC + "[overrides.vpdo]\nwidth = 3\n", "did you mean vdpo"),
    (BASIC + "[overrides]\nbpql = 3\n[[product]]\n[product.overrides.bpql]\nsteps = 9\n", "a table in one place"),
    (BASIC + "[overrides.bpql]\nsteps = 9\n[[product]]\n[product.overrides]\nbpql = 3\n", "a table in one place"),
    (BASIC + 'preset = "big"\n', "is no TOML file"),  # twice
    (BASIC.replace("small", "big"), "unknown preset 'big'"),
    (BASIC.replace('"bpql"', '"a-sac"'), "two cells hold the same run"),
    (BASIC + "[[product]]\n[[product]]\nseeds = [1, 2]\n", "two cells hold the same run"),
    (BASIC + "[[product]]\nsteps = 3\n", "product 1: unknown key 'steps'"),
    (BASIC + 'include = ["nowhere.toml"]\n', "there is no grid file"),
    (BASIC + 'include = ["papertable"]\n', "unknown grid 'papertable'"),
    (BASIC + 'name = "../x"\n', "a grid's name"),
    (BASIC + "product = 3\n", "product must be a list"),
    ("", "there are no agents"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_bad_grids(text: str, words: str, tmp_path: Path, monkeypatch, capsys) -> None:
    """One line, exit status 2, nothing made."""
    file = write(tmp_path, text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["bench", "run", str(file)])
    err = capsys.readouterr().err
    assert end.value.code == 2
    assert err.startswith("delayrl: ")
    assert err.count("\n") == 1
    assert words in err
    assert list(tmp_path.iterdir()) == [file]


def test_two_grids_of_one_name(tmp_path: Path) -> None:
    """Refused where their results would mix; an edited file, and a copy of it, keep the name."""
    runs = tmp_path / "runs"
    (tmp_path / "other").mkdir()
    mine, theirs = (
        load_grid(write(tmp_path, BASIC)),
        load_grid(write(tmp_path / "other", BASIC + "protocol='official'")),
    )
    claim(runs, mine.name, mine.source, mine.ids, look=True)
    assert not runs.exists()
    claim(runs, mine.name, mine.source, mine.ids)
    with pytest.raises(delayrl.DelayRLError, match="two grids are named 'grid'"):
        claim(runs, theirs.name, theirs.source, theirs.ids)
    claim(runs, theirs.name, theirs.source, mine.ids)  # the same cells
    claim(runs, mine.name, mine.source, mine.ids)
    claim(runs, mine.name, mine.source, theirs.ids)  # edited
    assert json.loads((runs / "grids" / "grid.json").read_text()) == {"source": "../grid.toml", "cells": theirs.ids}
