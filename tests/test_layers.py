"""Imports go one way, and what must be light is light."""

import ast
from pathlib import Path

import delayrl

SOURCE = Path(delayrl.__file__).parent
ORDER = [
    "errors",
    "delays wrappers envs",
    "measure",
    "deploy.statistics deploy.history deploy.network",
    "deploy.controller deploy.files deploy.numpy_policy",
    "deploy.onnx_graph deploy.onnx_policy deploy.hub",
    "types config",
    "views networks replay provenance",
    "objectives transformer",
    "deploy.jax_policy",
    "deploy.bundle",
    "agents.base",
    "agents",
    "runs plots tracking",
    "policy",
    "evaluation deploy.export deploy.latency",
    "deploy",
    "acting learning estimate",
    "memory",
    "training video",
    "experiments experiments.statistics experiments.folders",
    "experiments.summary",
    "experiments.figures",
    "experiments.report",
    "experiments.grid experiments.worker",
    "experiments.status experiments.runner",
    "experiments.results experiments.slurm experiments.cluster",
    "cli experiments.cli",
    "__main__",
]
LAYER = {name: i for i, names in enumerate(ORDER) for name in names.split()}


def imports(file: Path) -> set[str]:
    """Modules of ours that a file imports, wherever it does so."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.removeprefix("delayrl.") for name in found if name.startswith("delayrl.")}


def layer(module: str) -> int | None:
    parts = module.split(".")
    return next((LAYER[m] for m in (".".join(parts[:2]), parts[0]) if m in LAYER), None)


def test_imports_go_one_way() -> None:
    for file in SOURCE.rglob("*.py"):
        module = ".".join(file.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")
        if module == "__init__":
            continue
        own = layer(module)
        assert own is not None, f"{module} has no place in ORDER"
        for name in imports(file):
            other = layer(name)
            if other is not None:
                assert other <= own, f"{module} imports {name}"


def test_agents_know_no_environment_replay_or_loop() -> None:
    for file in (SOURCE / "agents").glob("*.py"):
        forbidden = {"envs", "wrappers", "replay", "acting", "learning", "training", "evaluation", "runs"}
        assert not {name.split(".")[0] for name in imports(file)} & forbidden, file


def test_loop_names_no_algorithm() -> None:
    for name in ("acting", "learning", "training", "evaluation", "replay"):
        words = (SOURCE / f"{name}.py").read_text().lower()
        assert not [agent for agent in ("vdpo", "bpql", "dcac", "dida", "adsac", "lifting") if agent in words]


def test_files_stay_readable() -> None:
    for file in (SOURCE / "agents").glob("*.py"):
        assert len(file.read_text().splitlines()) <= 260, file
    path = ["config", "agents/__init__", "agents/base", "agents/sac", "types", "views", "replay", "networks"]
    path += ["objectives", "acting", "learning"]  # SAC from its configuration to its gradient
    assert sum(len((SOURCE / f"{name}.py").read_text().splitlines()) for name in path) <= 1200
