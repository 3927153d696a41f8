"""Auxiliary-delayed SAC (Wu et al., "Boosting reinforcement learning with strongly delayed feedback", ICML 2024).

Idea: the augmented state x_t grows with the delay Δ, so its values are hard to learn. AD-SAC learns values for a
shorter, auxiliary delay τ < Δ, together with an actor for τ, and improves the actor for Δ with those values. The
critics' target is the lower of the two actors' values, each from one of the two target critics.

Views: the augmented actor sees x_t; the auxiliary actor and the critics see x^τ_t, which is s_t for τ = 0. With τ = 0,
training is privileged (the behaviour reads s_t) unless `behaviour="augmented"`; with τ > 0 it is not.

Deviations from the paper and from the released code are numbered in docs/algorithms/ad-sac.md.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase
from delayrl.agents.critics import lower_q
from delayrl.core import networks
from delayrl.core.networks import Params
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import network_input, view
from delayrl.errors import DelayRLError

Behaviour = Literal["lower-q", "augmented"]


class State(NamedTuple):
    """The auxiliary learner with the shared critics, and the augmented actor with its own temperature."""

    auxiliary: sac.State
    actor: Params
    log_temperature: Float[Array, ""]
    actor_opt_state: optax.OptState
    temperature_opt_state: optax.OptState


class Inputs(NamedTuple):
    """The inputs of both actors at the same step."""

    auxiliary: Float[Array, "batch short"]
    augmented: Float[Array, "batch long"]


@dataclass(frozen=True)
class ADSAC:
    """The AD-SAC agent. Its hyperparameters default to the released code's."""

    learner: sac.SAC = field(default_factory=lambda: sac.SAC(actor_sees="augmented", critic_sees="augmented"))
    auxiliary_delay: Annotated[int, "τ: delay for which values are learned, at most the task's", (0, math.inf)] = 0
    behaviour: Annotated[
        Behaviour,
        "who acts in training: augmented, or lower-q (for τ = 0, the actor with the lower Q; else augmented)",
    ] = "lower-q"
    temperature_every: Annotated[int, "coins of a round from one update of both temperatures to the next"] = 1
    evaluation: Annotated[Literal["mode", "sample"], "action in evaluation; the released code samples"] = "mode"

    @property
    def privileged(self) -> bool:
        """Whether the auxiliary actor may act in training. It needs s_t; its input for τ > 0 is not available."""
        return self.behaviour == "lower-q" and self.auxiliary_delay == 0

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the k-step targets."""
        return self.learner.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase, the update."""
        return (self.learner.phases()[0]._replace(update=self.update),)

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """Return the auxiliary actor if it is delay-free (τ = 0)."""
        return (self.learner, state.auxiliary) if self.auxiliary_delay == 0 else None

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise SAC for the auxiliary delay τ, and an actor for the task's delay."""
        if self.auxiliary_delay > spec.delay:
            raise DelayRLError(
                f"ad-sac's auxiliary_delay must be no longer than the delay {spec.delay}; got {self.auxiliary_delay}"
            )
        if self.temperature_every > self.learner.actor_updates:
            raise DelayRLError(
                f"temperature_every must be at most actor_updates, {self.learner.actor_updates}, or no temperature is "
                f"ever updated; got {self.temperature_every}"
            )
        if self.learner.critic_norm == "batch":
            raise DelayRLError(
                "ad-sac learns from target critics, and with critic_norm=batch there are none; give none or layer"
            )
        auxiliary_key, augmented_key = jax.random.split(key)
        auxiliary = self.learner.init(replace(spec, delay=self.auxiliary_delay), auxiliary_key)
        own = self.learner.init(spec, augmented_key)
        return State(auxiliary, own.actor, own.log_temperature, own.actor_opt_state, own.temperature_opt_state)

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Return the augmented actor's action; in training, `behaviour` decides which actor acts."""
        auxiliary_key, augmented_key = jax.random.split(key)
        policy = self.learner.policy(state.actor, network_input(seen, "augmented"))
        augmented, _ = networks.sample(policy, augmented_key)
        if not explore:
            return networks.mode(policy) if self.evaluation == "mode" else augmented
        if not self.privileged:
            return augmented
        truth = seen.truth
        assert truth is not None, "behaviour with the auxiliary actor is privileged"
        auxiliary, _ = networks.sample(self.learner.policy(state.auxiliary.actor, truth), auxiliary_key)
        return lower_q(state.auxiliary.critic, state.auxiliary.target, truth, auxiliary, augmented)

    def deterministic(self, state: State) -> Deterministic:
        """Return the augmented actor. Its action is the mode, even if `evaluation` samples."""
        return Deterministic("augmented", state.actor)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update the critics and, every `actor_every`-th time, randomly chosen actors and both temperatures."""
        auxiliary_key, augmented_key, actor_key = jax.random.split(key, 3)
        now, later = self.inputs(windows, 0), self.inputs(windows, windows.n_step)
        temperatures = {
            "temperature": jnp.exp(state.log_temperature),
            "auxiliary_temperature": jnp.exp(state.auxiliary.log_temperature),
        }
        log_scale, target_entropy = self.learner.log_scale(windows), self.learner.target_entropy(windows)
        next_value, entropies = self.next_value(state, later, auxiliary_key, augmented_key, log_scale)
        auxiliary, metrics = self.learner.learn_critic(state.auxiliary, windows, now.auxiliary, next_value)
        state = jax.lax.cond(
            count % self.learner.actor_every == self.learner.actor_every - 1,
            lambda state: self._improve(state, now, target_entropy, actor_key, count),
            lambda state: state,
            state._replace(auxiliary=auxiliary),
        )
        return state, metrics | entropies | temperatures

    def next_value(
        self, state: State, later: Inputs, auxiliary_key: Key, augmented_key: Key, log_scale: float
    ) -> tuple[Float[Array, " batch"], Metrics]:
        """Return V(x^τ_{t+k}), the minimum over two pairs of actor and target critic, and the actors' entropies.

        min( Q̄_1(x^τ, a^τ) - α_τ log π_τ(a^τ|x^τ),  Q̄_2(x^τ, a) - α log π(a|x) ),  a^τ ~ π_τ(·|x^τ), a ~ π(·|x).
        """
        values, entropies = [], []
        learners = (
            (state.auxiliary, later.auxiliary, auxiliary_key),
            (augmented_learner(state), later.augmented, augmented_key),
        )
        for i, (learner, x, key) in enumerate(learners):
            action, log_prob = networks.sample(self.learner.policy(learner.actor, x), key)
            log_prob -= log_scale
            q = networks.twin(state.auxiliary.target, later.auxiliary, action)[i]
            values.append(q - jnp.exp(learner.log_temperature) * log_prob)
            entropies.append(-log_prob.mean())
        return jnp.minimum(*values), {"auxiliary_entropy": entropies[0], "entropy": entropies[1]}

    def inputs(self, windows: Window, ahead: int | Array) -> Inputs:
        """Return x^τ and x at `ahead` steps after t, for each window."""

        def of_window(window: Window, k: Array) -> Inputs:
            pair = (view(window, k, delay) for delay in (self.auxiliary_delay, None))
            return Inputs(*(network_input(seen, "augmented") for seen in pair))

        return jax.vmap(of_window)(windows, jnp.broadcast_to(ahead, windows.n_step.shape))

    def _improve(self, state: State, now: Inputs, target_entropy: float, key: Key, count: Int[Array, ""]) -> State:
        """Improve a randomly chosen actor `actor_updates` times, with the values of x^τ, and the temperatures as often.

        With `temperature_every` the temperatures are updated after every such coin alone.
        All seeds share the coins. With one for each, `jax.vmap` would compute both actors' updates and drop one.
        """
        coin_key = jax.random.fold_in(jax.random.key(0), count)
        coins = jax.random.bernoulli(coin_key, shape=(self.learner.actor_updates,))
        keys = jax.random.split(key, self.learner.actor_updates)
        for number, (coin, update_key) in enumerate(zip(coins, keys, strict=True), 1):
            policy_key, auxiliary_key, augmented_key = jax.random.split(update_key, 3)
            state = jax.lax.cond(
                coin,
                lambda state, key: self.improve_auxiliary(state, now, key),
                lambda state, key: self.improve_augmented(state, now, key),
                state,
                policy_key,
            )
            if number % self.temperature_every:
                continue
            adjust = self.learner.adjust_temperature
            auxiliary = adjust(state.auxiliary, now.auxiliary, target_entropy, auxiliary_key)
            own = adjust(augmented_learner(state), now.augmented, target_entropy, augmented_key)
            state = with_augmented(state._replace(auxiliary=auxiliary), own)
        return state

    def improve_auxiliary(self, state: State, now: Inputs, key: Key) -> State:
        """Take one gradient step on the auxiliary actor."""
        return state._replace(auxiliary=self.learner.improve_actor(state.auxiliary, now.auxiliary, now.auxiliary, key))

    def improve_augmented(self, state: State, now: Inputs, key: Key) -> State:
        """Take one gradient step on the augmented actor."""
        return with_augmented(
            state, self.learner.improve_actor(augmented_learner(state), now.augmented, now.auxiliary, key)
        )


def augmented_learner(state: State) -> sac.State:
    """Return the augmented actor and the shared critics as a state of SAC."""
    own = state._asdict()
    del own["auxiliary"]
    return state.auxiliary._replace(**own)


def with_augmented(state: State, learner: sac.State) -> State:
    """Return the state with the augmented actor, its temperature and its optimisers replaced by those of `learner`."""
    return State(state.auxiliary, *(getattr(learner, name) for name in State._fields[1:]))
