"""Delay-correcting actor-critic, DC/AC (Bouteiller, Ramstedt et al., ICLR 2021).

Idea: what arrives during the next Δ steps was caused by actions already taken. A stretch of past experience therefore
stays valid when its actions are sampled again from the current policy, inside the augmented states. Values V(x) are
learned on these on-policy stretches with targets of up to Δ steps; the actor's gradient flows through the new actions.

Views: actor and critics see x_t. Unprivileged.

Length of a stretch: x_{t+i} shows the state of step c_i = t + i - d_{t+i}. While d_{t+i} ≥ i, that step is ≤ t, so it
does not depend on the actions of t and later; nor do the rewards that arrive with it, r_j for c_{i-1} ≤ j < c_i. The
sum therefore stops after n = max{i : d_{t+1} ≥ 1, …, d_{t+i} ≥ i} steps. With a constant delay n = Δ, also at an
episode's start, where d grows by one per step and nothing arrives.

Deviations from the paper and from the released code are numbered in docs/algorithms/dcac.md.
"""

import functools
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from delayrl.agents.base import Deterministic, Phase, descend
from delayrl.core import networks
from delayrl.core.networks import Gaussian, Params
from delayrl.core.objectives import k_step_return, soft_target, squared_errors, temperature_loss
from delayrl.core.types import Action, Key, Metrics, Seen, Spec, Window
from delayrl.core.views import input_size, look, network_input
from delayrl.errors import DelayRLError

TEMPERATURE_RATE = 1e-3
"""Adam's step size for a learned temperature, that of the other agents in the preset `matched`."""


class State(NamedTuple):
    """Actor, critics, target critics, the optimiser state that actor and critics share, a learned temperature's."""

    actor: Params
    critic: Params
    target: Params
    opt_state: optax.OptState
    log_temperature: Float[Array, ""] | None = None
    temperature_opt_state: optax.OptState | None = None


class Roll(NamedTuple):
    """A stretch with re-sampled actions, from `x`, whose value is learned, to `x_last`, `steps` steps later."""

    x: Float[Array, "*batch input"]
    x_last: Float[Array, "*batch input"]
    reward: Float[Array, "*batch delay"]  # arriving at each step; only the first `steps` entries count
    log_prob: Float[Array, "*batch delay"]
    steps: Int[Array, "*batch"]
    ended: Bool[Array, "*batch"]  # x_last shows the terminal state: its value is 0


