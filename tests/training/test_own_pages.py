"""The pages on agents and laws of one's own: their code runs as it stands, from a package that is not of this one."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import delayrl
from delayrl.cli.main import main
from delayrl.deploy import load_bundle
from delayrl.play.run import Run
from own_tasks import write_module
from short_runs import OWN, declare, train

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def site(tmp_path: Path, monkeypatch) -> Path:
    """A folder of installed packages that has the modules of both pages, and declares what they say."""
    home = tmp_path / "site"
    home.mkdir()
    page, laws = (DOCS / "own-agent.md").read_text(), (DOCS / "delays.md").read_text()
    write_module(home, "late_ddpg", blocks(page, "python")[0])
    write_module(home, "my_laws", next(block for block in blocks(laws, "python") if "# my_laws.py" in block))
    (table,) = blocks(page, "toml")
    for group, points in tomllib.loads(table)["project"]["entry-points"].items():
        declare(home, group, **points)
    declare(home, "delayrl.delays", burst="my_laws:Burst")
    monkeypatch.setattr(sys, "path", [*sys.path, str(home)])
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return home


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def test_an_installed_package(site: Path, capsys) -> None:
    """Its agent and its law are trained from the command line in another process, then resumed, played and exported."""
    words = ["train", "late-ddpg", "--width", "16", "--env", "InvertedPendulum-v5", "--delay", "burst(steps=3)"]
    words += ["--preset", "small", "--steps", "1100", "--evaluate-every", "550", "--evaluation-episodes", "2"]
    words += ["--out", "run", "--quiet"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*filter(None, sys.path), str(site)])}
    command = [sys.executable, "-W", "ignore", "-m", "delayrl", *words]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    config = Run(Path("run")).config
    assert (config["agent"], config["delay"]) == ("late-ddpg", "burst(length=3, rate=0.1, steps=3)")
    assert config["hyperparameters"]["width"] == 16
    main(words)
    assert "1,100 steps" in capsys.readouterr().out
    main(["evaluate", "run", "--episodes", "2", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert (result["agent"], len(result["returns"])) == ("late-ddpg", 2)
    main(["agents"])
    assert "late-ddpg       DDPG whose actor sees the augmented state" in capsys.readouterr().out
    main(["export", "run", "--out", "bundle"])
    history = np.full((3, 1), 0.5, np.float32)
    action = load_bundle("bundle")(np.zeros(4), history, 2)
    policy = delayrl.load("run")
    np.testing.assert_allclose(action, policy.act(np.zeros(4), {"age": 2, "actions": history}), atol=1e-4)


@pytest.mark.thorough
def test_the_blocks(site: Path) -> None:
    """The agent has at most the 60 lines of its heading, and every block of Python that uses it runs."""
    module, *others = blocks((DOCS / "own-agent.md").read_text(), "python")
    others = [block for block in others if not re.match(r"# \w+\.py", block)]  # which have tests of their own
    assert len([line for line in module.splitlines() if line]) <= 60
    assert len(others) == 2
    laws = [block for block in blocks((DOCS / "delays.md").read_text(), "python") if "from my_laws" in block]
    assert len(laws) == 1
    for block in [*others, *laws]:
        exec(block.replace("steps=3000", "steps=1100, evaluation_episodes=2"), {})
    assert {path.parent.name for path in Path("runs").glob("*/*/*")} == {"late-ddpg-small", "Here-small", "bpql-small"}


@pytest.mark.thorough
def test_the_agent_on_top_of_sac(tmp_path: Path, monkeypatch) -> None:
    """Without its weight it is BPQL, to the last bit; with it another agent."""
    page = (DOCS / "own-agent.md").read_text()
    write_module(tmp_path, "smooth", next(block for block in blocks(page, "python") if "# smooth.py" in block))
    monkeypatch.syspath_prepend(str(tmp_path))
    ways = {"bpql": {}, "smooth:ENTRY": {}, "smooth:Smooth": {"smoothness": 0.0}}
    runs = [train(agent, tmp_path / agent, preset="matched", steps=200, **values) for agent, values in ways.items()]
    returns = [[row["return"] for row in run.rows()] for run in runs]
    assert returns[0] == returns[2] != returns[1]


@pytest.mark.thorough
def test_the_agent_on_top_of_vdpo(tmp_path: Path, monkeypatch) -> None:
    """It has VDPO's presets, and learns otherwise."""
    page = (DOCS / "own-agent.md").read_text()
    write_module(tmp_path, "both_ways", next(block for block in blocks(page, "python") if "# both_ways.py" in block))
    monkeypatch.syspath_prepend(str(tmp_path))
    agents = ("vdpo", "both_ways:BothWays")
    runs = [train(agent, tmp_path / agent, preset="matched", steps=200, **OWN["vdpo"]) for agent in agents]
    assert runs[0].config["hyperparameters"] == runs[1].config["hyperparameters"]
    assert runs[0].config["hyperparameters"]["dropout"] == 0
    assert [row["return"] for row in runs[0].rows()] != [row["return"] for row in runs[1].rows()]
