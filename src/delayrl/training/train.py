"""The loop: act, store, learn, evaluate, record. No algorithm's name is in it.

All seeds run in lockstep: agent states and replays have a leading seed axis, each seed has its own environment and
random stream. Everything random is a function of (seed, step), so that a checkpoint needs no generator's state, and an
environment is restored by playing its current episode again. While the environments simulate step t, the device learns
from the steps before it.
"""

import difflib
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from delayrl.agents.base import PRODUCTS, Agent, Schedule, State, template
from delayrl.agents.registry import AGENTS
from delayrl.core import replay as ring
from delayrl.core.types import Metrics, Spec, Transition
from delayrl.delays import Delay, as_delay
from delayrl.envs import delay_of, make, physics
from delayrl.errors import DelayRLError, StoppedError
from delayrl.play.evaluation import EVALUATION, RANDOM_ACTIONS, Evaluator, check_seed, reset_seed
from delayrl.play.plots import curve
from delayrl.play.policy import spec_of
from delayrl.run.configuration import check_names, override, values_of
from delayrl.run.folder import Arrays, Checkpoint, Run, flatten_tree, load_arrays, restore_tree
from delayrl.run.provenance import versions
from delayrl.training.actor import Actor
from delayrl.training.buffers import keep_memory
from delayrl.training.estimate import estimate_seconds
from delayrl.training.learner import Stored, compiled
from delayrl.training.tracking import Tracker
from delayrl.wrappers import Delayed

Note = Callable[[str], None]
METRICS_EVERY = 1000
KEPT = "the last good checkpoint is kept"


def train(
    agent: str,
    env: str,
    delay: int | str | Delay = 0,
    *,
    preset: str = "paper",
    seed: int = 0,
    seeds: int = 1,
    out: str | Path | None = None,
    device: str | None = None,
    overwrite: bool = False,
    protocol: str = "corrected",
    track: str | None = None,
    threads: int = 1,
    progress: bool = True,
    **values: Any,
) -> Any:
    """Train an agent; the same call on an unfinished run resumes it, on a finished one gives it back.

    Args:
        agent: its name in the registry (`delayrl agents`).
        env: id of a Gymnasium task (`delayrl tasks`).
        delay: environment steps, or a text such as "uniform:1:5@fifo" or "80ms+action=2" (`delayrl.delays`).
        preset: "paper" or "small": which hyperparameters to start from.
        seed: fixes everything: environments, networks, sampling.
        seeds: trains the seeds seed .. seed + seeds - 1 in lockstep.
        out: the run folder; with several seeds the folder of their run folders.
        device: "cpu" or "gpu"; None leaves the choice to JAX.
        overwrite: start afresh where a run exists.
        protocol: "corrected", or "official": the released code's habits (docs/concepts.md).
        track: "tensorboard" or "wandb" as well (extras of the same names).
        threads: that step the environments, those of the seeds and of evaluation, where simulating is slow. Changes no
            result.
        progress: show a progress bar and notes on stderr.
        **values: any hyperparameter or schedule option by name.

    Returns:
        The run, or the list of runs where `seeds` > 1.

    Raises:
        DelayRLError: bad input, a damaged run, NaN from the environment, a full disk.
    """
    config, schedule = resolve(agent, preset, protocol, values)
    if seeds < 1:
        raise DelayRLError(f"seeds must be at least 1; got {seeds}")
    if threads < 1:
        raise DelayRLError(f"threads must be at least 1; got {threads}")
    check_seed(seed)
    check_seed(seed + seeds - 1)
    kind = f"{agent}-{preset}" if protocol == "corrected" else f"{agent}-{preset}-{protocol}"
    late = delay_of(env, delay)
    if as_delay(late.plain()) != late:
        raise DelayRLError(
            f"a run keeps its delay as text, and {str(late)[:60]!r} cannot be read back: use delayrl.delays"
        )
    folder = re.sub(r"[^\w.=+@-]+", "-", f"{env}-delay{late.label()}")
    group = Path(out) if out is not None else Path("runs") / folder / kind
    single_home = group if out is not None else group / f"seed{seed}"
    runs = [Run(single_home if seeds == 1 else group / f"seed{seed + i}") for i in range(seeds)]

    note: Note = (lambda line: tqdm.write(line, file=sys.stderr)) if progress else (lambda line: None)
    official = protocol == "official"
    whole = config.ahead if official and find_agent(agent).drops_last_starts else None
    numbers = [seed + i for i in range(seeds)]
    with ThreadPoolExecutor(threads) as pool:
        session = Session(config, schedule, env, late, numbers, official, whole, pool.map if threads > 1 else map)
        if device != "gpu":
            keep_memory(config, session.spec, seeds)  # before the device is looked for
        description = {
            "agent": agent,
            "preset": preset,
            "env": env,
            "delay": late.plain(),
            "protocol": protocol,
            "privileged": config.privileged,
            "hyperparameters": values_of(config),
            "schedule": values_of(schedule),
        }
        with on_device(device), jax.default_matmul_precision(PRODUCTS[schedule.precision]):
            session.open(runs, description, overwrite, note)
            session.run(note, progress, track)
    return runs[0] if seeds == 1 else runs