@dataclass(frozen=True)
class DCAC:
    """The DC/AC agent. Its hyperparameters default to the released code's."""

    hidden: Annotated[tuple[int, ...], "widths of the hidden layers of actor and critics"] = (256, 256)
    learning_rate: Annotated[float, "Adam's step size, for actor and critics together", (0.0, 1.0)] = 3e-4
    actor_share: Annotated[float, "weight w of the actor's loss; the critics' loss has 1 - w", (0.0, 1.0)] = 0.2
    reward_scale: Annotated[float, "factor on the rewards"] = 5.0
    temperature: Annotated[Literal["fixed", "learned"], "whether the entropy's weight is learned, as in SAC"] = "fixed"
    entropy_scale: Annotated[float, "weight of the entropy, the initial one if it is learned"] = 1.0
    discount: Annotated[float, "γ", (0.0, 1.0)] = 0.99
    target_rate: Annotated[float, "τ: rate at which the target critics follow the critics", (0.0, 1.0)] = 5e-3
    log_std_range: Annotated[tuple[float, float], "bounds of the policy's log standard deviation"] = (-20.0, 2.0)
    batch_size: Annotated[int, "windows per batch"] = 128

    privileged = False

    def ahead(self, spec: Spec) -> int:
        """Return the longest possible stretch, Δ steps."""
        return max(spec.delay, 1)

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase: an update at every step."""
        return (Phase(1, 1, self.batch_size, self.update),)

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise the networks. The target critics start as copies."""
        if spec.delay < 1:
            raise DelayRLError("dcac re-samples the actions that a delay of at least 1 step hides: give --delay N")
        actor_key, critic_key = jax.random.split(key)
        size = input_size(spec, "augmented")
        actor = networks.mlp_init(actor_key, (size, *self.hidden, 2 * spec.action_size))
        critic = networks.twin_init(critic_key, (size, *self.hidden, 1))
        adam = optax.adam(self.learning_rate)
        state = State(actor, critic, jax.tree.map(jnp.copy, critic), adam.init((actor, critic)))
        if self.temperature == "fixed":
            return state
        if self.entropy_scale <= 0:
            raise DelayRLError(f"a learned temperature starts above 0: entropy_scale must; got {self.entropy_scale}")
        log_temperature = jnp.log(jnp.asarray(self.entropy_scale, jnp.float32))
        opt_state = optax.adam(TEMPERATURE_RATE).init(log_temperature)
        return state._replace(log_temperature=log_temperature, temperature_opt_state=opt_state)

    def policy(self, actor: Params, x: Float[Array, "*batch input"]) -> Gaussian:
        """Return the actor's Gaussian at inputs `x`."""
        return networks.gaussian(actor, x, self.log_std_range, "clip")

    def act(self, state: State, seen: Seen, key: Key, *, explore: bool) -> Action:
        """Sample the policy, or return its mode."""
        policy = self.policy(state.actor, network_input(seen, "augmented"))
        return networks.sample(policy, key)[0] if explore else networks.mode(policy)

    def deterministic(self, state: State) -> Deterministic:
        """Return the actor."""
        return Deterministic("augmented", state.actor)

    def update(self, state: State, windows: Window, key: Key, count: Int[Array, ""]) -> tuple[State, Metrics]:
        """Update actor and critics in one gradient step, then the target critics and a learned temperature."""
        adam, params = optax.adam(self.learning_rate), (state.actor, state.critic)
        temperature = self.entropy_scale if state.log_temperature is None else jnp.exp(state.log_temperature)
        batch = state.target, windows, key, temperature
        (actor, critic), opt_state, _, metrics = descend(adam, self.loss, params, state.opt_state, *batch)
        target = optax.incremental_update(critic, state.target, self.target_rate)
        state = state._replace(actor=actor, critic=critic, target=target, opt_state=opt_state)
        if state.log_temperature is None:
            return state, metrics

        def loss(log_temperature: Array) -> tuple[Array, None]:
            return temperature_loss(log_temperature, -metrics["entropy"], -float(windows.action.shape[-1])), None

        adam, old = optax.adam(TEMPERATURE_RATE), (state.log_temperature, state.temperature_opt_state)
        new = descend(adam, loss, *old)[:2]
        known = metrics["target_steps"] > 0  # else the batch has no step, and no entropy
        log_temperature, opt_state = jax.tree.map(functools.partial(jnp.where, known), new, old)
        state = state._replace(log_temperature=log_temperature, temperature_opt_state=opt_state)
        return state, metrics | {"temperature": temperature}

    def loss(
        self,
        params: tuple[Params, Params],
        target: Params,
        windows: Window,
        key: Key,
        temperature: Float[Array, ""] | float,
    ) -> tuple[Array, Metrics]:
        """Return the weighted sum of the critics' squared error and the actor's negative soft value, and metrics."""
        actor, critic = params
        rolls = self.roll(actor, windows, key)
        y = self.soft_return(rolls, self.reward_scale, temperature, values(target, rolls.x_last))
        value = values(critic, jax.lax.stop_gradient(rolls.x))
        critic_loss = squared_errors(value, y)
        # without the rewards of a stretch, which do not depend on its new actions
        frozen = jax.lax.stop_gradient(critic)
        actor_loss = -self.soft_return(rolls, 0.0, temperature, values(frozen, rolls.x_last)).mean()
        summed = jnp.arange(windows.delay) < rolls.steps[:, None]
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            "value": value.mean(),
            "entropy": -jnp.where(summed, rolls.log_prob, 0).sum() / jnp.maximum(summed.sum(), 1),
            "target_steps": rolls.steps.mean(dtype=jnp.float32),
        }
        return self.actor_share * actor_loss + (1 - self.actor_share) * critic_loss, metrics

    def soft_return(
        self, rolls: Roll, reward_scale: float, temperature: Float[Array, ""] | float, value: Float[Array, "2 batch"]
    ) -> Float[Array, " batch"]:
        """Return Σ_{i<n} γ^i (reward - α log π) + γ^n (1 - ended) min_j V_j(x_n), with each sample's own n."""
        reward = reward_scale * rolls.reward - temperature * rolls.log_prob
        return soft_target(
            k_step_return(reward, self.discount, rolls.steps), self.discount**rolls.steps, rolls.ended, value.min(0)
        )

    def roll(self, actor: Params, windows: Window, key: Key) -> Roll:
        """Re-sample the actions of each window from the current policy (the paper's partial trajectory re-sampling).

        It starts at t. If a window terminates at T, half of the time it starts there, to learn the value at t + Δ:
        the terminal state arrives only at T + Δ, and re-sampled stretches lead to the x before it, which need values.
        """
        delay = windows.delay
        coin_key, policy_key = jax.random.split(key)
        over = windows.terminated.any(-1)
        from_end = over & jax.random.bernoulli(coin_key, shape=over.shape)
        windows = jax.vmap(shift)(windows, jnp.where(from_end, windows.lead, 0))

        def step(actions: Array, now: tuple[Array, Key]) -> tuple[Array, Array]:
            i, key = now
            x = jax.vmap(lambda window: look(window, "augmented", i))(replace(windows, action=actions))
            action, log_prob = networks.sample(self.policy(actor, x), key)
            return actions.at[:, delay + i].set(action), log_prob

        actions, log_prob = jax.lax.scan(step, windows.action, (jnp.arange(delay), jax.random.split(policy_key, delay)))
        windows = replace(windows, action=actions)
        return jax.vmap(stretch)(windows, log_prob.T, from_end)


