"""Evaluation and metrics of a run in training, written to its run folders."""

import time
from contextlib import ExitStack, closing
from typing import Any, NamedTuple

import jax
import numpy as np

from delayrl.agents.base import State, reference_of
from delayrl.core.protocol import opening_length
from delayrl.core.types import Metrics, Spec
from delayrl.envs.making import physics
from delayrl.errors import DelayRLError
from delayrl.play.evaluation import EVALUATION, Evaluator, reset_seed
from delayrl.training.state import Group, TrainState
from delayrl.training.tracking import Tracker

OPENING = 3
"""The stream of an evaluation's opening actions, apart from its start state and its delays (1) and noise (2)."""
KEPT = "the last good checkpoint is kept"


def evaluators(group: Group, agent: State) -> dict[str, Evaluator]:
    """Make what plays the evaluations of a group: of the agent, and without delay of its reference, if it has one."""
    setup = group.setup
    shape = (len(group.seeds), setup.schedule.evaluation_episodes, group.apply)
    with ExitStack() as held:
        made = {"agent": Evaluator(setup.agent, group.spec, setup.task, setup.delay, *shape)}
        held.enter_context(closing(made["agent"]))
        if reference := reference_of(setup.agent, agent):
            spec = Spec(group.spec.obs_size, group.spec.action_size, 0)
            made["reference"] = Evaluator(reference[0], spec, setup.task, 0, *shape)
        held.pop_all()
    return made


class Moment(NamedTuple):
    """A time and a step of a run, to measure speed from."""

    seconds: float
    step: int

    def speed(self, now: "Moment") -> float:
        """Return the environment steps per second from this moment until now."""
        return (now.step - self.step) / (now.seconds - self.seconds)


class Recorder:
    """Evaluates a group of seeds and writes rows and metrics; to a tracking service too, where the group has one."""

    def __init__(self, group: Group, state: TrainState) -> None:
        self._group = group
        setup = group.setup
        self._columns = setup.condition.columns | {
            "privileged": setup.agent.privileged,
            "configuration": setup.configuration,
        }
        self._physics = physics(state.actors[0].env)
        self._evaluators = evaluators(group, state.learner.agent)
        self._trackers = [Tracker(group.ways.track, run.path, state.step) for run in group.folders]
        self._began = self._learning = Moment(time.perf_counter(), state.step)

    def evaluate(self, step: int, agent: State) -> str:
        """Play the evaluation episodes of a step, write a row for each. Returns the mean returns in words."""
        group, protocol = self._group, self._group.setup.protocol
        states = {"agent": agent}
        if reference := reference_of(group.setup.agent, agent):
            states["reference"] = reference[1]
        episodes = range(group.setup.schedule.evaluation_episodes)
        own = [[reset_seed(seed, EVALUATION, step, episode) for episode in episodes] for seed in group.seeds]
        resets = [[seed] * len(episodes) for seed in group.seeds] if protocol.start_states == "same" else own
        shape = (opening_length(protocol.evaluation_opening, group.spec.delay), group.spec.action_size)
        bound = 0 if protocol.evaluation_opening == "zeros" else 1
        opens = [[np.random.default_rng([n, OPENING]).uniform(-bound, bound, shape) for n in row] for row in own]
        opening = np.array(opens, np.float32)
        keys = jax.vmap(lambda key: jax.random.fold_in(key, step))(group.keys)
        summary = []
        for policy, evaluator in self._evaluators.items():
            with jax.default_matmul_precision("float32"):  # as `evaluate`, whatever training computes in
                played = evaluator(states[policy], resets, keys, opening if policy == "agent" else None, own)
            summary.append(f"{policy} {played.returns.mean():.4g}")
            for i, (run, tracker) in enumerate(zip(group.folders, self._trackers, strict=True)):
                rows = [
                    {
                        **self._columns,
                        "seed": group.seeds[i],
                        "step": step,
                        "policy": policy,
                        "episode": episode,
                        "reset_seed": resets[i][episode],
                        "return": float(played.returns[i, episode]),
                        "length": int(played.lengths[i, episode]),
                        **self._physics,
                    }
                    for episode in episodes
                ]
                run.append("rows", rows)
                tracker.write(step, {f"return/{policy}": float(played.returns[i].mean())})
        return " · ".join(summary)

    def close(self) -> None:
        """Close the environments of the evaluations, and what is open of a tracking service."""
        for evaluator in self._evaluators.values():
            evaluator.close()
        for tracker in self._trackers:
            tracker.close()

    def episodes(self, ended: list[list[dict[str, Any]]]) -> None:
        """Write a row for each episode of training that ended, [seeds][episodes], and empty the lists."""
        for run, own in zip(self._group.folders, ended, strict=True):
            if own:
                run.append("episodes", own)
                own.clear()

    def log(self, step: int, metrics: Metrics, learning: bool) -> None:
        """Write speeds and the newest metrics of each seed. Raises DelayRLError for a metric that is not finite."""
        now = Moment(time.perf_counter(), step)
        speeds = {"steps_per_second": self._began.speed(now)}
        if learning or not self._group.program.phases:
            speeds["learning_steps_per_second"] = self._learning.speed(now)
        else:
            self._learning = now
        values = jax.device_get(metrics)
        for i, (run, tracker) in enumerate(zip(self._group.folders, self._trackers, strict=True)):
            own = {name: float(x[i]) for name, x in values.items()}
            for name, x in own.items():
                if not np.isfinite(x):
                    seed = self._group.seeds[i]
                    raise DelayRLError(f"{name} is {x} at step {step} of seed {seed}: training diverged; {KEPT}")
            run.append("metrics", [{"step": step, **{name: round(x, 2) for name, x in speeds.items()}, **own}])
            tracker.write(step, own | speeds)
