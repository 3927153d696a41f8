"""Auxiliary-delayed SAC (Wu et al., "Boosting reinforcement learning with strongly delayed feedback", ICML 2024).

Idea: values of the augmented state x_t are hard to learn, since it grows with the delay Δ. So learn them for a shorter,
auxiliary delay τ < Δ, together with an actor that acts under τ; and improve the actor that must live with Δ by those
values. The critics' target is the lower of the two actors' values, each from one of the two target critics.

Views: the augmented actor sees x_t; the auxiliary actor and the critics see x^τ_t, which for τ = 0 is s_t. While it
trains, its behaviour reads s_t (privileged) where τ = 0, unless `behaviour="augmented"`; for τ > 0 it does not.

Deviations from the paper and from the released code are numbered in docs/algorithms/ad-sac.md.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents import sac
from delayrl.agents.base import Agent, Deterministic, Phase
from delayrl.core import networks
from delayrl.core.networks import Params
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import network_input, view
from delayrl.errors import DelayRLError

Behaviour = Literal["lower-q", "augmented"]


class State(NamedTuple):
    """The auxiliary learner, with the critics; and beside it the augmented actor, with a temperature of its own."""

    auxiliary: sac.State
    actor: Params
    log_temperature: Float[Array, ""]
    actor_opt_state: optax.OptState
    temperature_opt_state: optax.OptState


class Inputs(NamedTuple):
    """What both actors see at the same step."""

    auxiliary: Float[Array, "batch short"]
    augmented: Float[Array, "batch long"]


@dataclass(frozen=True)
class ADSAC:
    """Hyperparameters; the defaults are the released code's."""

    learner: sac.SAC = field(default_factory=lambda: sac.SAC(actor_sees="augmented", critic_sees="augmented"))
    auxiliary_delay: Annotated[int, "τ: the delay for which values are learned, at most the task's"] = 0
    behaviour: Annotated[Behaviour, "who acts in training: the sample with the lower Q (τ = 0), or that"] = "lower-q"
    evaluation: Annotated[Literal["mode", "sample"], "which action is evaluated; the released code samples"] = "mode"

    @property
    def privileged(self) -> bool:
        """The auxiliary actor needs the true state to act; a state of age τ > 0 is not shown to anyone."""
        return self.behaviour == "lower-q" and self.auxiliary_delay == 0

    def ahead(self, spec: Spec) -> int:
        """k-step targets, as SAC's."""
        return self.learner.ahead(spec)

    def phases(self) -> tuple[Phase, ...]:
        """One: the update."""
        return (self.learner.phases()[0]._replace(update=self.update),)

    def reference_policy(self, state: State) -> tuple[Agent, Any] | None:
        """The auxiliary actor, where it is free of delay."""
        return (self.learner, state.auxiliary) if self.auxiliary_delay == 0 else None

    def init(self, spec: Spec, key: Key) -> State:
        """Fresh networks: SAC's for the delay τ, and an actor for the task's."""
        if self.auxiliary_delay > spec.delay:
            raise DelayRLError(
                f"ad-sac's auxiliary_delay must be no longer than the delay {spec.delay}; got {self.auxiliary_delay}"
            )
        auxiliary_key, augmented_key = jax.random.split(key)
        auxiliary = self.learner.init(replace(spec, delay=self.auxiliary_delay), auxiliary_key)
        own = self.learner.init(spec, augmented_key)
        return State(auxiliary, own.actor, own.log_temperature, own.actor_opt_state, own.temperature_opt_state)

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """The augmented actor; in training, who acts is what `behaviour` says."""
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
        return networks.lower_q(state.auxiliary.critic, truth, auxiliary, augmented)

    def deterministic(self, state: State) -> Deterministic:
        """The augmented actor, its mode: also where `evaluation` samples."""
        return Deterministic("augmented", state.actor)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """One critic update; every `actor_every`-th time rounds of a coin's choice of actor, and both temperatures."""
        auxiliary_key, augmented_key, actor_key = jax.random.split(key, 3)
        now, later = self.inputs(windows, 0), self.inputs(windows, windows.n_step)
        temperatures = {
            "temperature": jnp.exp(state.log_temperature),
            "auxiliary_temperature": jnp.exp(state.auxiliary.log_temperature),
        }
        next_value, entropies = self.next_value(state, later, auxiliary_key, augmented_key)
        auxiliary, metrics = self.learner.learn_critic(state.auxiliary, windows, now.auxiliary, next_value)
        state = jax.lax.cond(
            count % self.learner.actor_every == self.learner.actor_every - 1,
            lambda state: self._improve(state, now, windows.action.shape[-1], actor_key),
            lambda state: state,
            state._replace(auxiliary=auxiliary),
        )
        return state, metrics | entropies | temperatures

    def next_value(
        self, state: State, later: Inputs, auxiliary_key: Key, augmented_key: Key
    ) -> tuple[Float[Array, " batch"], Metrics]:
        """V(x^τ_{t+k}): the minimum over pairs of an actor and a target critic; and the entropies of the actors.

        min( Q̄_1(x^τ, a^τ) - α_τ log π_τ(a^τ|x^τ),  Q̄_2(x^τ, a) - α log π(a|x) ),  a^τ ~ π_τ(·|x^τ), a ~ π(·|x).
        """
        values, entropies = [], []
        learners = (
            (state.auxiliary, later.auxiliary, auxiliary_key),
            (augmented_learner(state), later.augmented, augmented_key),
        )
        for i, (learner, x, key) in enumerate(learners):
            action, log_prob = networks.sample(self.learner.policy(learner.actor, x), key)
            q = networks.twin(state.auxiliary.target, later.auxiliary, action)[i]
            values.append(q - jnp.exp(learner.log_temperature) * log_prob)
            entropies.append(-log_prob.mean())
        return jnp.minimum(*values), {"auxiliary_entropy": entropies[0], "entropy": entropies[1]}

    def inputs(self, windows: Window, ahead: int | Array) -> Inputs:
        """x^τ and x, `ahead` steps after t, for each window."""

        def of_window(window: Window, k: Array) -> Inputs:
            pair = (view(window, k, delay) for delay in (self.auxiliary_delay, None))
            return Inputs(*(network_input(seen, "augmented") for seen in pair))

        return jax.vmap(of_window)(windows, jnp.broadcast_to(ahead, windows.n_step.shape))

    def _improve(self, state: State, now: Inputs, action_size: int, key: Key) -> State:
        """Rounds of one actor's improvement, and of both temperatures' adjustment; all by the values of x^τ."""
        for update_key in jax.random.split(key, self.learner.actor_updates):
            coin_key, policy_key, auxiliary_key, augmented_key = jax.random.split(update_key, 4)
            state = jax.lax.cond(
                jax.random.bernoulli(coin_key),
                lambda state, key: self.improve_auxiliary(state, now, key),
                lambda state, key: self.improve_augmented(state, now, key),
                state,
                policy_key,
            )
            auxiliary = self.learner.adjust_temperature(state.auxiliary, now.auxiliary, action_size, auxiliary_key)
            own = self.learner.adjust_temperature(augmented_learner(state), now.augmented, action_size, augmented_key)
            state = with_augmented(state._replace(auxiliary=auxiliary), own)
        return state

    def improve_auxiliary(self, state: State, now: Inputs, key: Key) -> State:
        """One step of the auxiliary actor."""
        return state._replace(auxiliary=self.learner.improve_actor(state.auxiliary, now.auxiliary, now.auxiliary, key))

    def improve_augmented(self, state: State, now: Inputs, key: Key) -> State:
        """One step of the augmented actor."""
        return with_augmented(
            state, self.learner.improve_actor(augmented_learner(state), now.augmented, now.auxiliary, key)
        )


def augmented_learner(state: State) -> sac.State:
    """The augmented actor as a learner of SAC's: with the critics that it shares."""
    own = state._asdict()
    del own["auxiliary"]
    return state.auxiliary._replace(**own)


def with_augmented(state: State, learner: sac.State) -> State:
    """The state with what is the augmented actor's own in `learner`."""
    return State(state.auxiliary, *(getattr(learner, name) for name in State._fields[1:]))