def stretch(window: Window, log_prob: Float[Array, " delay"], from_end: Bool[Array, ""]) -> Roll:
    """Return the stretch of a window whose actions have been re-sampled, from their log-densities."""
    delay, slots, over = window.delay, jnp.arange(window.delay), window.terminated.any()
    # ages are known up to the window's last row, and after a termination, when nothing more arrives
    true_still = (window.age[delay + 1 :] > slots) & ((slots < window.lead) | over)
    steps = jnp.cumprod(true_still.astype(jnp.int32)).sum()
    newest = delay + jnp.arange(delay + 1) - window.age[delay:]
    received = jnp.concatenate([jnp.zeros(1), jnp.cumsum(window.reward)])  # [c]: sum of the rewards before r_c
    first = jnp.where(from_end, delay - window.lead, 0)
    x, x_last = (look(window, "augmented", i) for i in (first, steps))
    return Roll(
        x,
        x_last,
        jnp.roll(jnp.diff(received[newest]), -first),
        jnp.roll(log_prob, -first),
        steps - first,
        from_end,
    )


def shift(window: Window, by: Int[Array, ""]) -> Window:
    """Return the window around t + `by`. Nothing arrives after its last row, so the age grows, at most to Δ."""
    rows = by + jnp.arange(window.age.shape[0])
    last = window.delay + window.lead
    held = jnp.minimum(rows, window.age.shape[0] - 1)
    age = jnp.where(rows <= last, window.age[held], jnp.minimum(window.age[last] + rows - last, window.delay))
    return replace(window, obs=window.obs[held], age=age, action=window.action[held], reward=window.reward[held])


def values(critic: Params, x: Float[Array, "*batch input"]) -> Float[Array, "2 *batch"]:
    """Return both critics' V(x)."""
    return jnp.stack([networks.mlp(params, x)[..., 0] for params in critic])
