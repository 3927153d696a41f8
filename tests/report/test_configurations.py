"""Runs whose options differ stay apart, labelled by what differs, and runs say what learning costs."""

import json
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from delayrl.errors import DelayRLError
from delayrl.report.configurations import read_configs
from delayrl.report.markdown import markdown
from delayrl.report.page import payload
from delayrl.report.rows import read_rows
from delayrl.report.summary import Summary, summarise
from delayrl.run.condition import resolve
from delayrl.run.cost import Cost
from delayrl.run.folder import RunFolder
from delayrl.run.stored import overrides_of

COST = Cost(12_345, {"actor": 0.5, "critic": 1.0, "temperature": 0.5}, (128,), 3.2e9)


def made(
    folder: Path, value: float, seed: int = 0, agent: str = "bpql", env: str = "Pendulum-v1", delay: int = 3,
    older: bool = False, until: int = 10**9, origin: dict[str, Any] | None = None, **values: Any,
) -> Path:  # fmt: skip
    """A run folder whose evaluations are all `value`, one every 100 steps; its rows."""
    setup = replace(resolve(agent, env, delay, "small", "corrected", {"steps": 300} | values), origin=origin or {})
    names: dict[str, Any] = {} if older else {"configuration": setup.configuration}
    run = RunFolder(folder)
    run.create(setup.config | names | {"seed": seed, "cost": COST.json})
    columns = setup.condition.columns | {"privileged": False, "seed": seed, "policy": "agent", "episode": 0} | names
    steps = range(100, min(setup.schedule.steps, until) + 1, 100)
    run.append("rows", [columns | {"step": n, "reset_seed": 1, "return": value, "length": 9} for n in steps])
    return folder / "rows.jsonl"


def finals(*rows: Path, configs: bool = True) -> dict[str, list[float]]:
    """Final returns by label, of a summary of run folders."""
    return {p.label: r.curves.final.tolist() for p, r in summary_of(*rows, configs=configs).results.items()}


def summary_of(*rows: Path, configs: bool = True) -> Summary:
    return summarise(read_rows(rows), [], read_configs(rows) if configs else [])


def test_the_hash_is_of_all_options_and_of_nothing_else() -> None:
    base = resolve("bpql", "Pendulum-v1", 5, "small", "corrected", {}).configuration
    assert resolve("bpql", "Pendulum-v1", "5", "small", "corrected", {"n_steps": 3}).configuration == base
    assert resolve("bpql", "Reacher-v5", 9, "small", "corrected", {}).configuration == base  # in columns of their own
    for changed in ({"discount": 0.9}, {"steps": 20_000}, {"evaluate_every": 500}):
        assert resolve("bpql", "Pendulum-v1", 5, "small", "corrected", changed).configuration != base


@pytest.mark.parametrize("schedule", [{}, None, []])
def test_a_configuration_without_steps_is_one_line(schedule: Any, tmp_path: Path) -> None:
    rows = made(tmp_path, 1.0)
    config = RunFolder(tmp_path).config | {"schedule": schedule}
    with pytest.raises(DelayRLError, match="of bpql on Pendulum-v1, delay 3 has no schedule with its steps"):
        summarise(read_rows([rows]), [], [config])


def test_runs_that_differ_in_an_option_are_two_results(tmp_path: Path) -> None:
    one = made(tmp_path / "a", 1.0), made(tmp_path / "b", 2.0, seed=1)
    other = made(tmp_path / "c", 30.0, discount=0.9), made(tmp_path / "d", 40.0, seed=1, discount=0.9)
    assert finals(*one, *other) == {"bpql": [1.0, 2.0], "bpql discount=0.9": [30.0, 40.0]}
    summary = summary_of(*one, *other)
    assert [table.title for table in summary.tables if table.kind == "ablation"] == ["Ablation of bpql"]
    assert summary.shared == {("bpql", ""): {"steps": 300}}


def renamed(rows: Path, agent: str, code: str) -> Path:
    """The rows of a run of somebody's own agent, whose preset no report knows."""
    for file in (rows, rows.parent / "config.json"):
        file.write_text(file.read_text().replace('"bpql"', json.dumps(agent)))
    folder = RunFolder(rows.parent)
    folder.create(folder.config | {"versions": {"agent_code": code}})
    return rows


