"""Agents of a user are trained, resumed, evaluated, loaded and exported; in grids and from the command line too."""

import inspect
import json
import linecache
import sys
import types
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

import delayrl
import own_agents
from delayrl.agents.registry import AGENTS
from delayrl.agents.sac import SAC
from delayrl.agents.vdpo import VDPO
from delayrl.bench.grid import load_grid
from delayrl.cli.main import main
from delayrl.core.types import Spec
from delayrl.deploy import export_run, load_bundle
from delayrl.errors import DelayRLError, DelayWarning
from delayrl.play.evaluation import evaluate, sweep
from delayrl.play.run import Run
from delayrl.play.video import watch
from delayrl.run.agents import TAKEN, as_agent, code_of, find_agent, known_agents
from delayrl.run.arrays import flatten_tree
from delayrl.run.condition import resolve
from delayrl.run.configuration import values_of
from delayrl.run.stored import overrides_of
from own_agents import Shrink
from own_tasks import Arm, make_arm, write_module
from short_runs import arrays, declare

SHORT: dict[str, Any] = {"steps": 250, "random_steps": 100, "replay_capacity": 100, "evaluate_every": 250}
SHORT |= {"evaluation_episodes": 2, "preset": "small", "progress": False}


def train(agent: Any, out: Path, **values: Any) -> Run:
    return delayrl.train(agent, make_arm, 3, out=out, **{**SHORT, **values})


# ------------------------------------------------------------------------------------------------ with a name


def test_a_run_names_its_agent(tmp_path: Path) -> None:
    """Instance, class and text are one condition; updates at 100, 150, 200 and 250 leave a sixteenth of the weights."""
    run = train(Shrink(width=4), tmp_path / "run")
    assert run.config["agent"] == "own_agents:Shrink"
    assert run.config["hyperparameters"] == {"width": 4, "factor": 0.5, "batch_size": 4}
    assert {row["agent"] for row in run.rows()} == {"own_agents:Shrink"}
    begun = flatten_tree(Shrink(width=4).init(Spec(1, 1, 3), jax.random.key(0)))
    assert float(arrays(run)["updates"]) == 4
    for name in begun.keys() - {"updates"}:
        np.testing.assert_allclose(arrays(run)[name], begun[name] / 16)
    assert train("own_agents:Shrink", tmp_path / "run", width=4).path == run.path
    assert train(Shrink, tmp_path / "run", width=4).path == run.path
    with pytest.raises(DelayRLError, match="holds a run with another width"):
        train(Shrink(width=5), tmp_path / "run")
    ids = [
        resolve(agent, make_arm, 3, "small", "corrected", {}).cell_id([0])
        for agent in (Shrink(width=4), replace(own_agents.WIDE, width=4), Shrink)
    ]
    assert ids[0] == ids[1] != ids[2]
    policy = delayrl.load(run.path)
    assert policy.agent == Shrink(width=4)
    assert len(evaluate(run.path, 2)["returns"]) == 2


def test_code_that_has_changed_is_told(tmp_path: Path, monkeypatch) -> None:
    """An agent's file is edited after a run: nothing of the run's configuration shows it."""
    text = Path(own_agents.__file__).read_text()
    write_module(tmp_path, "edited", text)
    monkeypatch.syspath_prepend(str(tmp_path))
    run = train("edited:Shrink", tmp_path / "run")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluate(run.path, 1)
        train("edited:Shrink", tmp_path / "run")
    for line in ("# one line\n", "# another\n"):
        write_module(tmp_path, "edited", text + line)
        for what in (lambda: evaluate(run.path, 1), lambda: train("edited:Shrink", tmp_path / "run")):
            with pytest.warns(DelayWarning, match="the code of edited:Shrink has changed since .*run was trained"):
                what()


def test_a_run_is_played_by_the_agent_of_its_length(tmp_path: Path) -> None:
    run = train("own_agents:Growing", tmp_path / "run")
    assert delayrl.load(run.path).agent == own_agents.Growing(units=5)
    assert len(evaluate(run.path, 2)["returns"]) == 2


