"""`train`: from what the user gave to a finished run."""

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from tqdm import tqdm

from delayrl.agents.base import PRODUCTS, State, template
from delayrl.delays import DelayLike, in_other_unit
from delayrl.envs.making import make, seconds_of
from delayrl.envs.task import TaskLike, WrapperLike, as_task
from delayrl.errors import DelayRLError
from delayrl.play.evaluation import check_seed
from delayrl.play.policy import spec_of
from delayrl.run.agents import AgentLike
from delayrl.run.condition import Condition, Setup, resolve
from delayrl.run.folder import Run
from delayrl.training.actor import Actor
from delayrl.training.buffers import keep_buffers
from delayrl.training.learner import compiled
from delayrl.training.loop import run
from delayrl.training.resume import start
from delayrl.training.state import Group
from delayrl.wrappers import Delayed
from delayrl.wrappers.single import limit_of


def train(
    agent: AgentLike,
    env: TaskLike,
    delay: DelayLike = 0,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[WrapperLike] = (),
    flatten: bool = False,
    preset: str = "paper",
    seed: int = 0,
    seeds: int | Sequence[int] = 1,
    out: str | Path | None = None,
    device: str | None = None,
    overwrite: bool = False,
    protocol: str = "corrected",
    track: str | None = None,
    threads: int = 1,
    progress: bool = True,
    **values: Any,
) -> Any:
    """Train an agent. The same call resumes an unfinished run, and returns a finished one.

    Args:
        agent: its name (`delayrl agents`), `module:object`, or a class or instance of your own (docs/own-agent.md).
        env: id of a Gymnasium task (`delayrl tasks`), `module:object`, a spec, or a class or function that makes an
            environment.
        delay: environment steps, or a text such as "uniform:1:5@fifo" or "80ms+action=2" (`delayrl.delays`).
        env_kwargs: keyword arguments of the environment. With `wrappers` and `flatten` they are part of its name.
        wrappers: as `make`.
        flatten: as `make`.
        preset: "paper" or "small": which hyperparameters to start from.
        seed: fixes everything: environments, networks, sampling.
        seeds: trains the seeds seed .. seed + seeds - 1 in lockstep, or those of a list.
        out: the run folder; with several seeds the folder of their run folders.
        device: "cpu" or "gpu"; None leaves the choice to JAX.
        overwrite: start afresh where a run exists.
        protocol: "corrected", or "official": the released code's habits (docs/concepts.md).
        track: "tensorboard" or "wandb" as well (extras of the same names).
        threads: threads that step the environments, of training and of evaluation. The results do not depend on it.
        progress: show a progress bar and notes on stderr.
        **values: any hyperparameter or schedule option by name.

    Returns:
        The run, or the list of runs if `seeds` is above 1 or a list.

    Raises:
        DelayRLError: bad input, a damaged run, NaN from the environment, a full disk.
    """
    setup = resolve(agent, as_task(env, env_kwargs, wrappers, flatten), delay, preset, protocol, values)
    if threads < 1:
        raise DelayRLError(f"threads must be at least 1; got {threads}")
    numbers = seed_numbers(seed, seeds)
    runs = run_folders(setup.condition, numbers, out)
    observed = setup.delay.observed()
    envs = [make(setup.task, observed, rescale=True) for _ in numbers]
    spec = spec_of(envs[0])
    shapes = check_fit(setup, envs[0])  # before anything is stored
    if device != "gpu":
        keep_buffers(setup.agent, spec, len(numbers))  # before JAX looks for its devices
    precision = PRODUCTS[setup.schedule.precision]
    with ThreadPoolExecutor(threads) as pool, on_device(device), jax.default_matmul_precision(precision):
        privileged, rules = setup.agent.privileged, setup.protocol
        actors = [Actor(task, number, privileged, rules) for task, number in zip(envs, numbers, strict=True)]
        keys = jax.vmap(jax.random.key)(jnp.asarray(numbers))
        program = compiled(setup.agent, spec, setup.learnable(spec))
        group = Group(setup, numbers, runs, keys, spec, shapes, program, pool.map if threads > 1 else map)

        def note(line: str) -> None:
            if progress:
                tqdm.write(line, file=sys.stderr)

        if setup.delay.maximum and (seconds := seconds_of(envs[0])):
            note(f"delay: {in_other_unit(delay, setup.delay, seconds)}")
        run(group, start(group, actors, overwrite, note), note, progress=progress, track=track)
    return runs[0] if seeds == 1 else runs


