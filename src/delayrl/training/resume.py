"""Starting, saving and resuming: run folders on one side, a `TrainState` on the other."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from delayrl.agents.base import Schedule, template
from delayrl.core import replay as ring
from delayrl.core.types import Transition
from delayrl.errors import DelayRLError
from delayrl.run.agents import code_of, warn_of_other_code
from delayrl.run.arrays import Arrays, flatten_tree, load_arrays, restore_tree
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.configuration import OLDER, values_of
from delayrl.run.folder import RunFolder, versions_in
from delayrl.run.provenance import versions
from delayrl.training.actor import Actor
from delayrl.training.cost import cost_of
from delayrl.training.learner import Learner, Stored
from delayrl.training.origin import taken_over
from delayrl.training.recorder import KEPT, evaluators
from delayrl.training.state import Group, TrainState

COLUMNS = ("obs", "action", "reward", "age", "terminated", "moment")
"""The columns of a replay that have one entry for each row."""
COUNTS = ("rows", "steps", "lost")


class Plan(NamedTuple):
    """What to do with the run folders of a group, once nothing can be refused any more."""

    replaced: list[RunFolder]  # to delete
    new: list[RunFolder]  # to create; those to delete too
    longer: list[RunFolder]  # of fewer steps, which go on


def start(group: Group, actors: list[Actor], overwrite: bool, note: Callable[[str], None]) -> TrainState:
    """Create the run folders, or resume from what they hold. `note` takes lines for people.

    Raises:
        DelayRLError: another run or other files in a folder, no common checkpoint, a damaged one.
    """
    plan = _planned(group, overwrite)
    checkpoints = [] if plan.replaced else _common_checkpoints(group, note)
    state = restore(group, actors, checkpoints) if checkpoints else _fresh(group, actors, note)
    config = group.setup.config | {"configuration": group.setup.configuration}
    if plan.longer or not checkpoints:
        config["cost"] = cost_of(group.setup.agent, group.spec, group.setup.schedule).json
    used = versions()
    if code := code_of(config["agent"], group.setup.agent):
        used["agent_code"] = code
    if plan.replaced:  # evaluations may need more environments than can be made
        for evaluator in evaluators(group, state.learner.agent).values():
            evaluator.close()
    for run in plan.replaced:
        run.remove()
    if checkpoints:
        _go_on(group, plan, checkpoints, config, used, note)
        return state
    for run, seed in zip(group.folders, group.seeds, strict=True):  # a run that begins anew keeps nothing
        run.create(config | {"versions": used, "seed": seed})
        run.rewind(-1)
    return state


def _planned(group: Group, overwrite: bool) -> Plan:
    """Decide what to do with the run folders; changes nothing. Raises DelayRLError for what is in the way."""
    there = {run.path: run.config for run in group.folders if run.exists}  # refuses those that cannot be read
    replaced = [run for run in group.folders if overwrite and run.path in there]
    for run, seed in zip(group.folders, group.seeds, strict=True):
        if run.path not in there and not run.is_free:
            what = "not empty and not a run folder" if run.path.is_dir() else "a file"
            raise DelayRLError(f"{run.path} is {what}; give another --out")
        if run.path not in there or run in replaced or group.further:
            continue
        try:
            _check_same(run, group.setup.config | {"seed": seed})
        except DelayRLError:
            if not all(_is_bare(other) for other in group.folders if other.path in there):
                raise
            replaced.append(run)  # another call failed before it stored anything
    new = [run for run in group.folders if run in replaced or run.path not in there]
    steps = group.setup.schedule.steps
    longer = [run for run in group.folders if run not in new and there[run.path]["schedule"]["steps"] != steps]
    return Plan(replaced, new, longer)


def _go_on(
    group: Group,
    plan: Plan,
    checkpoints: list[Checkpoint],
    config: dict[str, Any],
    used: dict[str, Any],
    note: Callable[[str], None],
) -> None:
    """Bring the run folders to their checkpoints, and write down how they go on, with which versions."""
    runs, newest = group.folders, checkpoints[0]
    for run in runs:
        last = max((row["step"] for row in run.read("rows") if row["step"] <= newest.step), default=0)
        if last <= newest.step - group.setup.schedule.evaluate_every:
            line = f"{run.path} has a checkpoint at step {newest.step:,}, and rows up to step {last:,} alone"
            raise DelayRLError(f"{line}: some are lost; --overwrite starts afresh")
    complete = newest.step >= group.setup.schedule.steps
    note(f"{'already complete' if complete else 'resumed'} at step {newest.step:,}: {runs[0].path}")
    warn_of_other_code(runs[0].config, runs[0].path, group.setup.agent)
    for run, checkpoint in zip(runs, checkpoints, strict=True):
        if run in plan.longer:
            run.extend(run.config | config)
        run.rewind(newest.step)
        if complete:
            run.finish(slim=group.ways.slim or not checkpoint.can_go_on)
        elif [used] != (known := versions_in(run.config))[-1:]:
            run.create(run.config | {"later_versions": [*known[1:], used]})


def _fresh(group: Group, actors: list[Actor], note: Callable[[str], None]) -> TrainState:
    """Return the state in which a run begins, with the networks of another run as far as they fit, if there is one."""
    learner = group.program.init(group.keys, group.setup.replay_rows(group.spec))
    if group.source is not None:
        learner = learner._replace(agent=taken_over(learner.agent, group.source, note))
    return _nothing_stored(0, learner, actors)


def _nothing_stored(step: int, learner: Learner, actors: list[Actor]) -> TrainState:
    """Return the state at a step with no file of a replay."""
    return TrainState(step, learner, actors, [], None, [{} for _ in actors], [(0, 0) for _ in actors])


def _common_checkpoints(group: Group, note: Callable[[str], None]) -> list[Checkpoint]:
    """Return the newest checkpoint that all seeds have, for each; an empty list where a run begins.

    Raises:
        DelayRLError: a seed has only broken checkpoints, or the seeds have none in common.
    """
    runs = group.folders
    good, broken = zip(*(run.checkpoints() for run in runs), strict=True)
    for line in chain.from_iterable(broken):
        note(line)
    common = set.intersection(*({checkpoint.step for checkpoint in own} for own in good))
    if common:
        return [next(one for one in own if one.step == max(common)) for own in good]
    _check_may_begin(group, [own[0].step if own else 0 for own in good], broken)
    return []


def _check_may_begin(group: Group, steps: list[int], broken: Sequence[list[str]]) -> None:
    """Raise DelayRLError unless seeds without a common checkpoint may begin anew; `steps` are those of their newest."""
    runs, first, total = group.folders, group.setup.schedule.evaluate_every, group.setup.schedule.steps
    for run, lines, step in zip(runs, broken, steps, strict=True):
        if lines:
            raise DelayRLError(f"{run.path} has no good checkpoint left; --overwrite starts afresh")
        if not step and (last := max((row["step"] for row in run.read("rows")), default=0)) > first:
            raise DelayRLError(f"{run.path} has rows up to step {last:,} and no checkpoint; --overwrite starts afresh")
    stored = {*steps} - {0}
    # a crash between the seeds' first checkpoints leaves some with that one, and others with none
    crashed = all(run.exists for run in runs) and max(steps) <= first and len(stored) == 1
    if not stored or (crashed and not group.further):
        return
    at = ", ".join(f"{run.path} at {step:,}" for run, step in zip(runs, steps, strict=True))
    further = [f"delayrl train {run.path} --steps {total}" for run in runs]
    alone = [f"--out {run.path} --seed {seed}" for run, seed in zip(runs, group.seeds, strict=True)]
    ways = ", ".join(further if group.further else alone)
    raise DelayRLError(f"the seeds stand at different steps ({at}); train each alone ({ways})")


def _is_bare(run: RunFolder) -> bool:
    """Return whether a folder holds a configuration and nothing else that anyone could miss."""
    return all(file.name == "config.json" for file in run.path.rglob("*") if not file.is_dir())


def _check_same(run: RunFolder, wanted: dict[str, Any]) -> None:
    """Raise DelayRLError if a folder holds a run with another configuration."""
    stored = run.config
    added_later = {**values_of(Schedule()), **OLDER, **wanted.get("unnamed", {})}
    if "lengths" in stored.get("origin", {}) and "lengths" not in wanted.get("origin", {}):
        line = f"{run.path} was trained further, to {stored['schedule']['steps']:,} steps"
        raise DelayRLError(f"{line}: `delayrl train {run.path} --steps N` does so again; or give another --out")
    if stored.get("origin", {}) != wanted.get("origin", {}):
        raise DelayRLError(
            f"{run.path} holds a run that began otherwise: with other networks, or shorter; give another --out, or "
            "--overwrite"
        )
    for key, value in wanted.items():
        if isinstance(value, dict):
            known = added_later | stored.get(key, {})
            changed = [name for name in value if known.get(name) != value[name]]
        else:
            changed = [key] if stored.get(key) != value else []
        if changed:
            raise DelayRLError(
                f"{run.path} holds a run with another {', '.join(changed)}; give another --out, or --overwrite"
                + (f" (`delayrl train {run.path} --steps N` trains it further)" if "steps" in changed else "")
            )


def restore(group: Group, actors: list[Actor], checkpoints: list[Checkpoint]) -> TrainState:
    """Return the state in the seeds' checkpoints. Raises DelayRLError if one does not fit, or an episode differs."""
    form = template(group.setup.agent, group.spec)
    states = [restore_tree(form, c.arrays("agent"), c.path) for c in checkpoints]
    agent = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *states)
    step, rows = checkpoints[0].step, group.setup.replay_rows(group.spec)
    shapes = jax.eval_shape(lambda: ring.init(group.spec, rows))
    columns = {name: np.zeros((len(actors), *x.shape), x.dtype) for name, x in shapes._asdict().items()}
    if step >= group.setup.schedule.steps:  # it learns no more, and its replay stays empty
        return _nothing_stored(step, Learner(agent, ring.Replay(**columns)), actors)  # type: ignore[arg-type]
    loops = [checkpoint.arrays("loop") for checkpoint in checkpoints]
    for i, (run, checkpoint, loop) in enumerate(zip(group.folders, checkpoints, loops, strict=True)):
        own = {name: column[i] for name, column in columns.items() if name not in COUNTS}
        for piece in sorted(checkpoint.pieces):
            arrays = load_arrays(run.path / "replay" / piece)
            if any(arrays[name].shape[1:] != own[name].shape[1:] for name in ("obs", "action")):
                raise DelayRLError(f"{run.path} was trained on a task of other sizes than {group.setup.task}")
            _paste(own, arrays)
        for name in COUNTS:
            columns[name][i] = loop[name]
        actor = actors[i]
        actor.replay_episode(int(loop["episode"]), loop["actions"])
        total = loop.get("total", actor.total)  # as exact as the observations, which are in single precision
        if not np.array_equal(actor.truth, loop["truth"]) or not np.isclose(actor.total, total, 1e-5, 1e-5):
            env = group.setup.condition.env
            raise DelayRLError(f"{env} does not repeat an episode from its seed, so the run cannot be resumed")
    replay = ring.Replay(**{name: jnp.asarray(columns.pop(name)) for name in ring.Replay._fields})
    return TrainState(
        step,
        Learner(agent, replay),
        actors,
        [list(seeds) for seeds in zip(*map(_pending, loops), strict=True)],
        np.stack([loop["chosen"] for loop in loops]) if "chosen" in loops[0] else None,
        [dict(checkpoint.pieces) for checkpoint in checkpoints],
        [(int(loop["rows"]), int(loop["steps"])) for loop in loops],
    )


