"""Grids: which cells a TOML file stands for, and which files are refused."""

import functools
import itertools
import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import delayrl
from delayrl.agents.registry import AGENTS
from delayrl.bench.folders import claim
from delayrl.bench.grid import load_grid, shipped
from delayrl.cli.main import main
from delayrl.run.condition import Condition, Setup, resolve

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
    conditions = [cell.condition for cell in grid.cells]
    assert [(c.env, c.delay, c.agent) for c in conditions] == wanted
    assert len(set(grid.ids)) == len({cell.folder for cell in grid.cells}) == 8
    assert all(condition.steps == 15_000 for condition in conditions)
    assert all(cell.seeds == (0, 1) and cell.id in cell.folder for cell in grid.cells)
    assert (grid.name, grid.is_shipped) == ("grid", False)


def test_tasks_are_finished_one_after_the_other(tmp_path: Path) -> None:
    text = BASIC + '[[product]]\nagents = ["sac"]\ndelays = [0]\n[[product]]\n'
    conditions = [cell.condition for cell in load_grid(write(tmp_path, text)).cells]
    assert [condition.env for condition in conditions] == ["Reacher-v5"] * 5 + ["Pendulum-v1"] * 5
    assert [condition.agent for condition in conditions[:2]] == ["sac", "bpql"]


def ids(folder: Path, text: str) -> set[str]:
    return set(load_grid(write(folder, text)).ids)


def test_the_id_is_the_configuration(tmp_path: Path) -> None:
    """Order, spelled-out defaults and the place of an override do not change ids; anything else does."""
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
    """An id that changes although no option or default of `random` did is a defect: runs would be lost."""
    text = 'preset = "small"\nagents = ["random"]\ntasks = ["Reacher-v5"]\ndelays = [0]\n'
    assert load_grid(write(tmp_path, text)).ids == ["b39efaf6cbf4"]