def test_an_instance_and_presets_by_name(tmp_path: Path) -> None:
    """The name of an instance stands for it; those of a `Registration` are its presets."""
    setup = resolve("own_agents:DELAYED", make_arm, 3, "paper", "corrected", {"factor": 1})
    assert setup.agent == replace(own_agents.DELAYED, factor=1.0)
    assert setup.config["agent"] == "own_agents:DELAYED"
    assert resolve("own_agents:ENTRY", make_arm, 3, "tiny", "corrected", {}).schedule.steps == 120
    with pytest.raises(DelayRLError, match="unknown preset 'small' of own_agents:ENTRY; there are tiny"):
        resolve("own_agents:ENTRY", make_arm, 3, "small", "corrected", {})
    with pytest.raises(DelayRLError, match="own_agents:BARE has no preset"):
        find_agent("own_agents:BARE")
    usual, small = find_agent("own_agents:WIDE").presets["matched"], AGENTS["bpql"].presets["small"]
    assert usual == (own_agents.WIDE, AGENTS["bpql"].presets["matched"].schedule)
    assert find_agent("own_agents:WIDE").presets["small"].schedule == small.schedule


@dataclass(frozen=True)
class Wide(VDPO):
    """VDPO with a field of its own, and another default."""

    width: Annotated[int, "embedding dimension of the transformer"] = 512
    extra: Annotated[float, "more"] = 0.5


@dataclass(frozen=True)
class Late(SAC):
    """SAC that acts as BPQL's."""

    actor_sees: str = "augmented"


def test_a_class_that_derives_from_ours_has_its_presets() -> None:
    """Its own fields keep their values, and an instance all of them."""
    for preset in ("paper", "matched", "small"):
        ours = AGENTS["vdpo"].presets[preset]
        of_wide = as_agent(Wide).registration.presets[preset]
        assert of_wide.schedule == ours.schedule
        assert values_of(of_wide.agent) == values_of(ours.agent) | {"width": 512, "extra": 0.5}
        assert as_agent(Wide()).registration.presets[preset].agent == Wide()
        of_late = as_agent(Late).registration.presets[preset].agent
        assert isinstance(of_late, Late)
        assert values_of(of_late) == values_of(AGENTS["sac"].presets[preset].agent)
        assert of_late.actor_sees == "augmented"
        assert as_agent(VDPO).registration.presets[preset].agent == ours.agent
    for given in (Wide, Wide()):
        assert as_agent(given).registration.official == AGENTS["vdpo"].official


@dataclass(frozen=True)
class Large(SAC):
    """Refuses the batch of a preset."""

    def __post_init__(self) -> None:
        if self.batch_size < 200:
            raise ValueError("too small")


class Bare(VDPO):
    width: Annotated[int, "of no dataclass, and so without effect"] = 32


def test_a_class_that_does_not_take_our_values_has_its_own() -> None:
    """One that refuses a value has presets that set the schedule alone; one that is no dataclass declares nothing."""
    entry = as_agent(Large).registration
    assert [preset.agent for preset in entry.presets.values()] == [Large()] * 3
    assert entry.official == AGENTS["sac"].official
    widths = [preset.agent.width for preset in as_agent(Bare).registration.presets.values()]
    assert widths == [preset.agent.width for preset in AGENTS["vdpo"].presets.values()]


def test_a_run_does_not_go_on_under_other_rules(tmp_path: Path) -> None:
    run = train("random", tmp_path, protocol="official")
    changed = run.config | {"habits": run.config["habits"] | {"time_limit": "dropped"}}
    (run.path / "config.json").write_text(json.dumps(changed))
    with pytest.raises(DelayRLError, match="the protocol official of random is another now: the run cannot go on"):
        delayrl.go_on(run, 400, progress=False)


def test_the_command_line_takes_a_preset_that_there_is(capsys) -> None:
    """Without `paper` among an agent's presets, its first is the default."""
    with pytest.raises(SystemExit):
        main(["train", "own_agents:ENTRY", "--help"])
    assert "(default: tiny)" in capsys.readouterr().out