def _pending(loop: Arrays) -> list[Stored]:
    """Return the steps of one seed that its learner had not been given."""
    if "hidden" not in loop:
        return []
    columns = [loop[f"pending.{name}"] for name in Transition._fields]
    steps = zip(*columns, loop["hidden"], strict=True)
    return [Stored(Transition(*values), hidden) for *values, hidden in steps]


def save(group: Group, state: TrainState, *, complete: bool = False) -> TrainState:
    """Write a checkpoint of each seed, of its replay only what is new. Returns the state with what is stored."""
    if state.step == 0:
        return state
    agent = jax.device_get(state.learner.agent)
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(agent) if np.issubdtype(x.dtype, np.floating)):
        raise DelayRLError(f"weights are not finite at step {state.step}: training diverged; {KEPT}")
    pieces, stored = [], []
    for i, run in enumerate(group.folders):
        weights = flatten_tree(jax.tree.map(lambda x, i=i: x[i], agent))
        if complete and group.ways.slim:
            run.save(state.step, weights, None, {}, complete=True)
            continue
        own, until = _save_replay(run, state, i, group.setup.replay_rows(group.spec))
        run.save(state.step, weights, _loop_arrays(group, state, i), own, complete=complete)
        run.drop_pieces()
        pieces.append(own)
        stored.append(until)
    for run in group.folders if complete else []:  # once all seeds have their last checkpoint
        run.finish(slim=group.ways.slim)
    return state if complete else replace(state, pieces=pieces, stored=stored)


