"""`train`: from what the user gave to a finished run."""

import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import jax
import jax.numpy as jnp
from tqdm import tqdm

from delayrl.core.cache import keep_compiled
from delayrl.core.precision import setting
from delayrl.delays import DelayLike, in_other_unit
from delayrl.envs.making import make, seconds_of
from delayrl.envs.task import TaskLike, WrapperLike, as_task, closing_quietly
from delayrl.play.policy import spec_of
from delayrl.play.run import Run
from delayrl.run.agents import AgentLike
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.condition import Setup, resolve
from delayrl.run.folder import RunFolder, RunLike, hold, path_of
from delayrl.training.actor import Actor
from delayrl.training.buffers import keep_buffers, on_device
from delayrl.training.checks import check_agent, check_fit, check_memory, check_repeats, check_ways
from delayrl.training.learner import compiled
from delayrl.training.loop import run
from delayrl.training.machine import shared
from delayrl.training.origin import source_of
from delayrl.training.resume import start
from delayrl.training.seeds import Seeds, run_folders, seed_numbers
from delayrl.training.signals import stop_signal
from delayrl.training.state import Callback, Group, Ways


@overload
def train(
    agent: AgentLike,
    env: TaskLike,
    delay: DelayLike = ...,
    *,
    env_kwargs: Mapping[str, Any] | None = ...,
    wrappers: WrapperLike | Sequence[WrapperLike] = ...,
    flatten: bool = ...,
    preset: str = ...,
    seed: int = ...,
    seeds: None = ...,
    out: str | Path | None = ...,
    device: str | None = ...,
    overwrite: bool = ...,
    protocol: str = ...,
    track: str | None = ...,
    threads: int = ...,
    slim: bool = ...,
    start_from: RunLike | None = ...,
    callback: Callback | None = ...,
    progress: bool = ...,
    **values: Any,
) -> Run: ...
@overload
def train(agent: AgentLike, env: TaskLike, delay: DelayLike = ..., *, seeds: Seeds, **more: Any) -> list[Run]: ...
def train(
    agent: AgentLike,
    env: TaskLike,
    delay: DelayLike = 0,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: WrapperLike | Sequence[WrapperLike] = (),
    flatten: bool = False,
    preset: str = "paper",
    seed: int = 0,
    seeds: Seeds | None = None,
    out: str | Path | None = None,
    device: str | None = None,
    overwrite: bool = False,
    protocol: str = "corrected",
    track: str | None = None,
    threads: int = 1,
    slim: bool = False,
    start_from: RunLike | None = None,
    callback: Callback | None = None,
    progress: bool = True,
    **values: Any,
) -> Run | list[Run]:
    """Train an agent. The same call resumes an unfinished run, and returns a finished one.

    Args:
        agent: its name (`delayrl agents`), `module:object`, or a class or instance of your own (docs/own-agent.md).
        env: id of a Gymnasium task (`delayrl tasks`), `module:object`, a spec, or a class or function that makes an
            environment.
        delay: environment steps, or a text such as "uniform:1:5@fifo" or "80ms+action=2" (`delayrl.delays`).
        env_kwargs: keyword arguments of the environment. With `wrappers` and `flatten` they are part of its name.
        wrappers: as `make`.
        flatten: as `make`.
        preset: "paper", "matched" or "small": which hyperparameters to start from (docs/cli.md).
        seed: fixes everything: environments, networks, sampling.
        seeds: a number N trains the seeds seed .. seed + N - 1 in lockstep, a list those in it; None trains one.
        out: the run folder of one seed; of several seeds the folder of their run folders.
        device: "cpu" or "gpu"; None leaves the choice to JAX.
        overwrite: start afresh where a run exists.
        protocol: "corrected", or "official": the released code's habits (docs/protocols.md).
        track: "tensorboard" or "wandb" as well (extras of the same names).
        threads: threads that step the environments, of training and of evaluation. The results do not depend on it.
        slim: keep of a finished run only its last networks, and not what `go_on` takes (the replay).
        start_from: the folder of another run, whose networks training begins with, as far as they fit: another delay,
            another task of the same spaces, other options. Optimisers and replay are new.
        callback: called with the step and the list of runs after each evaluation, once it is stored. If it returns
            something true, training ends there; the same call goes on.
        progress: show a progress bar and notes on stderr.
        **values: any hyperparameter or schedule option by name.

    Returns:
        The run, or the list of runs if `seeds` is given.

    Raises:
        DelayRLError: bad input, a damaged run, NaN from the environment, a full disk; a StoppedError after Ctrl-C.
    """
    setup = resolve(agent, as_task(env, env_kwargs, wrappers, flatten), delay, preset, protocol, values)
    numbers = seed_numbers(seed, seeds)
    folders = run_folders(setup.condition, numbers, out)
    source = None
    if start_from is not None:
        origin, source = source_of(RunFolder(path_of(start_from)), [] if overwrite else folders)
        setup = replace(setup, origin={"from": origin})
    ways = Ways(device=device, track=track, threads=threads, slim=slim, callback=callback, progress=progress)
    train_group(setup, numbers, folders, ways, given=delay, overwrite=overwrite, source=source)
    runs = [Run(folder.path) for folder in folders]
    return runs[0] if seeds is None else runs


def train_group(
    setup: Setup,
    numbers: list[int],
    folders: list[RunFolder],
    ways: Ways,
    *,
    given: DelayLike | None = None,
    overwrite: bool = False,
    source: Checkpoint | None = None,
    further: bool = False,
) -> None:
    """Train seeds in lockstep, each in its folder, from where it stands; `given` is the delay as the user wrote it."""
    check_ways(ways)
    with ExitStack() as held:
        made = (make(setup.task, setup.delay.observed(), rescale=True) for _ in numbers)
        envs = [held.enter_context(closing_quietly(env)) for env in made]
        spec = spec_of(envs[0])
        check_fit(setup, envs[0])  # before anything is stored
        check_agent(setup.agent, spec)
        check_memory(setup, spec, len(numbers), ways.device)
        keep_compiled()
        if ways.device != "gpu":
            keep_buffers(setup.agent, spec, len(numbers))  # before JAX looks for its devices
        stop = held.enter_context(stop_signal())
        for folder in folders:
            held.enter_context(hold(folder.path))
        pool = held.enter_context(ThreadPoolExecutor(ways.threads))
        held.enter_context(on_device(ways.device))
        held.enter_context(jax.default_matmul_precision(setting(setup.schedule.precision)))
        privileged, rules = setup.agent.privileged, setup.protocol
        actors = [Actor(task, number, privileged, rules) for task, number in zip(envs, numbers, strict=True)]
        keys = jax.vmap(jax.random.key)(jnp.asarray(numbers))
        program = compiled(setup.agent, spec, setup.learnable(spec))
        apply = pool.map if ways.threads > 1 else map
        group = Group(setup, numbers, folders, keys, spec, program, ways, apply, source, further)

        def note(line: str) -> None:
            if ways.progress:
                tqdm.write(line, file=sys.stderr)

        if given is not None and not setup.delay.latest:
            note("delay: none")
        elif given is not None and setup.delay.maximum and (seconds := seconds_of(envs[0])):
            note(f"delay: {in_other_unit(given, setup.delay, seconds)}")
        state = start(group, actors, overwrite, note)
        if state.step == 0:
            check_repeats(setup)
            if line := shared(len(numbers), ways.device):
                note(line)
        run(group, state, note, stop.is_set)