def test_runs_of_an_own_agent_are_named_by_the_options_that_differ(tmp_path: Path) -> None:
    """And where its code is not the same in all of them, the report says so."""
    one = renamed(made(tmp_path / "a", 1.0), "mine:Agent", "1a")
    two = renamed(made(tmp_path / "b", 2.0, discount=0.9, batch_size=64), "mine:Agent", "1a")
    usual = {name: RunFolder(one.parent).config["hyperparameters"][name] for name in ("batch_size", "discount")}
    first = f"mine:Agent batch_size={usual['batch_size']} discount={usual['discount']}"
    assert finals(one, two) == {first: [1.0], "mine:Agent batch_size=64 discount=0.9": [2.0]}
    assert "The modules of" not in markdown(summary_of(one, two), "", {})
    assert finals(one) == {"mine:Agent": [1.0]}
    later = renamed(made(tmp_path / "c", 3.0, seed=1), "mine:Agent", "2b")
    assert "The modules of mine:Agent changed between its runs" in markdown(summary_of(one, later), "", {})


def test_one_run_in_two_folders_is_one_line(tmp_path: Path) -> None:
    twice = made(tmp_path / "a", 1.0), made(tmp_path / "b", 1.0)
    with pytest.raises(DelayRLError, match=r"a/rows.jsonl and .*b/rows.jsonl hold runs of the same options and seed"):
        summary_of(*twice)
    with pytest.raises(DelayRLError, match=r"a/rows.jsonl is given twice"):
        summary_of(twice[0], twice[0])


def test_rows_with_and_without_their_configuration(tmp_path: Path) -> None:
    """Nothing is known of one of them, so the hash names both."""
    made_of = [made(tmp_path / "a", 1.0), made(tmp_path / "b", 2.0, discount=0.9)]
    known, unknown = (renamed(rows, "mine:Agent", "1a") for rows in made_of)
    hashes = [RunFolder(path.parent).config["configuration"][:8] for path in (known, unknown)]
    (unknown.parent / "config.json").unlink()
    labels = [f"mine:Agent configuration={name}" for name in hashes]
    assert finals(known, unknown) == dict(zip(labels, ([1.0], [2.0]), strict=True))


def test_runs_that_began_otherwise_say_so_and_are_no_reference(tmp_path: Path) -> None:
    """A delay-free SAC that began with another's networks has trained for longer than its steps."""
    begun = {"from": {"agent": "sac", "step": 900}}
    rows = [
        made(tmp_path / "random", 0.0, agent="random", delay=0),
        made(tmp_path / "bpql", 50.0, origin={"lengths": [100, 200]}),
        made(tmp_path / "begun", 1000.0, agent="sac", delay=0, origin=begun),
    ]
    (bpql,) = (r for place, r in summary_of(*rows).results.items() if place.label == "bpql")
    assert np.isnan(bpql.final).all()
    rows += [made(tmp_path / "sac", 100.0, agent="sac", delay=0), made(tmp_path / "new", 40.0)]
    results = {place.label: r for place, r in summary_of(*rows).results.items()}
    assert set(results) == {"random", "sac", "sac from=sac@900", "bpql", "bpql went_on=100, 200"}
    assert {r.reference_anchor.value for r in results.values()} == {100.0}


def test_a_shorter_run_is_not_dropped(tmp_path: Path) -> None:
    rows = made(tmp_path / "a", 1.0), made(tmp_path / "b", 2.0, seed=1, steps=200)
    assert finals(*rows) == {"bpql steps=300": [1.0], "bpql steps=200": [2.0]}


def test_a_run_ends_where_its_configuration_says(tmp_path: Path) -> None:
    (result,) = summary_of(made(tmp_path / "a", 1.0, until=200)).results.values()
    assert (result.partial, result.condition.steps) == (True, 300)
    assert result.unfinished == "at 200 of 300 steps"


def test_without_configurations_the_hash_tells_them_apart(tmp_path: Path) -> None:
    rows = made(tmp_path / "a", 1.0), made(tmp_path / "b", 2.0, discount=0.9)
    hashes = [RunFolder(path.parent).config["configuration"][:8] for path in rows]
    expected = {f"bpql configuration={name}": [value] for name, value in zip(hashes, (1.0, 2.0), strict=True)}
    assert finals(*rows, configs=False) == expected
    assert finals(rows[0], configs=False) == {"bpql": [1.0]}


