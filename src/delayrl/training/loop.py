"""The loop: act, store, learn, evaluate, save. No algorithm's name is in it.

Everything random is a function of (seed, step), so a checkpoint needs no generator's state. The next actions are
chosen before the update that follows a step: the device learns while the environments simulate.
"""

import sys
from collections.abc import Callable
from contextlib import closing
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from delayrl.core import replay as ring
from delayrl.core.protocol import opening_length
from delayrl.core.types import Metrics
from delayrl.delays import Delay
from delayrl.errors import DelayRLError, StoppedError
from delayrl.play.evaluation import RANDOM_ACTIONS
from delayrl.play.plots import curve
from delayrl.play.run import Run
from delayrl.training.actor import Actor
from delayrl.training.estimate import estimate
from delayrl.training.learner import Stored
from delayrl.training.recorder import Recorder
from delayrl.training.resume import save
from delayrl.training.state import Group, TrainState

METRICS_EVERY = 1000


def run(group: Group, state: TrainState, note: Callable[[str], None], stopped: Callable[[], bool]) -> None:
    """Train from a state to the last step, until `stopped()` or the callback ends it, and draw the learning curves.

    Raises:
        StoppedError: the process was asked to stop; the newest step is stored.
        DelayRLError: NaN, a full disk, episodes too short to learn from.
    """
    steps, ways = group.setup.schedule.steps, group.ways
    if state.step < steps:
        recorder = Recorder(group, state)
        if ways.progress:
            note(f"estimate: {estimate(group, state)}")
        interval = 0.5 if sys.stderr.isatty() else 30
        options = {"disable": not ways.progress, "smoothing": 0.05, "dynamic_ncols": True, "mininterval": interval}
        with tqdm(total=steps, initial=state.step, unit="step", **options) as bar, closing(recorder):
            Loop(group, state, recorder).train(stopped, bar)
    for folder in group.folders:
        curve(Run(folder.path), folder.path / "curve.png")


class Loop:
    """Trains a group of seeds in lockstep, step by step."""

    def __init__(self, group: Group, state: TrainState, recorder: Recorder) -> None:
        self.group, self.state, self._recorder = group, state, recorder
        self._metrics: Metrics = {}
        self._ended: list[list[dict[str, Any]]] = [[] for _ in state.actors]  # episodes of each seed, not yet written
        self._learning = False

    def train(self, stopped: Callable[[], bool], bar: Any) -> None:
        """Train until the last step, until `stopped()`, or until an evaluation after which the callback is true."""
        schedule, callback, state = self.group.setup.schedule, self.group.ways.callback, self.state
        while state.step < schedule.steps:
            if stopped():
                self._recorder.episodes(self._ended)
                self.state = save(self.group, state)
                raise StoppedError(f"stopped at step {state.step:,}; the same command goes on from there")
            self.step()
            bar.update(1)
            if state.step % METRICS_EVERY == 0:
                self._recorder.log(state.step, self._metrics, self._learning)
            if state.step % schedule.evaluate_every == 0 or state.step == schedule.steps:
                self.choose()  # before learning, as at every other step
                self.learn()  # what is evaluated has learned from every step before
                bar.set_postfix_str(self._recorder.evaluate(state.step, state.learner.agent))
                self._recorder.episodes(self._ended)
                self.state = state = save(self.group, state, complete=state.step == schedule.steps)
                runs = [Run(folder.path) for folder in self.group.folders]
                if callback and callback(state.step, runs) and state.step < schedule.steps:
                    return

    def step(self) -> None:
        """Act once in every environment, and learn from the steps before if a block of them is full."""
        state = self.state
        actions = self.choose()
        if len(state.pending) == self.group.setup.schedule.updates_per_call:
            self.learn()
        actions, state.actions = np.asarray(actions), None
        transitions = list(self.group.apply(Actor.step, state.actors, actions))  # before asking what they leave hidden
        hidden = [hidden_steps(actor, self.group.setup.delay) for actor in state.actors]
        state.pending.append([Stored(*step) for step in zip(transitions, hidden, strict=True)])
        state.step += 1
        for actor, ended in zip(state.actors, self._ended, strict=True):
            ended += [{"step": state.step, "seed": actor.seed, **episode} for episode in actor.finished]
            actor.finished.clear()

    def choose(self) -> Any:
        """Return the next actions, chosen by what was learned until now. Does not wait for them."""
        state, group = self.state, self.group
        if state.actions is None:
            random = state.step < group.setup.schedule.random_steps
            state.actions = self._opened(self._random_actions() if random else self._act())
        return state.actions

    def learn(self) -> None:
        """Give the newest steps to the learner, which learns what is due. Does not wait for it."""
        group, state, schedule = self.group, self.state, self.group.setup.schedule
        if not state.pending:
            return
        first = schedule.first_update
        if not self._learning and first <= state.step < schedule.random_steps and not self._can_learn():
            first = state.step + 1  # there is still time
        state.learner, metrics, due = group.program.learn(state.learner, state.pending, group.keys, state.step, first)
        state.pending = []
        self._metrics |= metrics
        if due and not self._learning:
            self._learning = True
            if not self._can_learn():  # the first block's own steps count too
                task = group.setup.condition.env
                raise DelayRLError(f"no episode of {task} is long enough to learn from under this protocol")

    def _act(self) -> Any:
        group, state = self.group, self.state
        seen = jax.tree.map(lambda *x: np.stack(x), *[actor.seen for actor in state.actors])
        return group.program.act(state.learner.agent, seen, group.keys, state.step)

    def _opened(self, actions: Any) -> Any:
        """Return the actions, but those of the protocol in episodes that open."""
        opening = self.group.setup.protocol.opening
        length = opening_length(opening, self.group.spec.delay)
        opens = np.array([[len(actor.actions) < length] for actor in self.state.actors])
        if not opens.any():  # does not wait for the actions
            return actions
        return np.where(opens, np.float32(0) if opening == "zeros" else self._random_actions(), actions)

    def _can_learn(self) -> bool:
        """Whether every seed has steps to learn from, even while its newest are hidden."""
        setup, learnable = self.group.setup, self.group.program.learnable
        hidden = 0 if setup.agent.privileged else setup.delay.latest
        counts = jax.vmap(lambda replay: ring.drawable(replay, hidden, learnable))(self.state.learner.replay)
        return int(counts.min()) > 0

    def _random_actions(self) -> NDArray[np.float32]:
        generators = [np.random.default_rng([seed, RANDOM_ACTIONS, self.state.step]) for seed in self.group.seeds]
        return np.array([one.uniform(-1, 1, self.group.spec.action_size) for one in generators], np.float32)


def hidden_steps(actor: Actor, delay: Delay) -> np.int32:
    """Return how many of the newest steps a seed's learner may not use yet; a privileged one may use all."""
    return np.int32(0 if actor.privileged else min(len(actor.actions), delay.latest))