class Session:
    """One call of `train`: the seeds' environments and learners, and where they are written.

    No device is touched before `open`.
    """

    def __init__(
        self,
        agent: Agent,
        schedule: Schedule,
        env: str,
        delay: Delay,
        seeds: list[int],
        official: bool = False,
        whole: Callable[[Spec], int] | None = None,
        apply: Callable[..., Iterator[Any]] = map,
    ):
        self.agent, self.schedule, self.env, self.delay, self.seeds = agent, schedule, env, delay, seeds
        self.official, self.apply = official, apply
        self.actors = [
            Actor(make(env, delay.observed(), rescale=True), seed, agent.privileged, official) for seed in seeds
        ]
        self.spec = spec_of(self.actors[0].env)
        self.physics = physics(self.actors[0].env)
        self.template = check_fit(agent, schedule, self.actors[0].env)  # before anything is stored
        self.program = compiled(agent, self.spec, whole(self.spec) if whole else 1)
        self.step, self.learning = 0, False
        self.pending: list[Stored] = []  # the newest steps, which the learners have not been given yet
        self.chosen: Any = None  # the next actions, where they have been chosen already
        self.stored: list[dict[str, str]] = [{} for _ in seeds]
        self.stored_until = [(0, 0) for _ in seeds]  # rows and steps of the replay that are in its pieces

    # -- the run folders -------------------------------------------------------------------------------------------

    def open(self, runs: list[Run], description: dict[str, Any], overwrite: bool, note: Note) -> None:
        """Create the folders, or resume what is there."""
        self.runs, self.description = runs, description
        self.keys = jax.vmap(jax.random.key)(jnp.asarray(self.seeds))
        ours = [run for run in runs if overwrite and (run.path / "config.json").exists() and run.config]
        for run in ours:
            run.remove()
        for actor in self.actors:
            actor.reset()
        for run, seed in zip(runs, self.seeds, strict=True):
            if (run.path / "config.json").exists():
                self._check_same(run, description | {"seed": seed})
            elif run not in ours and not run.is_free():
                raise DelayRLError(f"{run.path} is not empty and not a run folder; give another --out")
        found = [run.checkpoints() for run in runs]
        for line in (line for _, broken in found for line in broken):
            note(line)
        if any(good for good, _ in found) and not all(good for good, _ in found):
            behind = [str(run.path) for run, (good, _) in zip(runs, found, strict=True) if not good]
            if any(len(good) > 1 or (good and good[0].complete) for good, _ in found):
                raise DelayRLError(f"{', '.join(behind)} cannot go on beside the other seeds; train those seeds alone")
        for run, seed in zip(runs, self.seeds, strict=True):
            if not (run.path / "config.json").exists():
                run.create(description | {"seed": seed, "versions": versions()})
        self.learner = self.program.init(self.keys, self.schedule.replay_capacity)
        common = set.intersection(*({c.step for c in good} for good, _ in found))
        if not common:
            for (_, broken), run in zip(found, runs, strict=True):
                if broken:
                    raise DelayRLError(f"{run.path} has no good checkpoint left; --overwrite starts afresh")
                run.rewind(-1)
            return
        step = max(common)
        chosen = [next(c for c in good if c.step == step) for good, _ in found]
        note(f"{'found complete' if chosen[0].complete else 'resumed'} at step {step:,}: {runs[0].path}")
        self._restore(chosen)
        for run, checkpoint in zip(runs, chosen, strict=True):
            run.rewind(step)
            if checkpoint.complete:
                run.finish()

    @staticmethod
    def _check_same(run: Run, wanted: dict[str, Any]) -> None:
        have = run.config
        for key, value in wanted.items():
            if isinstance(value, dict):
                unsaid = values_of(Schedule()) if key == "schedule" else {}
                changed = [k for k in value if have[key].get(k, unsaid.get(k)) != value[k]]
            else:
                changed = [key] if have.get(key) != value else []
            if changed:
                raise DelayRLError(
                    f"{run.path} holds a run with another {', '.join(changed)}; give another --out, or --overwrite"
                )

    def _restore(self, checkpoints: list[Checkpoint]) -> None:
        self.step = checkpoints[0].step
        states = [restore_tree(self.template, c.arrays("agent"), c.path) for c in checkpoints]
        self.learner = self.learner._replace(
            agent=jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *states)
        )
        if checkpoints[0].complete:
            return
        replays, pending, chosen = [], [], []
        for i, (run, checkpoint) in enumerate(zip(self.runs, checkpoints, strict=True)):
            loop = checkpoint.arrays("loop")
            columns = {name: np.array(column[i]) for name, column in self.learner.replay._asdict().items()}
            for piece in sorted(checkpoint.pieces):
                _paste(columns, load_arrays(run.path / "replay" / piece))
            for name in ("rows", "steps", "lost"):
                columns[name] = loop[name]
            replays.append(ring.Replay(**columns))  # type: ignore[arg-type]
            self.stored[i], self.stored_until[i] = dict(checkpoint.pieces), (int(loop["rows"]), int(loop["steps"]))
            kept = [loop[f"pending.{name}"] for name in Transition._fields if f"pending.{name}" in loop]
            pending += [Stored(Transition(*kept), loop["hidden"])] if kept else []  # type: ignore[arg-type]
            chosen += [loop["chosen"]] if "chosen" in loop else []
            self.actors[i].replay_episode(int(loop["episode"]), loop["actions"])
            if not np.array_equal(self.actors[i].truth, loop["truth"]):
                raise DelayRLError(f"{self.env} does not repeat an episode from its seed, so the run cannot be resumed")
        self.learner = self.learner._replace(replay=jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *replays))
        for j in range(len(pending[0].hidden) if pending else 0):
            self.pending.append(jax.tree.map(lambda *x, j=j: np.stack([y[j] for y in x]), *pending))
        self.chosen = np.stack(chosen) if chosen else None

    def save(self, *, complete: bool = False) -> None:
        """Write each seed's checkpoint; of the replay only what is new."""
        if self.step == 0:
            return
        agent = jax.device_get(self.learner.agent)
        if not all(np.isfinite(x).all() for x in jax.tree.leaves(agent) if np.issubdtype(x.dtype, np.floating)):
            raise DelayRLError(f"weights are not finite at step {self.step}: training diverged; {KEPT}")
        for i, (run, actor) in enumerate(zip(self.runs, self.actors, strict=True)):
            mine = flatten_tree(jax.tree.map(lambda x, i=i: x[i], agent))
            if complete:
                run.save(self.step, mine, None, {}, complete=True)
                continue
            replay = self.learner.replay
            rows, steps, lost = (int(x[i]) for x in (replay.rows, replay.steps, replay.lost))
            known_rows, known_steps = self.stored_until[i]
            first = max(known_rows, rows - self.schedule.replay_capacity + 1, 0)
            name = f"{first:012d}-{rows:012d}.safetensors"
            self.stored[i][name] = run.save_piece(name, _cut(replay, i, first, rows, known_steps, steps))
            self.stored_until[i] = rows, steps
            alive = rows - self.schedule.replay_capacity
            self.stored[i] = {n: d for n, d in self.stored[i].items() if int(n[13:25]) > alive}
            loop: Arrays = {}
            if self.pending:  # where a run was stopped
                left = jax.tree.map(lambda *x, i=i: np.stack([y[i] for y in x]), *self.pending)
                loop = {f"pending.{name}": x for name, x in left.transition._asdict().items()} | {"hidden": left.hidden}
            loop |= {} if self.chosen is None else {"chosen": np.asarray(self.chosen)[i]}
            counts = {"rows": rows, "steps": steps, "lost": lost, "episode": actor.episode}
            loop |= {n: np.asarray(x, np.int32) for n, x in counts.items()}
            loop |= {"truth": actor.truth, "actions": np.reshape(actor.actions, (-1, self.spec.action_size))}
            run.save(self.step, mine, {n: np.asarray(x) for n, x in loop.items()}, self.stored[i])
            run.drop_pieces()
        for run in self.runs if complete else []:  # once all seeds have their last checkpoint
            run.finish()

    # -- the loop --------------------------------------------------------------------------------------------------

    def run(self, note: Note, progress: bool, track: str | None) -> None:
        """Train to the end, or until the process is asked to stop."""
        schedule = self.schedule
        if self.step >= schedule.steps:
            self._draw()
            return
        evaluator = self._evaluators()
        trackers = [Tracker(track, run.path) for run in self.runs]
        began, began_step, metrics = time.perf_counter(), self.step, dict[str, Any]()
        note(f"estimate: {self._estimate()}") if progress else None
        with (
            stop_signal() as stop,
            tqdm(
                total=schedule.steps,
                initial=self.step,
                unit="step",
                disable=not progress,
                smoothing=0.05,
                dynamic_ncols=True,
                mininterval=0.5 if sys.stderr.isatty() else 30,
            ) as bar,
        ):
            while self.step < schedule.steps and not stop.is_set():
                self._choose()
                if len(self.pending) == schedule.updates_per_call:
                    metrics |= self._learn()
                actions, self.chosen = np.asarray(self.chosen), None
                steps = list(self.apply(Actor.step, self.actors, actions))
                self.pending.append(Stored(jax.tree.map(lambda *x: np.stack(x), *steps), self._hidden()))
                self.step += 1
                bar.update(1)
                if self.step % METRICS_EVERY == 0:
                    speed = (self.step - began_step) / (time.perf_counter() - began)
                    self._log(metrics, speed, trackers)
                if self.step % schedule.evaluate_every == 0 or self.step == schedule.steps:
                    self._choose()  # as without an evaluation
                    metrics |= self._learn()  # what is evaluated has learned from every step before
                    bar.set_postfix_str(self._evaluate(evaluator, trackers))
                    self.save(complete=self.step == schedule.steps)
            if stop.is_set() and self.step < schedule.steps:
                self.save()
                raise StoppedError(f"stopped at step {self.step:,}; the same command goes on from there")
        self._draw()

    def _draw(self) -> None:
        for run in self.runs:
            curve(run.read("rows"), run.path / "curve.png")

    def _choose(self) -> None:
        """Have the next actions chosen, by what was learned until now. Not waited for."""
        if self.chosen is not None:
            return
        if self.step < self.schedule.random_steps:
            self.chosen = self._random()
            return
        seen = jax.tree.map(lambda *x: np.stack(x), *[actor.seen for actor in self.actors])
        self.chosen = self.program.act(self.learner.agent, seen, self.keys, self.step)
        if self.official and self.spec.delay:  # its first action under delay is random
            first = np.array([[not actor.actions] for actor in self.actors])
            self.chosen = np.where(first, self._random(), self.chosen)

    def _learn(self) -> Metrics:
        """Hand the newest steps to the learners, and have them learn what is due. Not waited for."""
        if not self.pending:
            return {}
        steps = range(self.step - len(self.pending) + 1, self.step + 1)
        due = [self.program.due(step, self.schedule) for step in steps]
        pending, self.pending = self.pending, []
        self.learner, new = self.program.learn(self.learner, pending, self.keys, steps, due)
        if any(due) and not self.learning:
            self.learning = True
            if int(self.learner.replay.steps.min()) < self.spec.delay + 1:  # the first block's own steps count too
                raise DelayRLError(f"no episode of {self.env} is long enough to learn from under this protocol")
        return new

    def _random(self) -> NDArray[np.float32]:
        draws = [np.random.default_rng([seed, RANDOM_ACTIONS, self.step]) for seed in self.seeds]
        return np.stack([draw.uniform(-1, 1, self.spec.action_size).astype(np.float32) for draw in draws])

    def _hidden(self) -> NDArray[np.int32]:
        """How many of the newest steps each seed's learner may not look at, because not all of them have arrived.

        Of what is older than the longest delay everything has, even what was overtaken.
        """
        late = self.delay
        longest = late.action.maximum + max(late.observation.maximum, late.reward.maximum)
        longest = 0 if self.agent.privileged else longest
        return np.array([min(len(actor.actions), longest) for actor in self.actors], np.int32)

    def _evaluators(self) -> dict[str, Evaluator]:
        count, episodes = len(self.seeds), self.schedule.evaluation_episodes
        evaluators = {"agent": Evaluator(self.agent, self.spec, self.env, self.delay, count, episodes, self.apply)}
        if inner := self.agent.reference_policy(self.learner.agent):
            spec = Spec(self.spec.obs_size, self.spec.action_size, 0)
            evaluators["reference"] = Evaluator(inner[0], spec, self.env, 0, count, episodes, self.apply)
        return evaluators

    def _evaluate(self, evaluators: dict[str, Evaluator], trackers: list[Tracker]) -> str:
        states = {"agent": self.learner.agent}
        if inner := self.agent.reference_policy(self.learner.agent):
            states["reference"] = inner[1]
        summary = []
        episodes = range(self.schedule.evaluation_episodes)
        seeds = [[reset_seed(seed, EVALUATION, self.step, e) for e in episodes] for seed in self.seeds]
        first, travel = None, seeds
        if self.official:  # one start state for all episodes, and a random first action under delay
            draw = [
                [np.random.default_rng(number).uniform(-1, 1, self.spec.action_size) for number in s] for s in seeds
            ]
            first, seeds = np.array(draw, np.float32), [[seed] * len(episodes) for seed in self.seeds]
        keys = jax.vmap(lambda key: jax.random.fold_in(key, self.step))(self.keys)
        for policy, evaluator in evaluators.items():
            played = evaluator(
                states[policy], seeds, keys, first if policy == "agent" and self.spec.delay else None, travel
            )
            summary.append(f"{policy} {played.returns.mean():.4g}")
            for i, (run, tracker) in enumerate(zip(self.runs, trackers, strict=True)):
                run.append("rows", [self._row(i, policy, e, seeds[i][e], played) for e in episodes])
                tracker.write(self.step, {f"return/{policy}": float(played.returns[i].mean())})
        return " · ".join(summary)

    def _row(self, i: int, policy: str, episode: int, reset: int, played: Any) -> dict[str, Any]:
        names = ("agent", "env", "delay", "preset", "protocol", "privileged")
        return {name: self.description[name] for name in names} | {
            "delay": self.delay.label(),
            "seed": self.seeds[i],
            "step": self.step,
            "policy": policy,
            "episode": episode,
            "reset_seed": reset,
            "return": float(played.returns[i, episode]),
            "length": int(played.lengths[i, episode]),
            **self.physics,
        }

    def _log(self, metrics: Metrics, speed: float, trackers: list[Tracker]) -> None:
        values = jax.device_get(metrics)
        for i, (run, tracker) in enumerate(zip(self.runs, trackers, strict=True)):
            mine = {name: float(x[i]) for name, x in values.items()}
            for name, x in mine.items():
                if not np.isfinite(x):
                    raise DelayRLError(
                        f"{name} is {x} at step {self.step} of seed {self.seeds[i]}: training diverged; {KEPT}"
                    )
            run.append("metrics", [{"step": self.step, "steps_per_second": round(speed, 2), **mine}])
            tracker.write(self.step, mine | {"steps_per_second": speed})

    def _estimate(self) -> str:
        hours = estimate_seconds(self.program, self.learner, self.agent, self.spec, self.schedule, self.step) / 3600
        steps = f"for {self.schedule.steps - self.step:,} steps on this device"
        if hours < 0.5:
            return f"about {max(1, round(hours * 60))} min {steps}"
        advice = "; --preset small takes minutes" if self.description["preset"] == "paper" else ""
        return f"about {hours:.1f} h {steps}{advice}"