def seed_numbers(seed: int, seeds: int | Sequence[int]) -> list[int]:
    """Return the seeds to train: `seeds` many from `seed` on, or those listed. Raises DelayRLError for bad ones."""
    if isinstance(seeds, int):
        if seeds < 1:
            raise DelayRLError(f"seeds must be at least 1; got {seeds}")
        numbers = list(range(seed, seed + seeds))
    else:
        numbers = list(seeds)
        different = len(set(numbers)) == len(numbers) and all(isinstance(number, int) for number in numbers)
        if seed or not numbers or not different:
            raise DelayRLError(f"seeds is a number, or a list of different seeds without seed=; got {seeds!r}")
    check_seed(min(numbers))
    check_seed(max(numbers))
    return numbers


def run_folders(condition: Condition, seeds: list[int], out: str | Path | None) -> list[Run]:
    """Return the run folder of each seed: below `out`, or where it is None below runs/."""
    kind = f"{condition.agent.strip('<>')}-{condition.preset}"
    if condition.protocol != "corrected":
        kind += f"-{condition.protocol}"
    task, kind = (re.sub(r"[^\w.=+@-]+", "-", name) for name in (condition.place, kind))
    home = Path(out) if out is not None else Path("runs") / task / kind
    if out is not None and len(seeds) == 1:
        return [Run(home)]
    return [Run(home / f"seed{seed}") for seed in seeds]


def check_fit(setup: Setup, env: Delayed) -> State:
    """Return the shapes and types of the agent's state. Raises DelayRLError if it does not fit schedule and task."""
    agent, schedule, spec = setup.agent, setup.schedule, spec_of(env)
    least = 2 * (spec.delay + agent.ahead(spec)) + 2
    for name, count in (("replay_capacity", least * setup.entries(spec)), ("random_steps", least)):
        if getattr(schedule, name) < count:
            raise DelayRLError(f"{name} must be at least {count} here; got {getattr(schedule, name)}")
    first = min((-(-schedule.first_update // phase.every) * phase.every for phase in agent.phases()), default=0)
    if first > schedule.steps:
        start = "a smaller update_after" if schedule.update_after else "fewer random_steps"
        raise DelayRLError(
            f"nothing would be learned: the first update is at step {first:,}, and the run ends at step "
            f"{schedule.steps:,}; give more steps, {start}, or preset small"
        )
    every, block = schedule.evaluate_every, schedule.updates_per_call
    if every % block:  # or evaluating would change what is learned
        raise DelayRLError(f"evaluate_every must be a multiple of updates_per_call; got {every} and {block}")
    if limit_of(env) is None:
        hint = "add the wrapper 'gymnasium.wrappers:TimeLimit(max_episode_steps=1000)'"
        raise DelayRLError(f"{setup.task} has no time limit, so evaluation may never end; {hint}")
    return template(agent, spec)


@contextmanager
def on_device(name: str | None) -> Iterator[None]:
    """Run on "cpu" or "gpu"; None leaves the choice to JAX."""
    if name is None:
        yield
        return
    if name not in ("cpu", "gpu"):
        raise DelayRLError(f"device must be cpu or gpu; got {name!r}")
    try:
        device = jax.devices(name)[0]
    except RuntimeError as error:
        hint = "`pip install 'delayrl[cuda]'` brings CUDA, or use --device cpu"
        raise DelayRLError(f"JAX finds no {name}; {hint}") from error
    with jax.default_device(device):
        yield
