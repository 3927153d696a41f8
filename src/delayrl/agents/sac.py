"""Soft actor-critic with a view for each network: SAC, memoryless SAC, A-SAC and BPQL share one update.

Papers: SAC (Haarnoja et al. 2018); A-SAC and BPQL (Kim et al. 2023), named as in VDPO's tables. Idea: a soft Q-learner
with an entropy-regularised actor. The actor's view limits what it can do under delay; the critics' view sets the size
of the space in which values are learned.

| agent | actor sees | critic sees |
| --- | --- | --- |
| sac (the delay-free reference) | s_t | s_t |
| sac-memoryless | s_{t-Δ} | s_{t-Δ} |
| a-sac | x_t | x_t |
| bpql | x_t | s_t |

Deviations are numbered in docs/algorithms/sac.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents.base import Deterministic, Phase, descend
from delayrl.agents.critics import CriticNorm, critics_init, learn_in_one_pass, q_values
from delayrl.core import networks
from delayrl.core.networks import Gaussian, LogStdBounds, Params
from delayrl.core.objectives import k_step_target, soft_value, squared_errors, temperature_loss
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import Sees, input_size, look, network_input
from delayrl.errors import DelayRLError


class State(NamedTuple):
    """Actor, critics, target critics or, with batch norm, running moments, log-temperature, optimiser states."""

    actor: Params
    critic: Params
    target: Params
    log_temperature: Float[Array, ""]
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    temperature_opt_state: optax.OptState


EntropyUnit = Literal["scaled", "task"]
ImproveActor = Callable[[State, Array, Array, Key], State]
"""One step of the actor, given the inputs of actor and critics: agents built on SAC may have their own."""
Penalty = Callable[[Params, Gaussian], Array]
"""A term that agents built on SAC add to the actor's loss: of the actor and its policy on the batch."""


def no_penalty(actor: Params, policy: Gaussian) -> Array:
    """Return 0: SAC itself adds nothing to the actor's loss."""
    return jnp.zeros(())


