"""CrossQ's critics in any-age, BPQL and SAC without a delay: side arms of the ladder, and agents of one's own.

Paper: Bhatt et al., ICLR 2024. Batch norm before every layer of the critics takes the place of layer norm, and there
are no target critics: one pass over (s_t, a_t) and (s_{t+k}, a') gives values and targets, both normalised by the
moments of their mixture. Where only values are wanted, running moments take the place of the batch's.

One thing changes in the ladder, so the rest stays any-age's and is not CrossQ's: critics of the preset's width (there
2048), no batch norm in the actor, Adam's usual moments (there β1 = 0.5), k-step targets, as many steps of the actor as
of the critics (there a third). Its released code turns batch norm into renormalisation after 100,000 updates, which a
run of the ladder does not reach.

Run it in this folder: `delayrl bench run any-age-crossq.toml`.
"""

from dataclasses import dataclass, fields, replace
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from delayrl.agents.any_age import AnyAge
from delayrl.agents.base import descend
from delayrl.agents.registry import AGENTS, Preset, Registration
from delayrl.agents.sac import SAC, ImproveActor, State
from delayrl.core import networks
from delayrl.core.networks import Norm, Params
from delayrl.core.objectives import k_step_return, soft_target, soft_value
from delayrl.core.types import Key, Metrics, Spec, Window

EPSILON = 1e-3


class Moments(NamedTuple):
    """Mean and variance of each unit."""

    mean: Float[Array, " width"]
    variance: Float[Array, " width"]


def critic_init(key: Key, sizes: tuple[int, ...]) -> Params:
    """Return one critic's layers and, for the input of each, a scale of 1 and a shift of 0."""
    return {
        "layers": networks.mlp_init(key, sizes),
        "norms": [networks.layer_norm_init(size) for size in sizes[:-1]],
    }


def normalise(norm: Params, moments: Moments, x: Float[Array, "batch width"]) -> Float[Array, "batch width"]:
    """Return `x` with the moments taken out, scaled and shifted."""
    return (x - moments.mean) * jax.lax.rsqrt(moments.variance + EPSILON) * norm["scale"] + norm["shift"]


def in_training(critic: Params, x: Float[Array, "batch inputs"]) -> tuple[Float[Array, " batch"], list[Moments]]:
    """Return a critic's values on a batch that is normalised by its own moments, and these."""
    moments = []
    for number, (layer, norm) in enumerate(zip(critic["layers"], critic["norms"], strict=True)):
        x = jax.nn.relu(x) if number else x
        moments.append(Moments(x.mean(0), x.var(0)))
        x = networks.linear(layer, normalise(norm, moments[-1], x))
    return x[:, 0], moments


def folded(critic: Params, running: list[Moments]) -> Params:
    """Return the critic as an `mlp`: with fixed moments a norm is a part of the layer after it."""
    layers = []
    for layer, norm, moments in zip(critic["layers"], critic["norms"], running, strict=True):
        scale = norm["scale"] * jax.lax.rsqrt(moments.variance + EPSILON)
        shift = norm["shift"] - moments.mean * scale
        layers.append({"w": scale[:, None] * layer["w"], "b": layer["b"] + shift @ layer["w"]})
    return layers


