"""Updates keep their memory, and nothing else changes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from delayrl import train
from delayrl.agents.registry import AGENTS
from delayrl.core.types import Spec
from delayrl.training.buffers import LARGE, product_bytes

FAULTS = """
import resource, sys
import delayrl.training.buffers
from delayrl.agents.registry import AGENTS
from delayrl.core.types import Spec
if sys.argv[1] != "plain":
    delayrl.training.buffers.keep_buffers(AGENTS["vdpo"].presets[sys.argv[1]].agent, Spec(17, 6, 5), 1)
import jax, jax.numpy as jnp
large = jax.jit(lambda x: jnp.sin(jnp.outer(x, x)) @ jnp.ones((x.size, 8)))
x = jnp.ones(int(sys.argv[2]))
kept = [jax.jit(jnp.outer)(x, x).block_until_ready() for _ in sys.argv[3:]]
faults = []
for _ in range(30):  # the first on each of JAX's threads has fresh pages
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    large(x).block_until_ready()
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(sorted(faults[-11:])[5])  # the heap grows now and then
"""


def glibc() -> bool:
    """One that can be asked."""
    name, _, version = ((os.confstr("CS_GNU_LIBC_VERSION") or "") if sys.platform == "linux" else "").partition(" ")
    return name == "glibc" and tuple(map(int, version.split("."))) >= (2, 35)


def huge_pages() -> bool:
    setting = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    return setting.exists() and "[always]" in setting.read_text()


def python(code: str, *args: str) -> str:
    done = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_what_is_large() -> None:
    paper, small = (AGENTS["vdpo"].presets[name].agent for name in ("paper", "small"))
    assert max(product_bytes(paper, Spec(17, 6, 5))) > LARGE
    assert max(product_bytes(small, Spec(17, 6, 5))) < LARGE / 2
    assert max(product_bytes(AGENTS["sac"].presets["paper"].agent, Spec(17, 6, 0))) < LARGE / 2
    assert product_bytes(AGENTS["random"].presets["small"].agent, Spec(17, 6, 0)) == []  # it learns nothing


@pytest.mark.thorough
@pytest.mark.skipif(not glibc() or huge_pages(), reason="of glibc 2.35 and newer, with pages of 4 KB")
def test_no_fresh_pages() -> None:
    small, large = "3000", "4500"  # with 36 and 81 MB in between
    assert int(python(FAULTS, "plain", small)) > 5_000
    assert int(python(FAULTS, "small", small)) < 500
    assert int(python(FAULTS, "small", large)) > 5_000  # more than a thread's heap has room for
    assert int(python(FAULTS, "paper", large)) < 500
    assert int(python(FAULTS, "small", small, "kept")) < 500  # a heap that is mapped for the second block stays


@pytest.mark.thorough
@pytest.mark.parametrize("worker", [False, True])
def test_no_result_changes(worker: bool, tmp_path: Path) -> None:
    """Neither of `train` nor of a cell of a grid, whose worker must leave it to `train` to start JAX."""
    words = {"steps": 60, "evaluate_every": 30, "random_steps": 20, "evaluation_episodes": 1}
    condition = {"agent": "sac", "env": "Pendulum-v1", "delay": 0, "preset": "small", "protocol": "corrected"}
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "cell.json").write_text(json.dumps({**condition, "overrides": words, "seeds": [0]}))
    code = """
import json, sys
import delayrl.training.buffers, delayrl.training.train
from jax._src import xla_bridge
delayrl.training.buffers.LARGE = 0
keep = delayrl.training.train.keep_buffers
def first(*args):
    assert not xla_bridge.backends_are_initialized()  # else JAX does not read the setting
    return keep(*args)
delayrl.training.train.keep_buffers = first
import delayrl.bench.worker, pathlib
if sys.argv[3] == "True":
    assert delayrl.bench.worker.work(pathlib.Path(sys.argv[1])).kind == "done"
else:
    delayrl.train("sac", "Pendulum-v1", preset="small", out=sys.argv[1], progress=False, **json.loads(sys.argv[2]))
import jax
print(jax.config.read("jax_cpu_enable_async_dispatch"))
"""
    out = tmp_path / ("cell" if worker else "kept")
    assert python(code, str(out), json.dumps(words), str(worker)) == str(not glibc())
    train("sac", "Pendulum-v1", preset="small", out=tmp_path / "plain", progress=False, **words)
    kept = out / "seed0" if worker else out
    for pattern in ("rows.jsonl", "checkpoints/*/agent.safetensors"):
        found = (sorted(folder.glob(pattern)) for folder in (kept, tmp_path / "plain"))
        one, other = ([file.read_bytes() for file in files] for files in found)
        assert one == other != []
