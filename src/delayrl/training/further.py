"""`go_on`: a run trained further than it was planned."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from delayrl.agents.registry import AGENTS
from delayrl.delays import Delay, stored_delay
from delayrl.envs.task import Task, TaskLike, as_task, stored_task
from delayrl.errors import DelayRLError
from delayrl.play.run import Run
from delayrl.run.agents import AgentLike, find_agent
from delayrl.run.condition import Setup, resolve
from delayrl.run.configuration import OLDER, values_of
from delayrl.run.folder import RunFolder, RunLike, path_of, seed_folders
from delayrl.run.stored import overrides_of
from delayrl.training.state import Callback, Ways
from delayrl.training.train import train_group


def go_on(
    run: RunLike,
    steps: int,
    *,
    env: TaskLike | None = None,
    agent: AgentLike | None = None,
    device: str | None = None,
    track: str | None = None,
    threads: int = 1,
    slim: bool = False,
    callback: Callback | None = None,
    progress: bool = True,
) -> Run | list[Run]:
    """Train a finished or unfinished run further, with its own options, up to more steps.

    Its configuration says from then on how long it was before; its rows are those of one result. All options stay as
    they are, also those whose defaults depend on the length of a run, such as `replay_capacity`. Only any-age's
    annealing, which is in parts of the run, is in parts of the new length.

    Args:
        run: the run folder, or the folder of the run folders of several seeds, which go on in lockstep.
        steps: the new number of environment steps, from the beginning of the run.
        env: what makes the environment, as `load`. It has to be the same task: its keyword arguments and wrappers are
            the run's, and rows go on to name what the run began with.
        agent: the agent, as `load`.
        device: as `train`.
        track: as `train`.
        threads: as `train`.
        slim: as `train`.
        callback: as `train`.
        progress: as `train`.

    Returns:
        The run, or the list of runs if the folder is not a run but holds those of seeds.

    Raises:
        DelayRLError: no run, fewer steps than it has, a run whose replay is gone, and what `train` raises.
        StoppedError: as `train`.
    """
    runs = seed_folders(run)
    configs = [one.config for one in runs]
    for one, config in zip(runs, configs, strict=True):
        if lacks := [name for name in ("protocol", "seed") if name not in config]:
            raise DelayRLError(f"{one.path}/config.json does not say its {' and '.join(lacks)}: the run cannot go on")
    task = stored_task(configs[0]["env"], runs[0].path, env)
    if agent is None:
        agent = str(configs[0]["agent"])
        find_agent(agent, runs[0].path)  # refuses code that came with the folder
    named = as_task(configs[0]["env"])
    moved = ":" in named.env.name or named.env.name.startswith("<")  # code may stand elsewhere now
    name = task.env.name if moved else named.env.name
    if (task.env.name, task.env.kwargs, task.wrappers) != (name, named.env.kwargs, named.wrappers):
        hint = f"--from {runs[0].path} starts a new run with its networks"
        raise DelayRLError(f"a run goes on in its own task, {named}; got {task}: {hint}")
    delay = stored_delay(configs[0]["delay"], runs[0].path)
    setup = setup_of(configs[0], agent, task, delay, steps)
    for one, config in zip(runs, configs, strict=True):
        _check(one, config, configs[0], steps)
    numbers = [config["seed"] for config in configs]
    if len({*numbers}) < len(numbers):
        raise DelayRLError(f"two runs in {path_of(run)} have the same seed; give one of their folders")
    ways = Ways(device=device, track=track, threads=threads, slim=slim, callback=callback, progress=progress)
    train_group(setup, numbers, runs, ways, further=True)
    ended = [Run(one.path) for one in runs]
    return ended[0] if runs[0].path == path_of(run) else ended


def setup_of(config: Mapping[str, Any], agent: AgentLike, task: Task, delay: Delay, steps: int) -> Setup:
    """Return the setup of a run with this configuration that is to have `steps` steps."""
    stored = {**config["hyperparameters"], **config["schedule"]}
    presets = AGENTS[config["agent"]].presets if config["agent"] in AGENTS else {}
    known = {name for part in presets.get(config["preset"], ()) for name in values_of(part)}
    older = {name: value for name, value in OLDER.items() if name in known}
    setup = resolve(agent, task, delay, config["preset"], config["protocol"], {**older, **stored, "steps": steps})
    if setup.config.get("habits", {}) != config.get("habits", {}):
        raise DelayRLError(
            f"the protocol {config['protocol']} of {config['agent']} is another now: the run cannot go on"
        )
    origin = dict(config.get("origin", {}))
    if config["schedule"]["steps"] != steps:
        origin["lengths"] = [*origin.get("lengths", []), config["schedule"]["steps"]]
    unnamed = config.get("unnamed", {})
    for part in ("agent", "env"):
        if part in unnamed and setup.unnamed.get(part, unnamed[part]) != unnamed[part]:
            raise DelayRLError(f"a run goes on with its own {part}; that which is given holds something else")
    setup = replace(setup, origin=origin, unnamed=unnamed)
    names = {"agent": config["agent"], "env": config["env"]}  # its rows name what it began with
    return replace(setup, condition=replace(setup.condition, **names, overrides=overrides_of(setup.config)))


def _check(run: RunFolder, config: Mapping[str, Any], first: Mapping[str, Any], steps: int) -> None:
    """Raise DelayRLError unless a run can go on to `steps` steps beside the first of its group."""
    good, _ = run.checkpoints()
    checkpoint = good[0] if good else run.latest()
    if steps < (least := max(checkpoint.step, config["schedule"]["steps"])):
        raise DelayRLError(f"{run.path} has {least:,} steps; to train it further, give more than that: got {steps:,}")
    if steps > checkpoint.step:
        hint = f"--from {run.path} starts a new run with its networks"
        block = config["schedule"].get("updates_per_call", 1)
        if checkpoint.complete and checkpoint.step % block:  # or evaluating would change what is learned
            raise DelayRLError(f"{run.path} ended within a block of updates_per_call = {block} steps; {hint}")
        if not checkpoint.can_go_on:
            raise DelayRLError(
                f"{run.path} was trained with --slim, or by an older version, and keeps no replay; {hint}"
            )
        try:
            checkpoint.check(replay=True)
        except (OSError, DelayRLError) as error:
            raise DelayRLError(f"{run.path} has lost a part of its replay ({error}); {hint}") from error
    own, firsts = ({**c, "schedule": {**c["schedule"], "steps": steps}} for c in (config, first))
    # a crash may have come between two seeds
    changing = ("seed", "versions", "later_versions", "cost", "origin", "configuration")
    for name in sorted(own.keys() | firsts.keys()):
        if name not in changing and own.get(name) != firsts.get(name):
            raise DelayRLError(f"{run.path} has another {name} than the other seeds; train it alone")