def _save_replay(run: RunFolder, state: TrainState, seed: int, capacity: int) -> tuple[dict[str, str], tuple[int, int]]:
    """Write what is new in one seed's replay. Returns the pieces that hold all of it, and up to where."""
    replay = state.learner.replay
    rows, steps = int(replay.rows[seed]), int(replay.steps[seed])
    known_rows, known_steps = state.stored[seed]
    first = max(known_rows, rows - capacity + 1, 0)
    name = f"{first:012d}-{rows:012d}.safetensors"
    pieces = state.pieces[seed] | {name: run.save_piece(name, _cut(replay, seed, first, rows, known_steps, steps))}
    needed = {name: checksum for name, checksum in pieces.items() if int(name[13:25]) > rows - capacity}
    return needed, (rows, steps)


def _loop_arrays(group: Group, state: TrainState, seed: int) -> Arrays:
    """What a resumed run of one seed needs besides its agent and replay."""
    actor, replay = state.actors[seed], state.learner.replay
    arrays: Arrays = {}
    if state.pending:  # where a run was stopped
        steps = [seeds[seed] for seeds in state.pending]
        transitions = jax.tree.map(lambda *x: np.stack(x), *(step.transition for step in steps))
        arrays = {f"pending.{name}": x for name, x in transitions._asdict().items()}
        arrays["hidden"] = np.stack([step.hidden for step in steps])
    if state.actions is not None:
        arrays["chosen"] = np.asarray(state.actions)[seed]
    counts = {name: int(getattr(replay, name)[seed]) for name in COUNTS} | {"episode": actor.episode}
    arrays |= {name: np.asarray(count, np.int32) for name, count in counts.items()}
    actions = np.reshape(actor.actions, (-1, group.spec.action_size))
    return arrays | {"truth": actor.truth, "actions": actions, "total": np.asarray(actor.total, np.float64)}


def _cut(replay: ring.Replay, seed: int, first: int, last: int, first_step: int, steps: int) -> Arrays:
    """Return rows first..last of one seed's ring, and the rows of its steps from `first_step` on."""
    capacity = replay.obs.shape[1]
    rows, numbers = np.arange(first, last + 1), np.arange(max(first_step, steps - capacity), steps)

    def taken(column: Array, index: NDArray[np.int64]) -> NDArray[Any]:
        padded = np.pad(index % capacity, (0, -len(index) % 4096))  # each length is another program
        return np.asarray(column[seed, padded])[: len(index)]

    piece: Arrays = {name: taken(getattr(replay, name), rows) for name in COLUMNS}
    return piece | {"rows": rows, "steps": numbers, "row_of": taken(replay.row_of, numbers)}


def _paste(columns: Arrays, piece: Arrays) -> None:
    """Put a piece back where `_cut` took it from."""
    capacity = len(columns["obs"])
    for name in COLUMNS:
        columns[name][piece["rows"] % capacity] = piece[name]
    columns["row_of"][piece["steps"] % capacity] = piece["row_of"]
