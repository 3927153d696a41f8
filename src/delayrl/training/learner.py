"""Learner state and the jitted functions that update it, for all seeds at once."""

import functools
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from numpy.typing import NDArray

from delayrl.agents.base import Agent, State
from delayrl.core import replay as ring
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Transition

AS_ONE = jax.__version_info__ >= (0, 12)
"""Whether XLA keeps the replay in place where one program writes and samples it; JAX 0.10 copies it at every step."""


class Learner(NamedTuple):
    """What lives on the device, each with a leading seed axis."""

    agent: State
    replay: ring.Replay


Hidden = Int[Array, "*seeds"] | NDArray[np.int32] | np.int32
"""How many of the newest observations a learner may not use yet, because they have not all arrived."""


class Stored(NamedTuple):
    """One step of one seed, and what is hidden after it."""

    transition: Transition
    hidden: Hidden


class Program:
    """The jitted functions of one agent on one task. Learners, agents, observations and keys have a leading seed axis.

    Get one from `compiled`: it returns the same functions for the same agent and task.
    """

    def __init__(self, agent: Agent, spec: Spec, learnable: ring.Learnable = ring.ALL) -> None:
        self.phases, self._agent, self._spec = agent.phases(), agent, spec
        self.learnable = learnable
        self._init = jax.jit(jax.vmap(functools.partial(agent.init, spec)))
        self._append = functools.partial(ring.append, learnable=learnable)
        self._jitted_act = jax.jit(self._act)
        self._jitted_learn = jax.jit(self._learn, static_argnames="first_phase", donate_argnums=0)
        self._jitted_update = jax.jit(self._update, static_argnames="index", donate_argnums=0)
        self._jitted_moment = jax.jit(jax.vmap(ring.current_moment))
        self._jitted_append = jax.jit(
            jax.vmap(lambda replay, step, moment: self._append(replay, step, moment=moment)), donate_argnums=0
        )

    def init(self, keys: Key, capacity: int) -> Learner:
        """Make fresh agents and empty replays."""
        shapes = jax.eval_shape(lambda: ring.init(self._spec, capacity))
        return Learner(self._init(keys), jax.tree.map(lambda x: jnp.zeros((len(keys), *x.shape), x.dtype), shapes))

    def act(self, agent: State, seen: Seen, keys: Key, step: int) -> Action:
        """Choose exploring actions for all seeds. Returns without waiting for them."""
        return self._jitted_act(agent, seen, keys, np.int32(step))

    def learn(
        self, learner: Learner, pending: list[list[Stored]], keys: Key, last: int, first_update: int
    ) -> tuple[Learner, Metrics, bool]:
        """Store the newest steps and run the phases that are due at them, without waiting. Donates `learner`.

        `pending` are steps, [steps][seeds], up to number `last`. Nothing is due before `first_update`. If the first
        phase is due at every step, it runs after each is stored; all others run at the end. Returns the new learner,
        its metrics, and whether anything was due.
        """
        steps = range(last - len(pending) + 1, last + 1)
        due = [self._due(step) if step >= first_update else [] for step in steps]
        first_phase = all(0 in phases for phases in due)
        flat = [stored for seeds in pending for stored in seeds]
        shape = (len(steps), len(pending[0]))
        block = jax.tree.map(lambda *x: np.stack(x).reshape(*shape, *np.shape(x[0])), *flat)
        learn = self._jitted_learn if AS_ONE else self._learn_apart
        learner, metrics = learn(learner, block, keys, np.array(steps, np.int32), first_phase=first_phase)
        for step, phases in zip(steps, due, strict=True):
            for index in phases[1:] if first_phase else phases:
                learner, more = self._jitted_update(learner, block.hidden[-1], keys, np.int32(step), index=index)
                metrics = metrics | more
        return learner, metrics, any(due)

    def _due(self, step: int) -> list[int]:
        return [index for index, phase in enumerate(self.phases) if step % phase.every == 0]

    def _act(self, agent: State, seen: Seen, keys: Key, step: Int[Array, ""]) -> Action:
        def act(state: State, seen: Seen, key: Key) -> Action:
            return self._agent.act(state, seen, jax.random.fold_in(key, step), explore=True)

        return jax.vmap(act)(agent, seen, keys)

    def _learn(
        self, learner: Learner, block: Stored, keys: Key, steps: Int[Array, " block"], first_phase: bool
    ) -> tuple[Learner, Metrics]:
        def learn_step(learner: Learner, x: tuple[Stored, Int[Array, ""]]) -> tuple[Learner, Metrics]:
            (transition, hidden), step = x
            replay = jax.vmap(self._append)(learner.replay, transition)
            # else the write is fused into the gathers of `sample`, and the whole replay is copied at every step
            learner = learner._replace(replay=jax.lax.optimization_barrier(replay))
            return self._update(learner, hidden, keys, step, 0) if first_phase else (learner, {})

        if len(steps) == 1:
            return learn_step(learner, jax.tree.map(lambda x: x[0], (block, steps)))
        learner, metrics = jax.lax.scan(learn_step, learner, (block, steps))
        return learner, jax.tree.map(lambda x: x.mean(0), metrics)

    def _learn_apart(
        self, learner: Learner, block: Stored, keys: Key, steps: NDArray[np.int32], first_phase: bool
    ) -> tuple[Learner, Metrics]:
        """Do what `_learn` does in calls of their own: the replay is written in one, and only read in the next."""
        learned = []
        for number, step in enumerate(steps):
            transition, hidden = jax.tree.map(lambda x, number=number: x[number], block)
            moment = self._jitted_moment(learner.replay)
            learner = learner._replace(replay=self._jitted_append(learner.replay, transition, moment))
            if first_phase:
                learner, metrics = self._jitted_update(learner, hidden, keys, step, index=0)
                learned.append(metrics)
        return learner, jax.tree.map(lambda *x: sum(x) / len(x), *learned) if learned else {}

    def _update(
        self, learner: Learner, hidden: Hidden, keys: Key, step: Int[Array, ""], index: int
    ) -> tuple[Learner, Metrics]:
        agent, replay = learner
        phase = self.phases[index]
        reach = (phase.batch, self._spec.delay, self._agent.ahead(self._spec))

        def update(agent: State, i: Int[Array, ""]) -> tuple[State, Metrics]:
            count = step // phase.every * phase.updates + i

            def update_seed(agent: State, replay: ring.Replay, key: Key, hidden: Array) -> tuple[State, Metrics]:
                for number in (step, index, i):
                    key = jax.random.fold_in(key, number)
                sample_key, update_key = jax.random.split(key)
                windows = ring.sample(replay, sample_key, *reach, hidden, self.learnable)
                return phase.update(agent, replace(windows, log_scale=self._spec.log_scale), update_key, count)

            return jax.vmap(update_seed)(agent, replay, keys, jnp.asarray(hidden))

        if phase.updates == 1:
            agent, metrics = update(agent, jnp.int32(0))
        else:
            agent, metrics = jax.lax.scan(update, agent, jnp.arange(phase.updates))
            metrics = jax.tree.map(lambda x: x.mean(0), metrics)
        return Learner(agent, replay), metrics


compiled = functools.lru_cache(8)(Program)  # of about 70 MB each