@settings(max_examples=20, deadline=None)
@given(seeds=st.integers(1, 7), lockstep=st.integers(1, 9), first=st.integers(0, 5))
def test_lockstep_groups(seeds: int, lockstep: int, first: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Every seed is in one group, and no group exceeds the limit."""
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
    conditions = [cell.condition for cell in load_grid(write(tmp_path, text)).cells]
    cells = {(condition.agent, condition.delay): condition for condition in conditions}
    assert cells["bpql", 2].overrides == {"steps": 5000}
    assert cells["vdpo", 2].overrides == {"steps": 5000, "width": 8, "layers": 1}
    assert cells["bpql", 3].overrides == {"steps": 6000}
    assert cells["vdpo", 3].overrides == {"steps": 6000, "width": 16, "layers": 1}
    assert cells["vdpo", 3].steps == 6000


def test_a_products_own_value_wins_over_the_shared_one_of_an_agent(tmp_path: Path) -> None:
    text = """
    preset = "small"
    tasks = ["Reacher-v5"]
    delays = [2]
    [overrides.vdpo]
    batch_size = 64
    width = 8
    [[product]]
    agents = ["bpql", "vdpo"]
    [product.overrides]
    batch_size = 32
    """
    conditions = [cell.condition for cell in load_grid(write(tmp_path, text)).cells]
    assert {c.agent: c.overrides for c in conditions} == {
        "bpql": {"batch_size": 32},
        "vdpo": {"batch_size": 32, "width": 8},
    }


def test_overrides_of_all_agents_skip_those_without_the_option(tmp_path: Path) -> None:
    """Of the whole grid, and of one product; each name needs one agent that has it."""
    text = """
    preset = "small"
    tasks = ["Reacher-v5"]
    [overrides]
    width = 16
    discount = 0.9
    [[product]]
    agents = ["random", "bpql", "vdpo"]
    delays = [2]
    [product.overrides]
    updates = 2
    [[product]]
    agents = ["sac"]
    delays = [0]
    """
    conditions = [cell.condition for cell in load_grid(write(tmp_path, text)).cells]
    assert {condition.agent: condition.overrides for condition in conditions} == {
        "random": {},
        "bpql": {"discount": 0.9, "updates": 2},
        "vdpo": {"width": 16, "discount": 0.9, "updates": 2},
        "sac": {"discount": 0.9},
    }
    alone = 'preset = "small"\nagents = ["random"]\ntasks = ["Reacher-v5"]\ndelays = [2]\n'
    assert ids(tmp_path, alone) < ids(tmp_path, text)


def test_included_grids(tmp_path: Path) -> None:
    write(tmp_path, BASIC, "one")
    both = load_grid(write(tmp_path, 'include = ["one.toml"]\n[[product]]\nagents = ["sac"]\n' + extra, "both"))
    assert set(both.ids) > ids(tmp_path, BASIC)
    assert len(both.cells) == 9
    write(tmp_path, 'include = ["./both.toml"]', "three")
    with pytest.raises(delayrl.DelayRLError, match="cannot be included"):
        load_grid(tmp_path / "three.toml")


extra = 'tasks = ["Reacher-v5"]\ndelays = [0]\npreset = "small"\n'


loaded = functools.cache(load_grid)  # of those that are shipped


@pytest.mark.parametrize("name", shipped())
@pytest.mark.filterwarnings("ignore::delayrl.errors.DelayWarning")
def test_shipped_grids(name: str) -> None:
    grid = loaded(name)
    assert grid.is_shipped
    assert grid.name == name
    assert grid.description
    assert grid.cells
    assert {"sac", "random"} <= {cell.condition.agent for cell in grid.cells if cell.condition.delay == 0}  # anchors


@pytest.mark.filterwarnings("ignore::delayrl.errors.DelayWarning")
def test_grids_of_the_paper() -> None:
    """The cells of its tables, with ten seeds and its preset; tables share runs."""
    table = loaded("paper-table2")
    conditions = [cell.condition for cell in table.cells]
    delayed = {(c.env, c.delay, c.agent) for c in conditions if c.delay}
    agents = ("a-sac", "dcac", "dida", "bpql", "ad-sac", "vdpo")
    tasks = {condition.env for condition in conditions}
    assert len(tasks) == 9
    assert delayed == set(itertools.product(tasks, (5, 25, 50), agents))
    assert all(cell.seeds == tuple(range(10)) for cell in table.cells)
    order = [condition.env.removeprefix("delayrl/").removesuffix("-v4") for condition in conditions]
    wanted = "Pusher Hopper Swimmer HumanoidStandup Walker2d Ant HalfCheetah Humanoid Reacher"
    assert list(dict.fromkeys(order)) == wanted.split()
    for condition in conditions:
        if condition.agent != "random":
            setup = setup_of(condition)
            assert (setup.agent, setup.schedule) == tuple(AGENTS[condition.agent].presets["paper"])
    first = loaded("paper-table1")
    assert first.ids == [cell.id for cell in table.cells if cell.condition.delay in (0, 5)]
    assert [cell.condition.agent for cell in first.cells[:5]] == ["sac", "random", "vdpo", "bpql", "ad-sac"]
    ablation = loaded("paper-ablation")
    setups = [setup_of(cell.condition) for cell in ablation.cells if cell.condition.delay]
    names = [setup.config["hyperparameters"]["representation"] for setup in setups]
    assert {name: names.count(name) for name in names} == {"transformer": 9, "transformer-no-belief": 9, "mlp": 9}
    assert sum(cell.id in first.ids for cell in ablation.cells) == 27  # the anchors, and VDPO itself


def test_the_papers_row_has_both_anchors_under_both_protocols() -> None:
    """The random policy, and delay-free SAC for at least as many steps as every learner: what its thresholds need."""
    conditions = [cell.condition for cell in loaded("evidence-1-paper").cells]
    for protocol in ("corrected", "official"):
        own = [c for c in conditions if c.protocol == protocol]
        (reference,) = {c.steps for c in own if c.agent == "sac" and c.delay == 0}
        assert all(c.steps <= reference for c in own)
        (anchor,) = (c.overrides for c in own if c.agent == "random")
        assert anchor == {"steps": 20_000, "evaluation_episodes": 100, "precision": "bfloat16"}


def setup_of(c: Condition) -> Setup:
    return resolve(c.agent, c.env, c.delay, c.preset, c.protocol, c.overrides)


BAD = [
    ("agents = [", "is not a valid TOML file"),
    ("agents = " + "[" * 3000 + "]" * 3000, "is not a valid TOML file"),
    ("product = []", "there are no products, so nothing to run"),
    (BASIC + "product = []", "there are no products, so nothing to run"),
    ('agent = ["bpql"]\n', "unknown key 'agent' of the grid; did you mean agents?"),
    ('include = ["laptop"]\nseeds = 5\n', "seeds is for the grid's own products, and it has none"),
    ('include = ["laptop"]\n[overrides]\nsteps = 9\n', "overrides is for the grid's own products"),
    (BASIC.replace("bpql", "bqpl"), "unknown agent 'bqpl'; did you mean bpql"),
    (BASIC.replace("Reacher-v5", "Reacher-v9"), "unknown task 'Reacher-v9'"),
    (BASIC.replace('["bpql", "a-sac"]', "[]"), "there are no agents, so nothing to run"),
    (BASIC.replace("[2, 3]", "[]"), "there are no delays"),
    (BASIC.replace("seeds = 2", "seeds = 0"), "there are no seeds"),
    (BASIC.replace("seeds = 2", "seeds = 99999999999999999999"), "seeds must be from 1 to 10,000"),
    (BASIC.replace("seeds = 2", "seeds = [0, 2]"), "must be consecutive"),
    (BASIC.replace("seeds = 2", "seeds = true"), "must be a number or a list"),
    (BASIC.replace("[2, 3]", "[2.5]"), "whole environment steps"),
    (BASIC.replace("[2, 3]", "[[2]]"), "delays cannot hold [2]"),
    (BASIC.replace("[2, 3]", "[51]"), "longer than an episode"),
    (BASIC.replace("[2, 3]", '["2+reward=60"]'), "longer than an episode"),
    (BASIC.replace("[2, 3]", "3"), "delays must be a list"),
    (BASIC.replace('"bpql"', '"sac"'), "delay-free reference"),
    (BASIC + "[overrides]\nbatch_sise = 3\n", "did you mean batch_size"),
    (BASIC + "[overrides.dcac]\nhidden = [8]\n", "overrides of dcac, which is not among the agents bpql, a-sac"),
    (BASIC + "[[product]]\n[product.overrides.vdpo]\nwidth = 8\n", "product 1: there are overrides of vdpo, which is"),
    (BASIC + "[overrides]\nwidth = 3\n", "unknown hyperparameter 'width'"),
    (BASIC + "[overrides]\nsteps = 600\nrandom-steps = 200\n", "unknown hyperparameter 'random-steps'; did you mean"),
    (BASIC + "[overrides]\nbpql = 3\n", "unknown hyperparameter 'bpql'"),
    (BASIC + "[[product]]\n[product.overrides]\nwidth = 3\n", "product 1: unknown hyperparameter 'width'"),
    (BASIC + "[overrides]\nsteps = 900\n", "nothing would be learned: the first update is at step 1,000"),
    (BASIC + "[overrides]\nreplay_capacity = 5\n", "replay_capacity must be at least"),
    (BASIC + "[overrides.vpdo]\nwidth = 3\n", "did you mean vdpo"),
    (BASIC + "[overrides]\nbpql = 3\n[[product]]\n[product.overrides.bpql]\nsteps = 9\n", "a table in one place"),
    (BASIC + "[overrides.bpql]\nsteps = 9\n[[product]]\n[product.overrides]\nbpql = 3\n", "a table in one place"),
    (BASIC + 'preset = "big"\n', "is not a valid TOML file"),  # twice
    (BASIC.replace("small", "big"), "unknown preset 'big'"),
    (BASIC.replace('"bpql"', '"a-sac"'), "a cell is in the grid twice, a-sac on"),
    (BASIC + "[[product]]\n[[product]]\nseeds = [1, 2]\n", "two cells hold the same run"),
    (BASIC.replace("[2, 3]", '[2, "2"]'), "or an agent, task or delay is listed twice"),
    (BASIC + "[[product]]\n[[product]]\n", "a cell is in the grid twice"),
    (BASIC + "[[product]]\nsteps = 3\n", "product 1: unknown key 'steps'"),
    (BASIC + 'include = ["nowhere.toml"]\n', "there is no grid file"),
    (BASIC + 'include = ["papertable"]\n', "unknown grid 'papertable'"),
    (BASIC + 'name = "../x"\n', "a grid's name"),
    (BASIC + "product = 3\n", "product must be a list"),
    ("", "there are no agents"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_bad_grids(text: str, words: str, tmp_path: Path, monkeypatch, capsys) -> None:
    """A bad grid is one line and exit status 2, and leaves no files."""
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


@pytest.mark.parametrize("text", [b"", b"[]", b"null", b"{}", b"\xff", b'{"source": 1}'])
def test_a_damaged_claim_is_made_anew(text: bytes, tmp_path: Path) -> None:
    grid, claimed = load_grid(write(tmp_path, BASIC)), tmp_path / "runs" / "grids" / "grid.json"
    claim(tmp_path / "runs", grid)
    whole = claimed.read_bytes()
    claimed.write_bytes(text)
    claim(tmp_path / "runs", grid)
    assert claimed.read_bytes() == whole


def test_two_grids_of_one_name(tmp_path: Path) -> None:
    """The second is refused if results would mix; an edited file, and a copy of it, keep the name."""
    runs = tmp_path / "runs"
    (tmp_path / "other").mkdir()
    mine, theirs = (
        load_grid(write(tmp_path, BASIC)),
        load_grid(write(tmp_path / "other", BASIC + "protocol='official'")),
    )
    claim(runs, mine, check_only=True)
    assert not runs.exists()
    claim(runs, mine)
    with pytest.raises(delayrl.DelayRLError, match="two grids are named 'grid'"):
        claim(runs, theirs)
    claim(runs, replace(theirs, cells=mine.cells))
    claim(runs, mine)
    claim(runs, replace(mine, cells=theirs.cells))  # edited
    assert json.loads((runs / "grids" / "grid.json").read_text()) == {"source": "../grid.toml", "cells": theirs.ids}