@dataclass(frozen=True)
class SAC:
    """The SAC agent. Its hyperparameters default to VDPO's (appendix, table of hyperparameters)."""

    actor_sees: Annotated[Sees, "fixed"] = "current"
    critic_sees: Annotated[Sees, "fixed"] = "current"
    hidden: Annotated[tuple[int, ...], "widths of the hidden layers of actor and critics"] = (256, 256)
    critic_norm: Annotated[CriticNorm, "norm in the critics: layer, or batch without target critics"] = "none"
    actor_learning_rate: Annotated[float, "Adam's step size for the actor", (0.0, 1.0)] = 3e-4
    critic_learning_rate: Annotated[float, "Adam's step size for the critics", (0.0, 1.0)] = 1e-3
    temperature_learning_rate: Annotated[float, "Adam's step size for the temperature", (0.0, 1.0)] = 1e-3
    initial_temperature: Annotated[float, "initial weight of the entropy", (1e-6, 1e6)] = 1.0
    entropy_per_action: Annotated[float, "target entropy per action dimension"] = -1.0
    entropy_unit: Annotated[EntropyUnit, "unit of actions for entropies: scaled to [-1, 1], or the task's"] = "task"
    discount: Annotated[float, "γ", (0.0, 1.0)] = 0.99
    target_rate: Annotated[float, "τ: rate at which target critics, if any, follow the critics", (0.0, 1.0)] = 5e-3
    n_steps: Annotated[int, "longest k of the k-step targets; k is drawn from 1..n_steps"] = 3
    actor_every: Annotated[int, "critic updates between rounds of actor updates"] = 2
    actor_updates: Annotated[int, "actor updates per round"] = 2
    log_std_range: Annotated[tuple[float, float], "bounds of the policy's log standard deviation"] = (-5.0, 2.0)
    log_std_bounds: Annotated[LogStdBounds, "how the log standard deviation is kept within its bounds"] = "rescale"
    batch_size: Annotated[int, "windows per batch"] = 256
    update_every: Annotated[int, "environment steps between rounds of updates"] = 1
    updates: Annotated[int, "updates per round"] = 1
    actor_network: Annotated[networks.Network, "fixed"] = networks.mlp  # agents built on SAC may have another

    privileged = False

    def ahead(self, spec: Spec) -> int:
        """Return the longest k of the k-step targets."""
        return self.n_steps

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase, the update."""
        return (Phase(self.update_every, self.updates, self.batch_size, self.update),)

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise the networks. The target critics start as copies; critics with batch norm have none."""
        if self.actor_sees == "current" and spec.delay > 0:
            raise DelayRLError(
                f"sac is the delay-free reference: train it with --delay 0, got {spec.delay}; "
                "sac-memoryless, a-sac and bpql take a delay"
            )
        actor_key, critic_key = jax.random.split(key)
        sizes = (input_size(spec, self.actor_sees), *self.hidden, 2 * spec.action_size)
        actor = networks.mlp_init(actor_key, sizes)
        sizes = (input_size(spec, self.critic_sees) + spec.action_size, *self.hidden, 1)
        critic, target = critics_init(critic_key, sizes, self.critic_norm)
        log_temperature = jnp.log(jnp.asarray(self.initial_temperature, jnp.float32))
        return State(
            actor,
            critic,
            target,
            log_temperature,
            optax.adam(self.actor_learning_rate).init(actor),
            optax.adam(self.critic_learning_rate).init(critic),
            optax.adam(self.temperature_learning_rate).init(log_temperature),
        )

    def policy(self, actor: Params, x: Float[Array, "*batch input"]) -> Gaussian:
        """Return the actor's Gaussian at inputs `x`."""
        return networks.gaussian(actor, x, self.log_std_range, self.log_std_bounds, self.actor_network)

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Sample the policy, or return its mode."""
        policy = self.policy(state.actor, network_input(seen, self.actor_sees))
        return networks.sample(policy, key)[0] if explore else networks.mode(policy)

    def deterministic(self, state: State) -> Deterministic:
        """Return the actor."""
        return Deterministic(self.actor_sees, state.actor)

    def update(
        self, state: State, windows: Window, key: Key, count: Int[Array, ""], improve_actor: ImproveActor | None = None
    ) -> tuple[State, Metrics]:
        """Update the critics and, every `actor_every`-th time, the actor and the temperature on the same batch.

        `improve_actor` takes the place of SAC's own.
        """
        improve_actor = improve_actor or self.improve_actor
        target_key, actor_key = jax.random.split(key)
        actor_now, critic_now = self._inputs(windows, 0)
        actor_next, critic_next = self._inputs(windows, windows.n_step)

        temperature = jnp.exp(state.log_temperature)
        action, log_prob = networks.sample(self.policy(state.actor, actor_next), target_key)
        log_prob -= self.log_scale(windows)
        if self.critic_norm == "batch":
            options = {"learning_rate": self.critic_learning_rate, "discount": self.discount}
            state, metrics = learn_in_one_pass(state, windows, critic_now, critic_next, action, log_prob, **options)
        else:
            next_value = soft_value(networks.twin(state.target, critic_next, action), log_prob, temperature)
            state, metrics = self.learn_critic(state, windows, critic_now, next_value)

        def improve(state: State) -> State:
            for update_key in jax.random.split(actor_key, self.actor_updates):
                policy_key, temperature_key = jax.random.split(update_key)
                state = improve_actor(state, actor_now, critic_now, policy_key)
                state = self.adjust_temperature(state, actor_now, self.target_entropy(windows), temperature_key)
            return state

        state = jax.lax.cond(count % self.actor_every == self.actor_every - 1, improve, lambda state: state, state)
        return state, metrics | {"entropy": -log_prob.mean(), "temperature": temperature}

    def learn_critic(
        self, state: State, windows: Window, critic_input: Array, next_value: Float[Array, " batch"]
    ) -> tuple[State, Metrics]:
        """Update both critics towards the soft k-step target, given V(s_{t+k}), then the target critics."""
        y = k_step_target(windows, self.discount, next_value)

        def loss(critic: Params) -> tuple[Array, Array]:
            q = networks.twin(critic, critic_input, windows.action[:, windows.delay])
            return squared_errors(q, y), q.mean()

        adam = optax.adam(self.critic_learning_rate)
        critic, opt_state, value, q = descend(adam, loss, state.critic, state.critic_opt_state)
        target = optax.incremental_update(critic, state.target, self.target_rate)
        return state._replace(critic=critic, critic_opt_state=opt_state, target=target), {"critic_loss": value, "q": q}

    def improve_actor(
        self, state: State, actor_input: Array, critic_input: Array, key: Key, penalty: Penalty = no_penalty
    ) -> State:
        """Take one gradient step on the actor towards higher soft values (VDPO eq. 9)."""
        temperature = jnp.exp(state.log_temperature)

        def loss(actor: Params) -> tuple[Array, None]:
            policy = self.policy(actor, actor_input)
            action, log_prob = networks.sample(policy, key)
            value = soft_value(q_values(state.critic, state.target, critic_input, action), log_prob, temperature)
            return penalty(actor, policy) - value.mean(), None

        adam = optax.adam(self.actor_learning_rate)
        actor, opt_state, _, _ = descend(adam, loss, state.actor, state.actor_opt_state)
        return state._replace(actor=actor, actor_opt_state=opt_state)

    def log_scale(self, windows: Window) -> float:
        """Return by how much a log-density over actions in [-1, 1] exceeds that in the agent's unit of entropies."""
        return windows.log_scale if self.entropy_unit == "task" else 0.0

    def target_entropy(self, windows: Window) -> float:
        """Return the target entropy of actions scaled to [-1, 1]: -A (SAC), less where -A is meant in task units."""
        return self.entropy_per_action * windows.action.shape[-1] - self.log_scale(windows)

    def adjust_temperature(self, state: State, actor_input: Array, target_entropy: float, key: Key) -> State:
        """Take one gradient step on the temperature towards the target entropy, with a fresh sample of the policy."""
        _, log_prob = networks.sample(self.policy(state.actor, actor_input), key)

        def loss(log_temperature: Array) -> tuple[Array, None]:
            return temperature_loss(log_temperature, log_prob, target_entropy), None

        adam = optax.adam(self.temperature_learning_rate)
        log_temperature, opt_state, _, _ = descend(adam, loss, state.log_temperature, state.temperature_opt_state)
        return state._replace(log_temperature=log_temperature, temperature_opt_state=opt_state)

    def _inputs(self, windows: Window, ahead: int | Array) -> tuple[Array, Array]:
        """Return the inputs of actor and critics at `ahead` steps after t, for each window."""
        ahead = jnp.broadcast_to(ahead, windows.n_step.shape)
        pair = jax.vmap(lambda window, k: (look(window, self.actor_sees, k), look(window, self.critic_sees, k)))
        return pair(windows, ahead)


BPQL = SAC(
    actor_sees="augmented",
    critic_sees="current",
    critic_learning_rate=3e-4,
    temperature_learning_rate=3e-4,
    n_steps=1,
    actor_every=1,
    actor_updates=1,
    log_std_range=(-20.0, 2.0),
    log_std_bounds="clip",
    update_every=50,
    updates=50,
)
"""BPQL with the hyperparameters of its released code."""
