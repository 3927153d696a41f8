"""The Gaussians that minimise either direction of the KL to a belief over Gaussians, in closed form."""

import numpy as np
from tabular import Array


def gaussian_kl(mean: Array, variance: Array, other_mean: Array, other_variance: Array) -> Array:
    """Return KL(N(mean, variance) ‖ N(other_mean, other_variance)), diagonal, summed over the last axis."""
    ratio = variance / other_variance
    return 0.5 * (ratio - 1 - np.log(ratio) + (mean - other_mean) ** 2 / other_variance).sum(axis=-1)


def moment_match(weight: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return the diagonal Gaussian q that minimises the forward objective E KL(N(μ_s, σ_s²) ‖ q).

    It has the mean and the variances of the mixture: E[μ_s] and E[σ_s² + μ_s²] - E[μ_s]².

    Args:
        weight: Belief over the N Gaussians, shape (N,).
        mean: μ_s, shape (N, D).
        variance: σ_s², shape (N, D).

    Returns:
        Mean and variance of q, both of shape (D,).
    """
    centre = weight @ mean
    return centre, weight @ (variance + (mean - centre) ** 2)


def precision_weighted(weight: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return the diagonal Gaussian q that minimises the reverse objective E KL(q ‖ N(μ_s, σ_s²)).

    It is the normalised geometric mean of the Gaussians: 1/σ² = E[1/σ_s²] and μ = σ² E[μ_s/σ_s²].

    Args:
        weight: Belief over the N Gaussians, shape (N,).
        mean: μ_s, shape (N, D).
        variance: σ_s², shape (N, D).

    Returns:
        Mean and variance of q, both of shape (D,).
    """
    joint_variance = 1 / (weight @ (1 / variance))
    return joint_variance * (weight @ (mean / variance)), joint_variance
