"""Policy lifting on BPQL: D²HPG-BPQL (Lee et al. 2026, "Delayed homomorphic reinforcement learning", arXiv 2604.03641).

Idea: many augmented states x_t ask for the same action, that of the state s_t which they hide. So learn a delay-free
SAC beside BPQL, from the same replay and with the same temperature, and pull the delayed policy at x_t towards the
delay-free one at s_t: strongly at first, then less and less, since the delayed policy must do its own best in the end.

Views: the delayed actor sees x_t, all else s_t. It acts by the delayed policy alone (not privileged): a pair (x_t, s_t)
is learned from once s_t has arrived.

The moments of the squashed Gaussians are sums over `NODES`, not samples: within 3e-4 of the exact ones for every mean
and every log-std in [-20, 2]; 100 samples are off by 1e-1.

Deviations from the paper and from the released code are numbered in docs/algorithms/lifting.md.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase, Schedule
from delayrl.core.networks import Gaussian
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import look
from delayrl.errors import DelayRLError

NODES, SPAN = 64, 4.5
"""Standard normal noise at evenly spaced nodes in ±SPAN: for the wide Gaussians, whose tanh is nearly a step, far more
exact than Gauss-Hermite's nodes, which lie wider apart where the mass is (2e-2 with as many)."""


class State(NamedTuple):
    """BPQL, and the delay-free SAC; the latter's temperature is BPQL's."""

    delayed: sac.State
    reference: sac.State


@dataclass(frozen=True)
class Lifting:
    """Hyperparameters; the defaults are the released code's."""

    bpql: sac.SAC = field(default_factory=lambda: replace(sac.BPQL, initial_temperature=0.2))
    lifting_weight: Annotated[float, "weight of the lifting loss at first", (0.0, 1e6)] = 10.0
    lifting_hold: Annotated[int, "environment step up to which it keeps that weight"] = 250_000
    lifting_end: Annotated[int, "environment step at which the weight has gone linearly to 0"] = 750_000

    privileged = False

    @property
    def reference(self) -> sac.SAC:
        """The delay-free SAC."""
        return replace(self.bpql, actor_sees="current", critic_sees="current")

    def ahead(self, spec: Spec) -> int:
        """k-step targets, as SAC's."""
        return self.bpql.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """One: the update."""
        return (self.bpql.phases()[0]._replace(update=self.update),)

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """The delay-free SAC that the delayed policy is pulled towards."""
        return self.reference, state.reference

    def check(self, schedule: Schedule) -> None:
        """The weight must have gone to 0 before the run ends."""
        if self.lifting_end > schedule.steps:
            raise DelayRLError(
                f"lifting_end must be no later than steps, {schedule.steps}; got {self.lifting_end} "
                "(the original holds the weight for a quarter of the run, and ends at three quarters)"
            )

    def init(self, spec: Spec, key: Key) -> State:
        """Fresh networks of two SACs."""
        if self.lifting_hold > self.lifting_end:
            raise DelayRLError(
                f"lifting_hold must be no later than lifting_end = {self.lifting_end}; got {self.lifting_hold}"
            )
        delayed_key, reference_key = jax.random.split(key)
        return State(self.bpql.init(spec, delayed_key), self.reference.init(replace(spec, delay=0), reference_key))

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """A sample of the delayed policy, or its mode."""
        return self.bpql.act(state.delayed, seen, key, explore=explore)

    def deterministic(self, state: State) -> Deterministic:
        """The delayed policy."""
        return self.bpql.deterministic(state.delayed)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """SAC's update of the reference, then BPQL's with the lifting loss; both on the same batch."""
        reference_key, delayed_key = jax.random.split(key)
        # the temperature is moved by the delayed policy's entropy alone: what the reference makes of it is dropped
        shared = state.delayed.log_temperature
        reference = state.reference._replace(log_temperature=shared)
        reference, of_reference = self.reference.update(reference, windows, reference_key, count)
        towards = self.bpql.policy(reference.actor, windows.obs[:, windows.delay])
        weight = self.weight(count // self.bpql.updates * self.bpql.update_every)
        before = self.bpql.policy(state.delayed.actor, jax.vmap(lambda window: look(window, "augmented"))(windows))
        delayed, metrics = self.bpql.update(
            state.delayed, windows, delayed_key, count, lambda policy: weight * lifting_loss(policy, towards)
        )
        state = State(delayed, reference._replace(log_temperature=delayed.log_temperature))
        return state, metrics | {
            "lifting_loss": lifting_loss(before, towards),
            "lifting_weight": weight,
            "reference_critic_loss": of_reference["critic_loss"],
            "reference_entropy": of_reference["entropy"],
        }

    def weight(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """w(t): constant, then linear to 0, then 0."""
        left = (self.lifting_end - step) / max(self.lifting_end - self.lifting_hold, 1)
        return self.lifting_weight * jnp.clip(left, 0.0, 1.0)


def lifting_loss(delayed: Gaussian, reference: Gaussian) -> Float[Array, ""]:
    """Mean squared distances of the squashed policies' means and of their standard deviations, added."""
    (mean, std), (to_mean, to_std) = moments(delayed), jax.lax.stop_gradient(moments(reference))
    return ((mean - to_mean) ** 2).mean() + ((std - to_std) ** 2).mean()


def moments(policy: Gaussian) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch action"]]:
    """Mean and standard deviation of tanh(N(mean, std²)), by the trapezoidal rule.

    Its error falls with the nodes as exp(-π² / (spacing · std)): tanh(mean + std · z) has its nearest pole at a
    distance of π / (2 std) from the real line.
    """
    noise = jnp.linspace(-SPAN, SPAN, NODES)
    share = jax.nn.softmax(-0.5 * noise**2)
    action = jnp.tanh(policy.mean[..., None] + jnp.exp(policy.log_std)[..., None] * noise)
    mean = action @ share
    variance = (action - mean[..., None]) ** 2 @ share
    return mean, jnp.sqrt(variance + 1e-12)  # the root has no slope at 0, where a policy is deterministic
