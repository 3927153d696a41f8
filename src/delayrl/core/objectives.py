"""Objectives on arrays, not networks: what is minimised, each with its equation."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from delayrl.core.networks import Gaussian


def k_step_return(
    reward: Float[Array, "*batch ahead"], discount: float, steps: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Σ_{j<k} γ^j r_{t+j}, with k = `steps` for each sample."""
    j = jnp.arange(reward.shape[-1])
    return jnp.where(j < steps[..., None], discount**j * reward, 0).sum(-1)


def soft_target(
    reward: Float[Array, "*batch"],
    discount: Float[Array, "*batch"],
    terminated: Bool[Array, "*batch"],
    next_value: Float[Array, "*batch"],
) -> Float[Array, "*batch"]:
    """Y = R + γ^k (1 - terminated) V(s_{t+k}) (VDPO eq. 8, with k steps); a time limit is no termination."""
    return reward + discount * jnp.where(terminated, 0, next_value)


def soft_value(
    q: Float[Array, "2 *batch"], log_prob: Float[Array, "*batch"], temperature: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """V = min_i Q_i(s, a) - α log π(a|s), a ~ π (SAC). Its negative mean is the actor's loss (VDPO eq. 9)."""
    return q.min(0) - temperature * log_prob


def temperature_loss(
    log_temperature: Float[Array, ""], log_prob: Float[Array, "*batch"], target_entropy: float
) -> Float[Array, ""]:
    """-α (log π + H̄): α rises while the entropy is below H̄ (SAC, eq. 18)."""
    return -(jnp.exp(log_temperature) * (log_prob + target_entropy)).mean()


def gaussian_kl(p: Gaussian, q: Gaussian) -> Float[Array, "*batch action"]:
    """KL(p‖q) of diagonal Gaussians, each dimension by itself. Squashing both by tanh leaves it as it is."""
    variance, difference = jnp.exp(2 * p.log_std), p.mean - q.mean
    return q.log_std - p.log_std + (variance + difference**2) / (2 * jnp.exp(2 * q.log_std)) - 0.5


def masked_mean(x: Float[Array, "*batch"], mask: Bool[Array, "*batch"]) -> Float[Array, ""]:
    """Mean over all entries, with the masked ones as zeros in it (as the released code of VDPO)."""
    return jnp.where(mask, x, 0).mean()
