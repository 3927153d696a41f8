"""Imports go one way and never in a circle, what must be light is light, and files stay readable."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import delayrl

SOURCE = Path(delayrl.__file__).parent
ROOMS = "errors lookup delays wrappers batched envs core agents run play training report bench measure deploy cli "
ROOMS += "__init__ __main__"
"""Folders and files at the top, lowest first: each imports only what stands before it."""
ROOM = {name: place for place, name in enumerate(ROOMS.split())}
LIGHT = (
    "lookup",
    "wrappers",
    "delays",
    "deploy.runtime.controller",
    "deploy.adapter",
    "bench.folders",
    "cli.main",
    "run.checkpoint",
)


def modules() -> dict[str, Path]:
    """Our modules by name, below `delayrl`."""
    return {".".join(file.relative_to(SOURCE).with_suffix("").parts): file for file in SOURCE.rglob("*.py")}


def imports(file: Path, known: set[str]) -> set[str]:
    """Modules of ours that a file imports, wherever it does so."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = [name.split(".")[1:] for name in names if name.startswith("delayrl.")]
    return {module for part in parts if (module := nearest(part, known))}


def nearest(part: list[str], known: set[str]) -> str | None:
    """The module that a dotted name is of, or is in."""
    for end in range(len(part), 0, -1):
        for name in (".".join(part[:end]), ".".join([*part[:end], "__init__"])):
            if name in known:
                return name
    return None


def graph() -> dict[str, set[str]]:
    """What each module imports."""
    files = modules()
    return {name: imports(file, set(files)) - {name} for name, file in files.items()}


def room(module: str) -> str:
    return module.split(".")[0]


def arrows(imported: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Which room imports from which."""
    pairs = {(room(module), room(other)) for module, others in imported.items() for other in others}
    return {(one, other) for one, other in pairs if one != other}


def assert_one_way(imported: dict[str, set[str]]) -> None:
    """Rooms import downwards only, and modules not in a circle, those of one room included."""
    for one, other in sorted(arrows(imported)):
        assert ROOM[other] < ROOM[one], f"{one} imports {other}"
    list(graphlib.TopologicalSorter(imported).static_order())


def test_imports_go_one_way() -> None:
    assert {room(module) for module in modules()} == set(ROOM)
    assert_one_way(graph())


@pytest.mark.parametrize(
    "circle", [{"cli.main": {"cli.bench"}, "cli.bench": {"cli.main"}}, {"run.folder": {"bench.grid"}}]
)
def test_a_circle_is_noticed(circle: dict[str, set[str]]) -> None:
    broken = {name: others | circle.get(name, set()) for name, others in graph().items()}
    with pytest.raises((graphlib.CycleError, AssertionError)):
        assert_one_way(broken)


def test_few_rooms_and_arrows() -> None:
    assert len(ROOM) <= 18
    assert len(arrows(graph())) <= 68


def test_agents_know_no_environment_replay_or_loop() -> None:
    for name, others in graph().items():
        if room(name) == "agents":
            assert not {room(other) for other in others} & {"envs", "wrappers", "run", "play", "training"}, name
            assert "core.replay" not in others, name


def test_loop_names_no_algorithm() -> None:
    agents = ("vdpo", "bpql", "dcac", "dida", "adsac", "lifting", "anyage", "any_age")
    for file in [*(SOURCE / "training").glob("*.py"), SOURCE / "core/replay.py", SOURCE / "play/evaluation.py"]:
        code = [line for line in file.read_text().lower().splitlines() if "preset" not in line]
        assert not [agent for agent in agents if agent in "\n".join(code)], file


def test_files_stay_readable() -> None:
    for name, file in modules().items():
        text = file.read_text()
        assert len(text.splitlines()) <= (260 if room(name) == "agents" else 350), name
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef):
                assert node.end_lineno - node.lineno < 170, f"{name}: {node.name}"


def test_sac_is_read_in_one_sitting() -> None:
    """From its configuration to its gradient, the loop included."""
    path = "run/configuration run/condition agents/registry agents/base agents/sac core/protocol core/types core/views "
    path += "core/replay core/networks core/objectives training/train training/state training/actor training/learner "
    path += "training/loop"
    assert sum(len((SOURCE / f"{name}.py").read_text().splitlines()) for name in path.split()) <= 2000


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import delayrl", {"gymnasium", "jax", "numpy"}),
        ("; ".join(f"import delayrl.{name}" for name in LIGHT), {"jax"}),
        ("import delayrl.deploy", {"gymnasium", "jax", "mujoco"}),
        ("import delayrl.measure", {"jax", "matplotlib", "mujoco", "pyarrow"}),
        ("import delayrl, delayrl.wrappers; delayrl.make('Pendulum-v1', 2)", {"jax"}),
        ("from delayrl.envs import paper; paper.register()", {"jax", "mujoco"}),
        ("from delayrl.cli.main import main; main(['--help'])", {"jax"}),
    ],
)
def test_what_is_light_imports_nothing_heavy(code: str, heavy: set[str]) -> None:
    """In a process of its own, where nothing is imported yet; `--help` leaves it."""
    program = f"import sys\ntry: {code}\nfinally: assert not (found := {heavy} & sys.modules.keys()), found"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_architecture_page_names_what_exists() -> None:
    page = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text()
    names = re.findall(r"`([\w/]+\.py):([\w.]+)`", page)
    assert len(names) > 20
    for file, dotted in names:
        body: list[ast.stmt] = ast.parse((SOURCE / file).read_text()).body
        for name in dotted.split("."):
            defined = [node for node in body if getattr(node, "name", None) == name]
            assert defined, f"{file} defines no {dotted}"
            body = getattr(defined[0], "body", [])
    for folder in re.findall(r"^\| `(\w+)` \|", page.split("## Five values")[0], re.MULTILINE):
        assert folder in ROOM
    assert f"`{'`, `'.join(ROOMS.split()[:-2])}`" in " ".join(page.split())