def test_an_agent_without_a_name_is_given_again(tmp_path: Path, capsys) -> None:
    """Also one whose class and options do not make it again: here `sees` is no option."""
    run = train(own_agents.DELAYED, tmp_path / "run", width=4)
    assert run.config["agent"] == "<Shrink>"
    assert train(own_agents.DELAYED, tmp_path / "run", width=4).path == run.path
    for call in (delayrl.load, evaluate, lambda path: list(sweep(path)), lambda path: export_run(path, tmp_path / "b")):
        with pytest.raises(DelayRLError, match="<Shrink> has no name that it could be imported by: give it again, as"):
            call(run.path)
    policy = delayrl.load(run.path, agent=own_agents.DELAYED)
    assert policy.agent == replace(own_agents.DELAYED, width=4)
    returns = evaluate(run.path, 2, agent=own_agents.DELAYED)["returns"]
    assert next(iter(sweep(run.path, 2, agent=own_agents.DELAYED)))["episodes"] == 2
    main(["evaluate", str(run.path), "--episodes", "2", "--json", "--agent", "own_agents:DELAYED"])
    assert json.loads(capsys.readouterr().out)["returns"] == returns
    metadata = export_run(run.path, tmp_path / "bundle", agent=own_agents.DELAYED)
    assert metadata["agent"] == "<Shrink>"
    info = {"age": 1, "actions": np.full((3, 1), 0.5)}
    action = load_bundle(tmp_path / "bundle")(np.ones(1), info["actions"], 1)
    np.testing.assert_allclose(action, policy.act(np.ones(1), info), atol=1e-6)


class Drawn(Arm):
    """An arm with a picture."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # Gymnasium's own form

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__()
        self.render_mode = render_mode

    def render(self) -> np.ndarray:
        return np.zeros((240, 240, 3), np.uint8)


def drawn_arm(**kwargs: Any) -> TimeLimit:
    return TimeLimit(Drawn(**kwargs), 5)


def test_a_video_of_an_agent_without_a_name(tmp_path: Path) -> None:
    """Beside another agent, which is what its own run says."""
    own, other = (
        delayrl.train(agent, drawn_arm, 3, out=tmp_path / name, **SHORT)
        for agent, name in ((own_agents.DELAYED, "own"), ("random", "other"))
    )
    with pytest.raises(DelayRLError, match="<Shrink> has no name"):
        watch(own.path, tmp_path / "one.gif", env=drawn_arm)
    given = {"env": drawn_arm, "agent": own_agents.DELAYED}
    moments = watch(own.path, tmp_path / "two.gif", compare=other.path, **given)
    assert [moment.step for moment in moments] == [5, 5]


def test_from_the_command_line(tmp_path: Path, monkeypatch, capsys) -> None:
    """Its hyperparameters are options with their help; the default folder has a name that any system takes."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["train", "own_agents:Shrink", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "Shrinks its actor by `factor` at each update." in out
    assert "--factor VALUE what weights are multiplied by (default: 0.5)" in out
    words = ["--env", "own_tasks:make_arm", "--delay", "3", "--preset", "small", "--quiet", "--width", "4"]
    words += [f"--{name.replace('_', '-')}={value}" for name, value in SHORT.items() if isinstance(value, int)][:5]
    main(["train", "own_agents:Shrink", *words])
    (run,) = Path("runs").glob("*/*/*")
    assert str(run) == "runs/own_tasks-make_arm-delay3/own_agents-Shrink-small/seed0"
    assert Run(run).config["hyperparameters"]["width"] == 4


