"""Losses and targets, each with its equation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from delayrl.core.networks import Gaussian
from delayrl.core.types import Window


def k_step_return(
    reward: Float[Array, "*batch ahead"], discount: float, steps: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Return Σ_{j<k} γ^j r_{t+j}, with k = `steps` for each sample."""
    j = jnp.arange(reward.shape[-1])
    return jnp.where(j < steps[..., None], discount**j * reward, 0).sum(-1)


def soft_target(
    reward: Float[Array, "*batch"],
    discount: Float[Array, "*batch"],
    terminated: Bool[Array, "*batch"],
    next_value: Float[Array, "*batch"],
) -> Float[Array, "*batch"]:
    """Return Y = R + γ^k (1 - terminated) V(s_{t+k}) (VDPO eq. 8, for k steps). A time limit is not a termination."""
    return reward + discount * jnp.where(terminated, 0, next_value)


def k_step_target(windows: Window, discount: float, next_value: Float[Array, " batch"]) -> Float[Array, " batch"]:
    """Return y = Σ_{j<k} γ^j r_{t+j} + γ^k (1 - terminated) V(s_{t+k}) of each window, with its own k (VDPO eq. 8)."""
    last = windows.delay + windows.n_step - 1
    return soft_target(
        k_step_return(windows.reward[:, windows.delay :], discount, windows.n_step),
        discount**windows.n_step,
        jnp.take_along_axis(windows.terminated, last[:, None], 1)[:, 0],
        next_value,
    )


def squared_errors(q: Float[Array, "2 batch"], target: Float[Array, " batch"]) -> Float[Array, ""]:
    """Return Σ_i mean (Q_i - y)², the loss of two critics. No gradient goes through y, the target."""
    return ((q - jax.lax.stop_gradient(target)) ** 2).mean(-1).sum()


def soft_value(
    q: Float[Array, "2 *batch"], log_prob: Float[Array, "*batch"], temperature: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """Return V = min_i Q_i(s, a) - α log π(a|s), a ~ π (SAC). Its negative mean is the actor's loss (VDPO eq. 9)."""
    return q.min(0) - temperature * log_prob


def temperature_loss(
    log_temperature: Float[Array, ""], log_prob: Float[Array, "*batch"], target_entropy: float
) -> Float[Array, ""]:
    """Return -α (log π + H̄). Minimising it raises α while the entropy is below H̄ (SAC, eq. 18)."""
    return -(jnp.exp(log_temperature) * (log_prob + target_entropy)).mean()


def annealed(step: Int[Array, ""], hold: int | float, end: int | float) -> Float[Array, ""]:
    """Return 1 up to step `hold`, from there on a line that falls to 0 at step `end`, and 0 after it."""
    return jnp.clip((end - step) / max(end - hold, 1), 0.0, 1.0)


def gaussian_kl(p: Gaussian, q: Gaussian) -> Float[Array, "*batch action"]:
    """Return KL(p‖q) of diagonal Gaussians for each dimension. Squashing both with tanh does not change it."""
    variance, difference = jnp.exp(2 * p.log_std), p.mean - q.mean
    return q.log_std - p.log_std + (variance + difference**2) / (2 * jnp.exp(2 * q.log_std)) - 0.5


def masked_mean(x: Float[Array, "*batch"], mask: Bool[Array, "*batch"]) -> Float[Array, ""]:
    """Return the mean over all entries, with those outside the mask set to 0 (as in VDPO's released code)."""
    return jnp.where(mask, x, 0).mean()
