"""Shapes in annotations are checked while the tests run; compiled code is not optimised, which halves their time."""

import gc
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

from jaxtyping import install_import_hook

install_import_hook(
    [
        "delayrl.core.networks",
        "delayrl.core.transformer",
        "delayrl.core.objectives",
        "delayrl.core.views",
        "delayrl.core.replay",
        "delayrl.agents",
    ],
    "beartype.beartype",
)

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from delayrl.agents.adsac import ADSAC  # noqa: E402
from delayrl.agents.dcac import DCAC  # noqa: E402
from delayrl.agents.dida import DIDA  # noqa: E402
from delayrl.agents.lifting import Lifting  # noqa: E402
from delayrl.agents.sac import BPQL, SAC  # noqa: E402
from delayrl.agents.vdpo import VDPO  # noqa: E402
from delayrl.delays import Delay  # noqa: E402
from delayrl.envs import make  # noqa: E402
from delayrl.run.folder import Run  # noqa: E402
from delayrl.training.actor import Actor  # noqa: E402
from delayrl.training.learner import Learner, Program, Stored  # noqa: E402
from short_runs import train  # noqa: E402

TINY_SAC = SAC(hidden=(16, 16), batch_size=16)
TINY = {
    "sac-memoryless": SAC(actor_sees="delayed", critic_sees="delayed", hidden=(16, 16), batch_size=16),
    "a-sac": SAC(actor_sees="augmented", critic_sees="augmented", hidden=(16, 16), batch_size=16),
    "bpql": SAC(actor_sees="augmented", critic_sees="current", hidden=(16, 16), batch_size=16),
    "lifting": Lifting(replace(BPQL, hidden=(16, 16), batch_size=16, update_every=10, updates=10)),
    "ad-sac": ADSAC(SAC(actor_sees="augmented", critic_sees="augmented", hidden=(16, 16), batch_size=16)),
    "dcac": DCAC(hidden=(16, 16), batch_size=16),
    "dida": DIDA(TINY_SAC, expert_steps=110, round_steps=10, imitation_updates=3, student_hidden=(8, 8)),
    "vdpo": VDPO(TINY_SAC, width=8, layers=2, clone_every=10, clone_updates=3),
}


@pytest.fixture(autouse=True)
def few_memory_maps() -> Iterator[None]:
    """Linux gives a process 65,530 memory maps; each compiled function takes some, and without any XLA crashes."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def vdpo(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A short run."""
    return train("vdpo", tmp_path_factory.mktemp("runs") / "vdpo")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def learned(
    program: Program,
    keys: jax.Array,
    trajectories: list[list],
    random_steps: int,
    *,
    hidden: Callable[[int], int] = lambda step: 0,
    capacity: int = 200,
    block: int = 1,
) -> Iterator[tuple[Learner, dict]]:
    """Learn from one trajectory for each seed as the loop does; yield the learner and its metrics after each block."""
    learner = program.init(keys, capacity)
    for end in range(block, len(trajectories[0]) + 1, block):
        steps = range(end - block + 1, end + 1)
        pending = [[Stored(steps_of[n - 1], np.int32(hidden(n))) for steps_of in trajectories] for n in steps]
        learner, metrics, _ = program.learn(learner, pending, keys, end, random_steps)
        yield learner, metrics


def record(env: str, delay: int | str | Delay, steps: int, seed: int = 0) -> tuple[list, list]:
    """Random play: every transition, and what the wrapper showed before each of its actions."""
    rng = np.random.default_rng(seed)
    actor = Actor(make(env, delay, rescale=True), seed, privileged=False)
    transitions, shown = [], []
    for _ in range(steps):
        shown.append(actor.seen)
        transitions.append(actor.step(rng.uniform(-1, 1, actor.env.action_space.shape).astype(np.float32)))
    return transitions, shown