def test_in_a_grid(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("""
agents = ["own_agents:Shrink", "random"]
tasks = ["own_tasks:make_arm"]
delays = [3]
preset = "small"
[overrides]
width = 5
[overrides."own_agents:Shrink"]
factor = 0.25
""")
    own, random = load_grid(file).cells
    assert own.condition.overrides == {"width": 5, "factor": 0.25}
    assert random.condition.overrides == {}
    assert own.id == resolve(Shrink(5, 0.25), make_arm, 3, "small", "corrected", {}).cell_id([0])
    file.write_text(file.read_text().replace("factor", "fractor"))
    with pytest.raises(DelayRLError, match="unknown hyperparameter 'fractor'; did you mean factor"):
        load_grid(file)


# ------------------------------------------------------------------------------------------------ entry points


def test_entry_points_are_names(tmp_path: Path, monkeypatch, capsys) -> None:
    """One agent has one name, however it is given; one that cannot be loaded is listed with the reason."""
    declare(tmp_path, "delayrl.agents", shrink="own_agents:Shrink", gone="own_agents:Gone", sac="own_agents:Shrink")
    monkeypatch.syspath_prepend(tmp_path)
    for agent in ("shrink", "own_agents:Shrink", Shrink, Shrink(width=4)):
        assert as_agent(agent).name == "shrink"
    assert find_agent("shrink").presets["small"].agent == Shrink()
    assert find_agent("sac") is AGENTS["sac"]
    assert [*known_agents()] == [*AGENTS, "gone", "shrink"]
    main(["agents"])
    lines = capsys.readouterr().out.splitlines()
    assert "gone            cannot be loaded: module 'own_agents' has no 'Gone'" in " ".join(lines)
    assert any(line.startswith("shrink ") and "Shrinks its actor" in line for line in lines)
    with pytest.raises(DelayRLError, match="unknown agent 'shrnik'; did you mean shrink"):
        find_agent("shrnik")
    line = "unknown agent 'nowhere'; `delayrl agents` lists them; one of your own is MODULE:NAME, and a run is named by"
    with pytest.raises(DelayRLError, match=f"^{line} its folder$"):
        find_agent("nowhere")
    with pytest.raises(DelayRLError, match=r"^an agent is a name .*, MODULE:NAME, a class or an instance; got None$"):
        as_agent(None)  # type: ignore[arg-type]
    with pytest.raises(DelayRLError, match=r"got Registration\(.{60,80}: name its variable, as text$"):
        as_agent(own_agents.ENTRY)  # type: ignore[arg-type]
    (tmp_path / "shrink").mkdir()
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path)
    for word, line in (
        ("shrink", "--env"),  # the agent, although there is a folder
        ("./own_agents.py:Shrink", "a module is named as in an import, such as own_agents; got './own_agents.py'"),
        ("./runs", "there is no run folder ./runs; `delayrl runs` lists the runs below runs/"),
    ):
        with pytest.raises(SystemExit):
            main(["train", word])
        assert line in capsys.readouterr().err
    config = resolve("shrink", make_arm, 3, "small", "corrected", {"width": 3}).config
    assert overrides_of(json.loads(json.dumps(config))) == {"width": 3}


# ------------------------------------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("own_agents:make", "own_agents:make is no agent, because it is no dataclass"),
        ("own_agents:Shrunk", "module 'own_agents' has no 'Shrunk'; did you mean Shrink"),
        ("own_agents:Half", "because it lacks ahead, phases, init, act, deterministic"),
        ("own_agents:Needy", "fields need defaults: TypeError: .*'width'"),
        ("own_agents:Thawed", "must be a frozen dataclass, with tuples for lists: TypeError: unhashable"),
        ("own_agents:Steps", "has an option steps, as every run has"),
        ("own_agents:Twice", "has two options factor with different values, and one name sets both"),
        ("own_agents:Wordy", "name must be a number; got 'me'"),
        ("not_there:Agent", "cannot import 'not_there': ModuleNotFoundError"),
        ("os:system", "os:system is no agent"),
    ],
)
def test_what_is_no_agent(name: str, words: str) -> None:
    with pytest.raises(DelayRLError, match=words) as error:
        find_agent(name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("type", r"keeps the types of its state: updates was float32\[\], and is int32\[\]"),
        ("shape", r"updates was float32\[\], and is float32\[2\]"),
        ("more", "with the arrays of its init; not so updates"),
        ("key", "holds a random key, updates: store jax.random.key_data of it"),
        ("names", r"two arrays of the agent's state would be stored as updates.a.b"),
        ("step", "names of their own; got step, which every run has"),
        ("metric", r"are single numbers .* got rewards, of shape \(5,\)"),
        ("none", "returns the new state and a dict of metrics"),
        ("act", r"act returns an action of shape \(1,\); got \(1, 1\)"),
        ("phase", r"returns a tuple of Phase; of one, as \(Phase"),
        ("every", "every of an agent's phase are at least 1"),
    ],
)
def test_what_a_run_could_not_keep_is_refused_before_it(how: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DelayRLError, match=words):
        train(own_agents.Spoiled(how=how), tmp_path / "run")  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