@dataclass(frozen=True)
class CrossQ(SAC):
    """SAC with CrossQ's critics. The place of the target critics in the state holds the running moments."""

    critic_norm: Annotated[Norm, "fixed"] = "none"
    target_rate: Annotated[float, "fixed"] = 0.0
    momentum: Annotated[float, "rate at which the running moments stay as they are", (0.0, 1.0)] = 0.99

    def init(self, spec: Spec, key: Key) -> State:
        """Initialise as SAC, but for the critics."""
        state, critic_key = super().init(spec, key), jax.random.split(key)[1]
        sizes = (*(len(layer["w"]) for layer in state.critic[0]), 1)
        critic = [critic_init(key, sizes) for key in jax.random.split(critic_key)]
        running = [[Moments(jnp.zeros(size), jnp.ones(size)) for size in sizes[:-1]] for _ in critic]
        opt_state = optax.adam(self.critic_learning_rate).init(critic)
        return state._replace(critic=critic, target=running, critic_opt_state=opt_state)

    def update(
        self,
        state: State,
        windows: Window,
        key: Key,
        count: Int[Array, ""],
        improve_actor: ImproveActor | None = None,
    ) -> tuple[State, Metrics]:
        """Update the critics and, as often as SAC, the actor and the temperature."""
        improve_actor = improve_actor or self.improve_actor
        target_key, actor_key = jax.random.split(key)
        actor_now, critic_now = self._inputs(windows, 0)
        actor_next, critic_next = self._inputs(windows, windows.n_step)
        action, log_prob = networks.sample(self.policy(state.actor, actor_next), target_key)
        log_prob -= self.log_scale(windows)
        now = jnp.concatenate([critic_now, windows.action[:, windows.delay]], -1)
        state, metrics = self.learn_both(state, windows, now, jnp.concatenate([critic_next, action], -1), log_prob)

        def improve(state: State) -> State:
            trained, critic = state.critic, [folded(*pair) for pair in zip(state.critic, state.target, strict=True)]
            state = state._replace(critic=critic)
            for update_key in jax.random.split(actor_key, self.actor_updates):
                policy_key, temperature_key = jax.random.split(update_key)
                state = improve_actor(state, actor_now, critic_now, policy_key)
                state = self.adjust_temperature(state, actor_now, self.target_entropy(windows), temperature_key)
            return state._replace(critic=trained)

        state = jax.lax.cond(count % self.actor_every == self.actor_every - 1, improve, lambda state: state, state)
        return state, metrics | {"entropy": -log_prob.mean()}

    def learn_both(
        self,
        state: State,
        windows: Window,
        now: Float[Array, "batch inputs"],
        later: Float[Array, "batch inputs"],
        log_prob: Float[Array, " batch"],
    ) -> tuple[State, Metrics]:
        """Update the critics by one pass over (s_t, a_t) and (s_{t+k}, a'), and the running moments."""
        reward = k_step_return(windows.reward[:, windows.delay :], self.discount, windows.n_step)
        last = windows.delay + windows.n_step - 1
        terminated = jnp.take_along_axis(windows.terminated, last[:, None], 1)[:, 0]
        temperature = jnp.exp(state.log_temperature)

        def loss(critics: Params) -> tuple[Array, tuple[Array, list[list[Moments]]]]:
            passes = [in_training(critic, jnp.concatenate([now, later])) for critic in critics]
            q, next_q = jnp.split(jnp.stack([values for values, _ in passes]), 2, -1)
            next_value = soft_value(jax.lax.stop_gradient(next_q), log_prob, temperature)
            y = soft_target(reward, self.discount**windows.n_step, terminated, next_value)
            return ((q - y) ** 2).mean(-1).sum(), (q.mean(), [moments for _, moments in passes])

        adam = optax.adam(self.critic_learning_rate)
        critic, opt_state, value, (q, moments) = descend(adam, loss, state.critic, state.critic_opt_state)
        running = optax.incremental_update(moments, state.target, 1 - self.momentum)
        state = state._replace(critic=critic, target=running, critic_opt_state=opt_state)
        return state, {"critic_loss": value, "q": q, "temperature": temperature}


def with_crossq(agent: SAC) -> CrossQ:
    """Return the agent with CrossQ's critics in place of its own, and nothing else changed."""
    kept = {field.name for field in fields(SAC)} - {"critic_norm", "target_rate"}
    return CrossQ(**{name: getattr(agent, name) for name in kept})


def _changed(preset: Preset) -> Preset:
    agent = preset.agent
    if isinstance(agent, AnyAge):
        return preset._replace(agent=replace(agent, bpql=with_crossq(agent.bpql)))
    assert isinstance(agent, SAC)
    return preset._replace(agent=with_crossq(agent))


def _registered(name: str) -> Registration:
    presets = {preset: _changed(values) for preset, values in AGENTS[name].presets.items()}
    words = f"{name} with CrossQ's critics: batch norm, and no target critics"
    return Registration(words, "Bhatt et al., ICLR 2024", presets)


ANY_AGE, BPQL, DELAY_FREE = (_registered(name) for name in ("any-age", "bpql", "sac"))
