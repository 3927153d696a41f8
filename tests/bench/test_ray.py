"""Ray: cells on nodes that may die. Skipped where Ray is not installed."""

import math
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from support import assert_same_results, tiny

import delayrl
from delayrl.bench import folders
from delayrl.bench.backends.local import LocalBackend
from delayrl.bench.backends.ray import RayBackend, Supervisor, connect
from delayrl.bench.grid import load_grid
from delayrl.bench.runner import run_cells

try:
    import ray
except ImportError:
    ray = None
needs_ray = pytest.mark.skipif(ray is None, reason="Ray is not installed")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")


def test_without_ray(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(delayrl.DelayRLError, match=r"pip install 'delayrl\[ray\]'"):
        connect(None)


def test_without_an_address_no_other_cluster_is_joined(monkeypatch) -> None:
    """Ray itself would take one that runs on this machine, or that RAY_ADDRESS names: its nodes may see other files."""
    given: list[dict] = []
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=lambda **options: given.append(options)))
    connect(None)
    assert given[0]["address"] == "local"


@needs_ray
@pytest.mark.parametrize(
    ("address", "words"),
    [("nowhere", "HOST:PORT"), ("localhost:0", "no Ray cluster at localhost:0"), ("192.0.2.1:6379", "192.0.2.1:6379")],
)
def test_an_address_that_does_not_answer(address: str, words: str) -> None:
    """It fails with one line, within seconds."""
    began = time.monotonic()
    with pytest.raises(delayrl.DelayRLError, match=words) as error:
        connect(address)
    assert "\n" not in str(error.value)
    assert time.monotonic() - began < 15


@needs_ray
@pytest.mark.slow
def test_an_address_that_is_not_rays(tmp_path: Path) -> None:
    """A server listens there but never answers: the command ends with one line."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        command = [
            sys.executable,
            "-m",
            "delayrl",
            "bench",
            "run",
            str(tiny(tmp_path)),
            "--runs",
            str(tmp_path / "runs"),
        ]
        done = subprocess.run(
            [*command, "--backend", "ray", "--address", address], capture_output=True, text=True, timeout=100
        )
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"delayrl: no Ray cluster at {address}")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(("cpus", "gpus"), [(0.0, 0.0), (-1.0, 0.0), (1.0, -1.0), (1.0, math.nan), (math.inf, 0.0)])
def test_cores_that_cannot_be(cpus: float, gpus: float, tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match="a cell takes cores or GPUs"):
        RayBackend(tmp_path, None, None, cpus, gpus)


@needs_ray
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_more_than_the_cluster_has(tmp_path: Path) -> None:
    """It fails with one line instead of waiting for ever."""
    with pytest.raises(delayrl.DelayRLError, match=r"a cell takes 1 cores and 99 GPUs .* has \d+ and \d+$"):
        RayBackend(tmp_path, None, None, 1.0, 99.0)
    assert not ray.is_initialized()


def test_a_folder_that_the_node_does_not_see(tmp_path: Path) -> None:
    kind, line = Supervisor().run(str(tmp_path / "elsewhere"), None)
    assert kind == "failed"
    assert "the nodes must share it" in line


@needs_ray
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_node_is_killed(tmp_path: Path) -> None:
    """Of two simulated nodes with a core each, one dies: its cell is resumed on the other."""
    from ray.cluster_utils import Cluster

    file = tiny(tmp_path, steps=3000)
    grid, runs, expected = load_grid(file), tmp_path / "runs", tmp_path / "expected"
    run_cells(grid.cells, expected, LocalBackend(expected, 2))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    said: list[str] = []
    killed: list[int] = []

    def kill() -> None:
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline:
            steps = [folders.stored(runs / cell.folder, cell.seeds)[0] for cell in grid.cells]
            if all(0 < step < 3000 for step in steps):
                cluster.remove_node(nodes[1], allow_graceful=False)
                killed.extend(steps)
                return
            time.sleep(0.1)

    thread = threading.Thread(target=kill)
    try:
        backend = RayBackend(runs, cluster.address)
        assert backend.room() == 2
        thread.start()
        completion = run_cells(grid.cells, runs, backend, say=said.append)
    finally:
        thread.join()
        cluster.shutdown()
    assert killed, "both cells were over before a node could be killed"
    assert len(completion.done) == 2
    assert not completion.failed
    assert any("again from step" in line for line in said)
    assert sum(line.startswith("done") for line in said) == 2
    assert_same_results(file, runs, expected)


@needs_ray
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_time_limit(tmp_path: Path) -> None:
    """On a local cluster the cells stop at checkpoints, and nothing is left running."""
    grid, runs = load_grid(tiny(tmp_path, steps=60_000)), tmp_path / "runs"
    completion = run_cells(grid.cells, runs, RayBackend(runs, None), time_limit=40)
    assert len(completion.unfinished) == 2
    last = [folders.journal(runs / cell.folder)[-1]["event"] for cell in grid.cells[:1]]
    assert last == ["stopped"]
    assert all(folders.holder(runs / cell.folder) is None for cell in grid.cells)