def test_rows_without_the_column_are_read_as_before(tmp_path: Path) -> None:
    older = made(tmp_path / "a", 1.0, older=True), made(tmp_path / "b", 2.0, seed=1, older=True, discount=0.9)
    assert finals(*older) == {"bpql": [1.0, 2.0]}
    newer = made(tmp_path / "c", 3.0, steps=200)
    assert finals(*older, newer) == {"bpql": [1.0, 2.0], "bpql steps=200": [3.0]}


def test_a_run_that_an_older_version_began_is_one_run(tmp_path: Path) -> None:
    path = made(tmp_path / "a", 1.0)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    del lines[0]["configuration"]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    (result,) = summary_of(path).results.values()
    assert result.curves.steps.tolist() == [100, 200, 300]


def test_collected_files_keep_configurations(tmp_path: Path) -> None:
    rows = made(tmp_path / "a", 1.0), made(tmp_path / "b", 2.0, discount=0.9)
    collect = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "collect.py"))["collect"]
    collect(tmp_path / "out.jsonl", [path.parent for path in rows])
    assert finals(tmp_path / "out.jsonl") == {"bpql": [1.0], "bpql discount=0.9": [2.0]}


@pytest.mark.parametrize(
    "change",
    [
        *({"versions": "x"}, {"later_versions": 1}, {"configuration": [1]}, {"origin": 1}, {"hyperparameters": [1]}),
        *({"origin": {"from": "x"}}, {"schedule": {"steps": "many"}}),
    ],
)
def test_a_damaged_configuration_in_a_collected_file(change: Any, tmp_path: Path) -> None:
    config = json.loads((made(tmp_path / "a", 1.0).parent / "config.json").read_text())
    (tmp_path / "out.jsonl").write_text(json.dumps({"config": config | change}) + "\n")
    with pytest.raises(
        DelayRLError, match=r"^a configuration in .*out.jsonl is damaged: (no good \w+: |its schedule has no steps)"
    ):
        list(read_configs([tmp_path / "out.jsonl"]))


def test_overrides_are_those_of_the_preset() -> None:
    config = resolve("dida", "Pendulum-v1", 3, "small", "corrected", {"steps": 30_000, "student_hidden": [8]}).config
    assert overrides_of(json.loads(json.dumps(config))) == {"steps": 30_000, "student_hidden": [8]}
    official = resolve("ad-sac", "Pendulum-v1", 3, "small", "official", {}).config
    assert overrides_of(official) == {}
    assert overrides_of(config | {"agent": "mine"}) == {}
    assert overrides_of({}) == {}


def test_the_report_says_what_an_agent_costs(tmp_path: Path) -> None:
    rows = made(tmp_path / "a", 1.0), made(tmp_path / "b", 2.0, env="Reacher-v5")
    config = json.loads((tmp_path / "b" / "config.json").read_text())
    config["cost"] |= {"parameters": 1_400_000}
    (tmp_path / "b" / "config.json").write_text(json.dumps(config))
    summary = summary_of(*rows)
    line = ("bpql", "no", "12.3k to 1.4M", "1 × critic; 0.5 × actor, temperature", "128", "3.2G")
    assert f"| {' | '.join(line)} |" in markdown(summary, "t", {})
    assert payload(summary, "t")["costs"] == [[line]]
    assert "Cost of an agent" not in markdown(summary_of(*rows, configs=False), "t", {})


@pytest.mark.parametrize(
    "change", [None, {}, {"parameters": "x"}, {"batches": 5}, {"gradient_steps": []}, {"flops": float("inf")}]
)
def test_a_damaged_cost_is_one_line(tmp_path: Path, change: Any) -> None:
    rows = made(tmp_path / "a", 1.0)
    config = json.loads((tmp_path / "a" / "config.json").read_text())
    (tmp_path / "a" / "config.json").write_text(
        json.dumps(config | {"cost": config["cost"] | change if change else change})
    )
    with pytest.raises(DelayRLError, match=r"^no good cost: ") as error:
        summary_of(rows)
    assert "\n" not in str(error.value)
