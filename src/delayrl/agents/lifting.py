"""Policy lifting on BPQL: D²HPG-BPQL (Lee et al. 2026, "Delayed homomorphic reinforcement learning", arXiv 2604.03641).

Idea: many augmented states x_t call for the same action, that of the hidden state s_t. So a delay-free SAC is learned
beside BPQL, from the same replay and with the same temperature, and the delayed policy at x_t is pulled towards the
delay-free policy at s_t. The pull fades, because in the end the delayed policy must maximise its own return.

Views: the delayed actor sees x_t, all else s_t. Unprivileged: it learns from a pair (x_t, s_t) once s_t has arrived.

The moments of the squashed Gaussians are sums over `NODES`, not samples: for every log-std in [-20, 2] within 3e-4 of
the exact ones, the deviations of nearly saturated actions within 2.1e-3; 100 samples are off by 1e-1.

Deviations from the paper and from the released code are numbered in docs/algorithms/lifting.md.
"""

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase, Schedule
from delayrl.core.networks import Gaussian
from delayrl.core.objectives import annealed
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import look
from delayrl.errors import DelayRLError

NODES, SPAN = 64, 4.5
"""Evenly spaced nodes of standard normal noise in ±SPAN. For wide Gaussians, whose tanh is nearly a step, they are far
more accurate than as many Gauss-Hermite nodes (error 3e-2), which lie wider apart where the mass is."""


class State(NamedTuple):
    """BPQL and the delay-free SAC, which shares BPQL's temperature."""

    delayed: sac.State
    reference: sac.State


@dataclass(frozen=True)
class Lifting:
    """The D²HPG-BPQL agent. Its hyperparameters default to the released code's."""

    bpql: sac.SAC = field(default_factory=lambda: replace(sac.BPQL, initial_temperature=0.2))
    lifting_weight: Annotated[float, "initial weight of the lifting loss", (0.0, 1e6)] = 10.0
    lifting_hold: Annotated[int, "environment step up to which the weight stays", "scales", (0, math.inf)] = 250_000
    lifting_end: Annotated[int, "environment step at which the weight, falling linearly, reaches 0", "scales"] = 750_000

    privileged = False

    @property
    def reference(self) -> sac.SAC:
        """The delay-free SAC."""
        return replace(self.bpql, actor_sees="current", critic_sees="current")

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the k-step targets."""
        return self.bpql.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase, the update."""
        return (self.bpql.phases()[0]._replace(update=self.update),)

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """Return the delay-free SAC towards which the delayed policy is pulled."""
        return self.reference, state.reference

    def for_run(self, schedule: Schedule) -> "Lifting":
        """Return the agent. Raises DelayRLError unless the weight reaches 0 by the end of the run."""
        if self.lifting_end > schedule.steps:
            raise DelayRLError(
                f"lifting_end must be no later than steps, {schedule.steps}; got {self.lifting_end} "
                "(the original holds the weight for a quarter of the run, and ends at three quarters)"
            )
        return self

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise both SACs."""
        if self.lifting_hold > self.lifting_end:
            raise DelayRLError(
                f"lifting_hold must be no later than lifting_end = {self.lifting_end}; got {self.lifting_hold}"
            )
        delayed_key, reference_key = jax.random.split(key)
        return State(self.bpql.init(spec, delayed_key), self.reference.init(replace(spec, delay=0), reference_key))

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Sample the delayed policy, or return its mode."""
        return self.bpql.act(state.delayed, seen, key, explore=explore)

    def deterministic(self, state: State) -> Deterministic:
        """Return the delayed policy."""
        return self.bpql.deterministic(state.delayed)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the reference by SAC, then BPQL with the lifting loss, both on the same batch."""
        reference_key, delayed_key = jax.random.split(key)
        # only the delayed policy's entropy moves the temperature; the reference's change to it is discarded afterwards
        shared = state.delayed.log_temperature
        reference = state.reference._replace(log_temperature=shared)
        reference, of_reference = self.reference.update(reference, windows, reference_key, count)
        towards = self.bpql.policy(reference.actor, windows.obs[:, windows.delay])
        weight = self.weight(self.bpql.phases()[0].step_of(count))
        before = self.bpql.policy(state.delayed.actor, jax.vmap(lambda window: look(window, "augmented"))(windows))
        improve = functools.partial(
            self.bpql.improve_actor, penalty=lambda actor, policy: weight * lifting_loss(policy, towards)
        )
        delayed, metrics = self.bpql.update(state.delayed, windows, delayed_key, count, improve)
        state = State(delayed, reference._replace(log_temperature=delayed.log_temperature))
        return state, metrics | {
            "lifting_loss": lifting_loss(before, towards),
            "lifting_weight": weight,
            "reference_critic_loss": of_reference["critic_loss"],
            "reference_entropy": of_reference["entropy"],
        }

    def weight(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Return w(t), which is constant at first, then falls linearly to 0 and stays there."""
        return self.lifting_weight * annealed(step, self.lifting_hold, self.lifting_end)


def lifting_loss(delayed: Gaussian, reference: Gaussian) -> Float[Array, ""]:
    """Return the mean squared distance of the squashed policies' means plus that of their standard deviations."""
    (mean, std), (to_mean, to_std) = moments(delayed), jax.lax.stop_gradient(moments(reference))
    return ((mean - to_mean) ** 2).mean() + ((std - to_std) ** 2).mean()


def moments(policy: Gaussian) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch action"]]:
    """Return the mean and standard deviation of tanh(N(mean, std²)), by the trapezoidal rule.

    The error is about exp(-π² / (spacing · std)): the nearest pole of tanh(mean + std · z) is π / (2 std) off the axis.
    """
    noise = jnp.linspace(-SPAN, SPAN, NODES)
    share = jax.nn.softmax(-0.5 * noise**2)
    action = jnp.tanh(policy.mean[..., None] + jnp.exp(policy.log_std)[..., None] * noise)
    mean = jnp.matmul(action, share, precision="highest")
    variance = jnp.matmul((action - mean[..., None]) ** 2, share, precision="highest")
    return mean, jnp.sqrt(variance + 1e-12)  # the root has infinite slope at 0, as for deterministic policies
