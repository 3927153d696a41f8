"""Large updates keep their memory, and nothing else changes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from delayrl import train
from delayrl.agents import AGENTS
from delayrl.estimate import product_bytes
from delayrl.memory import LARGE
from delayrl.types import Spec

FAULTS = """
import resource, sys
import delayrl.memory
from delayrl.agents import AGENTS
from delayrl.types import Spec
if sys.argv[1] == "kept":
    delayrl.memory.keep_memory(AGENTS["vdpo"].presets["paper"].agent, Spec(17, 6, 5), 1)
import jax, jax.numpy as jnp
large = jax.jit(lambda x: jnp.sort(jnp.outer(x, x), 0).sum(0))
x = jnp.ones(3500)  # 49 MB in between
faults = []
for _ in range(9):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    large(x).block_until_ready()
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(sorted(faults)[4])  # the heap grows now and then
"""


def glibc() -> bool:
    return sys.platform == "linux" and "CS_GNU_LIBC_VERSION" in os.confstr_names


def python(code: str, *args: str) -> str:
    done = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_what_is_large() -> None:
    paper, small = (AGENTS["vdpo"].presets[name].agent for name in ("paper", "small"))
    assert max(product_bytes(paper, Spec(17, 6, 5))) > LARGE
    assert max(product_bytes(small, Spec(17, 6, 5))) < LARGE / 4
    assert max(product_bytes(AGENTS["sac"].presets["paper"].agent, Spec(17, 6, 0))) < LARGE / 4


@pytest.mark.skipif(not glibc(), reason="glibc's allocator")
def test_no_fresh_pages() -> None:
    assert int(python(FAULTS, "plain")) > 5_000
    assert int(python(FAULTS, "kept")) < 500


def test_no_result_changes(tmp_path: Path) -> None:
    words = {"steps": 60, "evaluate_every": 30, "random_steps": 20, "evaluation_episodes": 1, "progress": False}
    code = """
import delayrl.memory, json, sys
delayrl.memory.LARGE = 0
from delayrl import train
train("sac", "Pendulum-v1", preset="small", out=sys.argv[1], **json.loads(sys.argv[2]))
import jax
assert not jax.config.read("jax_cpu_enable_async_dispatch")
"""
    python(code, str(tmp_path / "kept"), json.dumps(words))
    train("sac", "Pendulum-v1", preset="small", out=tmp_path / "plain", **words)
    for pattern in ("rows.jsonl", "checkpoints/*/agent.safetensors"):
        one, other = ([file.read_bytes() for file in (tmp_path / name).glob(pattern)] for name in ("kept", "plain"))
        assert one == other != []