def find_agent(name: str) -> Any:
    """The agent's line in the registry; DelayRLError with the nearest names."""
    if name not in AGENTS:
        near = difflib.get_close_matches(name, AGENTS, n=2, cutoff=0.4) or AGENTS
        raise DelayRLError(f"unknown agent {name!r}; did you mean {', '.join(near)}?")
    return AGENTS[name]


def resolve(agent: str, preset: str, protocol: str, values: Mapping[str, Any]) -> tuple[Agent, Schedule]:
    """The hyperparameters and the schedule that a name, a preset, a protocol and some values stand for."""
    entry = find_agent(agent)
    if preset not in entry.presets:
        raise DelayRLError(f"unknown preset {preset!r} of {agent}; there are {', '.join(entry.presets)}")
    if protocol not in ("corrected", "official"):
        raise DelayRLError(f"protocol must be corrected or official; got {protocol!r}")
    base = entry.presets[preset]
    check_names(values, base.agent, base.schedule)
    values = (dict(entry.official) if protocol == "official" else {}) | dict(values)
    return override(base.agent, values), override(base.schedule, values)


def check_fit(agent: Agent, schedule: Schedule, env: Delayed) -> State:
    """DelayRLError where agent, schedule and delayed task do not fit; shapes and types of the agent's state."""
    spec, task = spec_of(env), env.spec
    least = 2 * (spec.delay + agent.ahead(spec)) + 2
    if schedule.replay_capacity < least:
        raise DelayRLError(f"replay_capacity must be at least {least} here; got {schedule.replay_capacity}")
    if schedule.random_steps < least:
        raise DelayRLError(f"random_steps must be at least {least} here; got {schedule.random_steps}")
    if schedule.evaluate_every % schedule.updates_per_call:  # or evaluating would change what is learned
        raise DelayRLError(
            f"evaluate_every must be a multiple of updates_per_call; got {schedule.evaluate_every} and "
            f"{schedule.updates_per_call}"
        )
    if task is None or task.max_episode_steps is None:
        name = task.id if task else "the task"
        raise DelayRLError(f"{name} has no time limit, so evaluation may never end; register it with one")
    if check := getattr(agent, "check", None):
        check(schedule)
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
        raise DelayRLError(
            f"JAX finds no {name}; `pip install 'delayrl[cuda]'` brings CUDA, or use --device cpu"
        ) from error
    with jax.default_device(device):
        yield


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """An event that Ctrl-C or a polite kill sets, instead of ending the process in the middle of a step."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(kind, lambda *_: event.set()) for kind in kinds]
    try:
        yield event
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)


def _cut(replay: ring.Replay, seed: int, first: int, last: int, first_step: int, steps: int) -> Arrays:
    """Rows first..last of one seed's ring, and the rows of its steps from `first_step` on."""
    capacity = replay.obs.shape[1]
    index = np.arange(first, last + 1) % capacity
    columns = ("obs", "action", "reward", "age", "terminated", "moment")
    piece: Arrays = {name: np.asarray(getattr(replay, name)[seed, index]) for name in columns}
    numbers = np.arange(max(first_step, steps - capacity), steps)
    row_of = np.asarray(replay.row_of[seed, numbers % capacity])
    return piece | {"rows": np.arange(first, last + 1), "steps": numbers, "row_of": row_of}


def _paste(columns: Arrays, piece: Arrays) -> None:
    """Put a piece back where `_cut` took it from."""
    capacity = len(columns["obs"])
    for name in ("obs", "action", "reward", "age", "terminated", "moment"):
        columns[name][piece["rows"] % capacity] = piece[name]
    columns["row_of"][piece["steps"] % capacity] = piece["row_of"]
