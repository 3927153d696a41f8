"""Check shapes in annotations while the tests run, and keep what JAX compiles for them.

Compiling takes most of the time. Compiled programs are therefore not optimised, and are stored in a folder that all
processes of a test run share and the next run finds. JAX's key to it covers the program, the flags and the versions.
"""

import ctypes
import gc
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

CACHE = Path(__file__).parents[1] / ".cache" / "jax"
CACHE_BYTES = 2**30
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy's threads wait for one another on cores that others use
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

from jaxtyping import install_import_hook  # noqa: E402

install_import_hook(
    [
        "delayrl.core.networks",
        "delayrl.core.transformer",
        "delayrl.core.objectives",
        "delayrl.core.views",
        "delayrl.core.replay",
        "delayrl.agents",
        "delayrl.batched.laws",
        "delayrl.batched.transit",
        "delayrl.batched.episodes",
    ],
    "beartype.beartype",
)

gc.set_threshold(50_000)  # tracing allocates so much that a tenth of the time went into collecting garbage

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from delayrl.agents.adsac import ADSAC  # noqa: E402
from delayrl.agents.any_age import AnyAge  # noqa: E402
from delayrl.agents.dcac import DCAC  # noqa: E402
from delayrl.agents.dida import DIDA  # noqa: E402
from delayrl.agents.lifting import Lifting  # noqa: E402
from delayrl.agents.sac import BPQL, SAC  # noqa: E402
from delayrl.agents.vdpo import VDPO  # noqa: E402
from delayrl.core import replay as ring  # noqa: E402
from delayrl.core.types import Spec, Transition  # noqa: E402
from delayrl.delays import Delay  # noqa: E402
from delayrl.envs.making import make  # noqa: E402
from delayrl.play.run import Run  # noqa: E402
from delayrl.training.actor import Actor  # noqa: E402
from delayrl.training.learner import Learner, Program, Stored  # noqa: E402
from short_runs import train  # noqa: E402

TINY_SAC = SAC(hidden=(16, 16), batch_size=16)
TINY = {
    "sac-memoryless": SAC(actor_sees="delayed", critic_sees="delayed", hidden=(16, 16), batch_size=16),
    "a-sac": SAC(actor_sees="augmented", critic_sees="augmented", hidden=(16, 16), batch_size=16),
    "bpql": SAC(actor_sees="augmented", critic_sees="current", hidden=(16, 16), batch_size=16),
    "any-age": AnyAge(replace(BPQL, hidden=(16, 16), batch_size=16, update_every=1, updates=1, critic_norm="layer")),
    "lifting": Lifting(replace(BPQL, hidden=(16, 16), batch_size=16, update_every=10, updates=10)),
    "ad-sac": ADSAC(SAC(actor_sees="augmented", critic_sees="augmented", hidden=(16, 16), batch_size=16)),
    "dcac": DCAC(hidden=(16, 16), batch_size=16),
    "dida": DIDA(TINY_SAC, expert_steps=110, round_steps=10, imitation_updates=3, student_hidden=(8, 8)),
    "vdpo": VDPO(TINY_SAC, width=8, layers=2, clone_every=10, clone_updates=3),
}


def quick(names: Iterable[str], *kept: str, slow: Iterable[str] = ()) -> list:
    """Return parameters of a test: those that `make test` keeps, and all others marked `slow` or `thorough`."""
    marks = {name: pytest.mark.slow if name in slow else pytest.mark.thorough for name in names}
    return [pytest.param(name, marks=() if name in kept else mark) for name, mark in marks.items()]


def pytest_configure(config: pytest.Config) -> None:
    """Empty the folder of compiled programs when it has grown large: each change of the code adds to it."""
    if not hasattr(config, "workerinput") and sum(file.stat().st_size for file in CACHE.glob("*")) > CACHE_BYTES:
        shutil.rmtree(CACHE, ignore_errors=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the folders that take longest, so that both processes end at about the same time.

    What holds for every agent is tested agent by agent: its programs are dropped only after all that need them.
    """
    items.sort(key=lambda item: item.path.parent.name not in ("agents", "training"))
    shared = [item for item in items if item.path.name == "test_agents.py"]
    by_agent = iter(sorted(shared, key=lambda item: item.callspec.params.get("name", "") if "[" in item.name else ""))
    items[:] = [next(by_agent) if item.path.name == "test_agents.py" else item for item in items]


@pytest.fixture(autouse=True)
def _own_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking for modules in the working folder changes the path for good."""
    monkeypatch.setattr(sys, "path", list(sys.path))


@pytest.fixture(autouse=True)
def little_memory() -> Iterator[None]:
    """Drop compiled programs before they take two gigabytes, or so many of the 65,530 memory maps that XLA crashes."""
    yield
    status, maps = Path("/proc/self/status"), Path("/proc/self/maps")
    if status.exists() and (resident(status) > 2**31 or maps.read_bytes().count(b"\n") > 45_000):
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # compiling leaves hundreds of megabytes that are free, but not given back


def resident(status: Path) -> int:
    """Read how many bytes of memory a process occupies from its status file."""
    return 1024 * int(status.read_text().split("VmRSS:")[1].split()[0])


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


append = jax.jit(ring.append, static_argnames="learnable")
sample = jax.jit(ring.sample, static_argnames=("batch", "delay", "ahead", "learnable"))


def replay_of(
    transitions: Iterable[Transition], spec: Spec, capacity: int, learnable: ring.Learnable = ring.ALL
) -> ring.Replay:
    """A replay that got transitions one by one."""
    replay = ring.init(spec, capacity)
    for transition in transitions:
        replay = append(replay, transition, learnable)
    return replay
