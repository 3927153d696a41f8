"""The device's side: agent states and replays of all seeds, and the jitted functions on them."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from numpy.typing import NDArray

from delayrl.agents.base import Agent, Schedule, State
from delayrl.core import replay as ring
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Transition


class Learner(NamedTuple):
    """What lives on the device, each with a leading seed axis."""

    agent: State
    replay: ring.Replay


Hidden = Int[Array, " seeds"] | NDArray[np.int32]
"""How many of the newest observations each learner may not look at, because not all of them have arrived."""


class Stored(NamedTuple):
    """A step of all seeds, and what is hidden after it."""

    transition: Transition
    hidden: Hidden


class Program:
    """The jitted functions of one agent on one task. Every argument has a leading seed axis but `step`.

    Made by `compiled`, which gives the same agent on the same task the same functions again.
    """

    def __init__(self, agent: Agent, spec: Spec, whole: int = 1):
        self.phases, self._agent, self._spec, self._whole = agent.phases(), agent, spec, whole
        self._jitted_act = jax.jit(self._act)
        self._jitted_learn = jax.jit(self._learn, static_argnames="index", donate_argnums=0)
        self._jitted_update = jax.jit(self._update, static_argnames="index", donate_argnums=0)

    def init(self, keys: Key, capacity: int) -> Learner:
        """Fresh states and empty replays."""
        states = jax.jit(jax.vmap(functools.partial(self._agent.init, self._spec)))(keys)
        shapes = jax.eval_shape(lambda: ring.init(self._spec, capacity))
        return Learner(states, jax.tree.map(lambda x: jnp.zeros((len(keys), *x.shape), x.dtype), shapes))

    def act(self, agent: State, seen: Seen, keys: Key, step: int) -> Action:
        """Exploring actions for all seeds, not waited for."""
        return self._jitted_act(agent, seen, keys, np.int32(step))

    def learn(
        self, learner: Learner, stored: list[Stored], keys: Key, steps: range, due: list[tuple[int, ...]]
    ) -> tuple[Learner, Metrics]:
        """Store the newest steps, and run the phases that are due at them; not waited for. The old arrays are gone.

        The first phase, where it is due at each of the steps, runs after each is stored; what else is due, at the end.
        """
        always = 0 if all(0 in phases for phases in due) else None
        block = jax.tree.map(lambda *x: np.stack(x), *stored)
        learner, metrics = self._jitted_learn(learner, block, keys, np.array(steps, np.int32), index=always)
        for step, phases in zip(steps, due, strict=True):
            for index in (phase for phase in phases if phase != always):
                learner, more = self._jitted_update(learner, stored[-1].hidden, keys, np.int32(step), index=index)
                metrics = metrics | more
        return learner, metrics

    def due(self, step: int, schedule: Schedule) -> tuple[int, ...]:
        """The phases that run once `step` steps are stored."""
        if step < schedule.random_steps:
            return ()
        return tuple(i for i, phase in enumerate(self.phases) if step % phase.every == 0)

    def _act(self, agent: State, seen: Seen, keys: Key, step: Int[Array, ""]) -> Action:
        def one(state: State, seen: Seen, key: Key) -> Action:
            return self._agent.act(state, seen, jax.random.fold_in(key, step), explore=True)

        return jax.vmap(one)(agent, seen, keys)

    def _learn(
        self, learner: Learner, block: Stored, keys: Key, steps: Int[Array, " block"], index: int | None
    ) -> tuple[Learner, Metrics]:
        def one(learner: Learner, x: tuple[Stored, Int[Array, ""]]) -> tuple[Learner, Metrics]:
            (transition, hidden), step = x
            replay = jax.vmap(functools.partial(ring.append, whole=self._whole))(learner.replay, transition)
            # else the write is fused into the gathers of `sample`, and the whole replay is copied at every step
            learner = learner._replace(replay=jax.lax.optimization_barrier(replay))
            return (learner, {}) if index is None else self._update(learner, hidden, keys, step, index)

        if len(steps) == 1:
            return one(learner, jax.tree.map(lambda x: x[0], (block, steps)))
        learner, metrics = jax.lax.scan(one, learner, (block, steps))
        return learner, jax.tree.map(lambda x: x.mean(0), metrics)

    def _update(
        self, learner: Learner, hidden: Hidden, keys: Key, step: Int[Array, ""], index: int
    ) -> tuple[Learner, Metrics]:
        agent, replay = learner
        phase = self.phases[index]
        reach = (phase.batch, self._spec.delay, self._agent.ahead(self._spec))

        def update(agent: State, i: Int[Array, ""]) -> tuple[State, Metrics]:
            count = step // phase.every * phase.updates + i

            def one(agent: State, replay: ring.Replay, key: Key, hidden: Int[Array, ""]) -> tuple[State, Metrics]:
                for number in (step, index, i):
                    key = jax.random.fold_in(key, number)
                draw, learn = jax.random.split(key)
                return phase.update(agent, ring.sample(replay, draw, *reach, hidden), learn, count)

            return jax.vmap(one)(agent, replay, keys, jnp.asarray(hidden))

        if phase.updates == 1:
            agent, metrics = update(agent, jnp.int32(0))
        else:
            agent, metrics = jax.lax.scan(update, agent, jnp.arange(phase.updates))
            metrics = jax.tree.map(lambda x: x.mean(0), metrics)
        return Learner(agent, replay), metrics


compiled = functools.cache(Program)