def test_two_agents_without_a_name_are_two_runs(tmp_path: Path) -> None:
    """What is no option of theirs tells them apart, also where the run goes on."""

    @dataclass(frozen=True)
    class Local(Shrink):
        level: float = 0.5

    run = train(Local(level=0.3), tmp_path / "run")
    assert train(Local(level=0.3), tmp_path / "run").rows() == run.rows()
    with pytest.raises(DelayRLError, match="holds a run with another agent"):
        train(Local(level=0.9), tmp_path / "run")
    with pytest.raises(DelayRLError, match="a run goes on with its own agent"):
        delayrl.go_on(run, 300, agent=Local(level=0.9), env=make_arm, progress=False)
    longer = delayrl.go_on(run, 300, agent=Local(level=0.3), env=make_arm, progress=False)
    assert longer.config["unnamed"] == run.config["unnamed"]


def test_an_option_of_the_command_is_refused(capsys) -> None:
    """In Python an instance may have it, and its runs are read."""
    with pytest.raises(SystemExit):
        main(["train", "own_agents:Quiet", "--env", "Reacher-v5"])
    line = "delayrl: the agent has an option --quiet, as the command has: give it another name\n"
    assert capsys.readouterr().err == line
    assert find_agent("own_agents:Quiet").presets


def test_no_option_is_named_as_a_parameter_of_train() -> None:
    """`train(agent, env, delay=2)` would take it for its own, and so would a cell of a grid with that override."""
    assert {*inspect.signature(delayrl.train).parameters} - {"values"} == TAKEN
    ours = {name for known in AGENTS.values() for preset in known.presets.values() for name in values_of(preset.agent)}
    assert not ours & TAKEN
    with pytest.raises(DelayRLError, match="own_agents:Progress has an option progress, and so has"):
        resolve("own_agents:Progress", make_arm, 3, "small", "corrected", {})
    assert find_agent("own_agents:Progress").presets  # an older run of it is read


NOTEBOOK = """
from dataclasses import dataclass
import base_of_notebook, own_agents

@dataclass(frozen=True)
class Mine(base_of_notebook.Base):
    def update(self, state, windows, key, count):
        return state, {"factor": FACTOR}
"""


def test_code_of_bases_parts_and_notebooks_counts(tmp_path: Path, monkeypatch) -> None:
    """A class of a notebook has no file, but its functions have a source; its bases are in modules."""
    base = tmp_path / "base_of_notebook.py"
    base.write_text("import own_agents\nclass Base(own_agents.Shrink):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "notebook_cell", types.ModuleType("notebook_cell"))

    def code(factor: str) -> str | None:
        source = NOTEBOOK.replace("FACTOR", factor)
        monkeypatch.setitem(linecache.cache, "<cell>", (len(source), None, source.splitlines(keepends=True), "<cell>"))
        names = sys.modules["notebook_cell"].__dict__
        exec(compile(source, "<cell>", "exec"), names)
        return code_of("<Mine>", names["Mine"]())

    first = code("1.0")
    assert code("1.0") == first is not None
    assert code("2.0") != first
    base.write_text(base.read_text() + "    level: float = 0.5\n")
    assert code("1.0") != first
    assert code_of("bpql", AGENTS["bpql"].presets["small"].agent) is None


def test_an_option_with_a_percent_sign(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["train", "own_agents:Percent", "--help"])
    assert "% of all, 5 %s (default: 3)" in " ".join(capsys.readouterr().out.split())


# ------------------------------------------------------------------------------------------------ stored runs


def test_code_that_came_with_a_run_is_not_imported(tmp_path: Path, monkeypatch) -> None:
    """Nor is anything imported because rows of a report name it; whoever means it gives the agent."""
    monkeypatch.chdir(tmp_path)
    run = train(Shrink, Path("runs/mine"))
    witness = tmp_path / "witness"
    write_module(
        tmp_path / "runs",
        "evil",
        f"from pathlib import Path\nPath({str(witness)!r}).touch()\nfrom own_agents import Shrink",
    )
    for name in ("runs.evil:Shrink", "os:system", "pathlib:Path"):
        config = {**run.config, "agent": name}
        (run.path / "config.json").write_text(json.dumps(config))
        assert overrides_of(config) == {}
        with pytest.raises(DelayRLError, match=r"came with an agent that could run any code|is no agent"):
            delayrl.load(run.path)
        assert delayrl.load(run.path, agent=Shrink).agent == Shrink()
    assert not witness.exists()
    with pytest.raises(DelayRLError, match="unknown hyperparameter 'width'"):
        delayrl.load(run.path, agent="bpql")
