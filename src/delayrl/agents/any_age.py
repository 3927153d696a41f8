"""Any-age: BPQL whose actor is trained on several views of the same moment, the older pulled towards the younger.

Idea: BPQL's critic values actions in the true state s_t, whatever view chose them. For one and the same s_t the replay
holds every younger view too: x^(j)_t = (s_{t-j}, a_{t-j}, …, a_{t-1}), j = 0..d. So one actor learns to act at its own
age d and at a random younger age j from the same critic. π(x^(d)_t) is pulled towards π(x^(j)_t), with a weight that is
annealed to nothing: what is easy to learn with a fresh observation climbs up to the old ones.

Views: the actor sees x_t, at its own and at a younger age; the critics see s_t. Unprivileged: s_t and the observations
in between are learned from once they have arrived.

What it takes from whom stands in docs/algorithms/any-age.md.
"""

import functools
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase, Schedule, descend
from delayrl.agents.lifting import lifting_loss
from delayrl.agents.sac import State
from delayrl.core import networks
from delayrl.core.networks import Params
from delayrl.core.objectives import annealed, soft_value
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import network_input, view
from delayrl.errors import DelayRLError

SecondAge = Literal["none", "random", "zero"]


@dataclass(frozen=True)
class AnyAge:
    """The any-age agent."""

    bpql: sac.SAC = field(default_factory=lambda: replace(sac.BPQL, critic_norm="layer"))
    second_age: Annotated[SecondAge, "the younger age that the actor learns at too: random in 0..d, or 0"] = "random"
    pull_weight: Annotated[float, "initial weight of the pull towards the younger age", (0.0, 1e6)] = 1.0
    pull_hold: Annotated[float, "part of the run in which the weight stays constant", (0.0, 1.0)] = 0.25
    pull_end: Annotated[float, "part of the run after which the weight, falling linearly, is 0", (0.0, 1.0)] = 0.75
    run_steps: Annotated[int, "fixed"] = 0  # environment steps of the run, from its schedule

    privileged = False

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the k-step targets."""
        return self.bpql.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase, the update."""
        return (self.bpql.phases()[0]._replace(update=self.update),)

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """Return None: the delay-free policy is the same network at age 0 (`delayrl evaluate --sweep`)."""
        return None

    def for_run(self, schedule: Schedule) -> "AnyAge":
        """Return the agent with the length of its run. Raises DelayRLError if the weight falls before it is held."""
        if self.pull_hold > self.pull_end:
            raise DelayRLError(f"pull_hold must be no later than pull_end, {self.pull_end}; got {self.pull_hold}")
        return replace(self, run_steps=schedule.steps)

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise as BPQL."""
        return self.bpql.init(spec, key)

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Sample the policy at the shown age, or return its mode."""
        return self.bpql.act(state, seen, key, explore=explore)

    def deterministic(self, state: State) -> Deterministic:
        """Return the actor."""
        return self.bpql.deterministic(state)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the critics as BPQL does, and the actor at two ages."""
        if self.second_age == "none" or windows.delay == 0:
            return self.bpql.update(state, windows, key, count)
        age_key, update_key = jax.random.split(key)
        weight = self.weight(count // self.bpql.updates * self.bpql.update_every)
        younger = self.younger(windows, age_key)
        improve = functools.partial(self.improve_actor, younger, weight)
        state, metrics = self.bpql.update(state, windows, update_key, count, improve)
        return state, metrics | {"pull_weight": weight}

    def younger(self, windows: Window, key: Key) -> Float[Array, "batch input"]:
        """Return x^(j)_t of each window, j uniform on 0..d or 0, as the actor sees it."""
        age = windows.age[:, windows.delay]
        share = jax.random.uniform(key, age.shape) if self.second_age == "random" else jnp.zeros(age.shape)
        ages = jnp.floor(share * (age + 1)).astype(jnp.int32)
        return jax.vmap(lambda window, age: network_input(view(window, age=age), "augmented"))(windows, ages)

    def improve_actor(
        self, younger: Array, weight: Array, state: State, actor_input: Array, critic_input: Array, key: Key
    ) -> State:
        """Take one gradient step on the actor: half for each age, and the pull of the older one."""
        temperature, keys = jnp.exp(state.log_temperature), jax.random.split(key)

        def loss(actor: Params) -> tuple[Array, None]:
            older, other = self.bpql.policy(actor, actor_input), self.bpql.policy(actor, younger)
            total = weight * lifting_loss(older, other)
            for policy, sample_key in zip((older, other), keys, strict=True):
                action, log_prob = networks.sample(policy, sample_key)
                q = networks.twin(state.critic, critic_input, action)
                total -= 0.5 * soft_value(q, log_prob, temperature).mean()
            return total, None

        adam = optax.adam(self.bpql.actor_learning_rate)
        actor, opt_state, _, _ = descend(adam, loss, state.actor, state.actor_opt_state)
        return state._replace(actor=actor, actor_opt_state=opt_state)

    def weight(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Return w(t), which is constant at first, then falls linearly to 0 and stays there."""
        return self.pull_weight * annealed(step, self.pull_hold * self.run_steps, self.pull_end * self.run_steps)
