"""Delayed imitation with dataset aggregation, DIDA (Liotet, Maran, Bisi, Restelli, ICML 2022).

Idea: an expert learns without delay and is then frozen. A student that sees the augmented state imitates it (DAgger,
Ross et al. 2011). The expert acts first, then the student, in rounds. Every visited state is labelled with the expert's
action in the true state, whoever acted.

Views: the expert sees s_t, the student x_t. Privileged: the expert acts on the true state in the first part of the run.
(Labels would need no privilege if the student waited for them. Here it does not.)

The expert's steps count towards the run's environment steps: it learns and acts up to step `expert_steps`, rounded
up to whole rounds.
Deviations from the paper and from the released code are numbered in docs/algorithms/dida.md.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase, Schedule, descend
from delayrl.core import networks
from delayrl.core.networks import Params
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import input_size, look, network_input
from delayrl.errors import DelayRLError


class State(NamedTuple):
    """The expert, the student with its optimiser state, and the progress of the run."""

    reference: sac.State
    student: Params
    opt_state: optax.OptState
    steps: Int[Array, ""]  # environment steps learned from so far, which decide who acts


@dataclass(frozen=True)
class DIDA:
    """The DIDA agent. The student's defaults are the released code's, the expert's are those of VDPO's reference."""

    reference: sac.SAC = field(default_factory=sac.SAC)
    expert_steps: Annotated[int, "steps in which the expert learns and acts, up to a round's end", "scales"] = 500_000
    round_steps: Annotated[int, "environment steps in a round of aggregation, in which the student acts"] = 1000
    imitation_updates: Annotated[int, "student updates after each round, on fresh batches of all data"] = 1000
    student_hidden: Annotated[tuple[int, ...], "widths of the student's hidden layers"] = (100, 100)
    student_optimiser: Annotated[Literal["rmsprop", "adam"], "the student's optimiser"] = "rmsprop"
    student_learning_rate: Annotated[float, "the student's step size", (0.0, 1.0)] = 1e-3
    student_decay: Annotated[float, "decay of RMSprop's mean of squared gradients", (0.0, 1.0)] = 0.9
    student_batch_size: Annotated[int, "windows per imitation batch"] = 32

    privileged = True

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the expert's targets; imitation needs no later steps."""
        return self.reference.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return two phases: the expert learns at every step, the student at the end of every round."""
        return (
            Phase(1, 1, self.reference.batch_size, self.update),
            Phase(self.round_steps, self.imitation_updates, self.student_batch_size, self.imitate),
        )

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """Return the expert."""
        return self.reference, state.reference

    def for_run(self, schedule: Schedule) -> "DIDA":
        """Return the agent.

        Raises:
            DelayRLError: the expert does not finish between its first update and the end, or observations are
                normalised: their moments would still move what the frozen expert sees.
        """
        if schedule.observation_norm != "none":
            raise DelayRLError(f"dida takes observation_norm none; got {schedule.observation_norm}")
        first = max(schedule.random_steps, schedule.first_update)
        if not first < self.expert_end < schedule.steps:
            raise DelayRLError(
                f"expert_steps, rounded up to whole rounds of {self.round_steps}, must lie between random_steps (or "
                f"update_after) and steps, {first} and {schedule.steps}; got {self.expert_steps}"
            )
        return self

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise expert and student."""
        if spec.delay < 1:
            raise DelayRLError("dida learns a policy for a delay of at least 1 step: give --delay N, or train sac")
        if (self.reference.update_every, self.reference.updates) != (1, 1):
            raise DelayRLError("dida's expert is updated once a step: leave update_every and updates at 1")
        reference_key, student_key = jax.random.split(key)
        sizes = (input_size(spec, "augmented"), *self.student_hidden, spec.action_size)
        student = networks.mlp_init(student_key, sizes)
        reference = self.reference.init(replace(spec, delay=0), reference_key)
        return State(reference, student, self.optimiser.init(student), jnp.zeros((), jnp.int32))

    @property
    def expert_end(self) -> int:
        """The step at which the expert ends: with a round, so that the student learns before it acts."""
        return -(-self.expert_steps // self.round_steps) * self.round_steps

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam, or RMSprop as in PyTorch, with ε outside the root."""
        if self.student_optimiser == "adam":
            return optax.adam(self.student_learning_rate)
        return optax.rmsprop(self.student_learning_rate, self.student_decay, eps=1e-10, eps_in_sqrt=False)

    def policy(self, student: Params, x: Float[Array, "*batch input"]) -> Float[Array, "*batch action"]:
        """Return the student's deterministic action at inputs `x`."""
        return jnp.tanh(networks.mlp(student, x))

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Return the student's action, or in the first part of training the expert's, which explores as SAC does."""
        student = self.policy(state.student, network_input(seen, "augmented"))
        if not explore:
            return student
        assert seen.truth is not None, "behaviour with the expert is privileged"
        expert = self.reference.act(state.reference, seen._replace(obs=seen.truth), key, explore=True)
        return jnp.where(state.steps < self.expert_end, expert, student)

    def deterministic(self, state: State) -> Deterministic:
        """Return the student."""
        return Deterministic("augmented", state.student)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the expert by SAC, up to `expert_end`; `count` is the environment step, the same for all seeds."""

        def learn(reference: sac.State) -> tuple[sac.State, Metrics]:
            return self.reference.update(reference, windows, key, count)

        _, metrics = jax.eval_shape(learn, state.reference)
        idle = {name: jnp.zeros(metric.shape, metric.dtype) for name, metric in metrics.items()}
        reference, metrics = jax.lax.cond(
            count <= self.expert_end, learn, lambda reference: (reference, idle), state.reference
        )
        return state._replace(reference=reference, steps=jnp.asarray(count, jnp.int32)), metrics

    def imitate(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the student once, if the expert has finished. The first updates precede the student's first action."""

        def learn(student: Params, opt_state: optax.OptState) -> tuple[Params, optax.OptState, Array]:
            student, opt_state, loss, _ = descend(
                self.optimiser, self.imitation_loss, student, opt_state, state.reference.actor, windows
            )
            return student, opt_state, loss

        student, opt_state, loss = jax.lax.cond(
            self.phases()[1].step_of(count) >= self.expert_end,
            learn,
            lambda student, opt_state: (student, opt_state, jnp.zeros(())),
            state.student,
            state.opt_state,
        )
        return state._replace(student=student, opt_state=opt_state), {"imitation_loss": loss}

    def imitation_loss(self, student: Params, expert: Params, windows: Window) -> tuple[Array, None]:
        """Return Σ |a_student(x_t) - a_expert(s_t)| over batch and dimensions; the expert's action is its mode."""
        x, s = (jax.vmap(lambda window, sees=sees: look(window, sees))(windows) for sees in ("augmented", "current"))
        label = jax.lax.stop_gradient(networks.mode(self.reference.policy(expert, s)))
        return jnp.abs(self.policy(student, x) - label).sum(), None
