"""Equations on numbers small enough to check by hand, and against quadrature."""

import jax.numpy as jnp
import numpy as np
from scipy import integrate, stats

from delayrl.core import objectives
from delayrl.core.networks import Gaussian


def test_k_step_return() -> None:
    """1 + 0.5·2 + 0.25·4 = 3 for k = 3."""
    reward = jnp.array([[1.0, 2.0, 4.0]] * 3)
    np.testing.assert_allclose(objectives.k_step_return(reward, 0.5, jnp.array([1, 2, 3])), [1.0, 2.0, 3.0])


def test_soft_target() -> None:
    """3 + 0.125·8 = 4; a terminated step has no future."""
    y = objectives.soft_target(
        jnp.array([3.0, 3.0]), jnp.array([0.125, 0.125]), jnp.array([False, True]), jnp.array([8.0, 8.0])
    )
    np.testing.assert_allclose(y, [4.0, 3.0])


def test_soft_value() -> None:
    """min(2, 5) - 0.5·(-4) = 4."""
    value = objectives.soft_value(jnp.array([[2.0], [5.0]]), jnp.array([-4.0]), jnp.array(0.5))
    np.testing.assert_allclose(value, [4.0])


def test_temperature_rises_while_entropy_is_low() -> None:
    """Entropy -2 (log π = 2) under a target of -1: -e^0 (2 - 1) = -1, falling in α."""
    loss = objectives.temperature_loss(jnp.array(0.0), jnp.array([2.0]), -1.0)
    np.testing.assert_allclose(loss, -1.0)
    assert objectives.temperature_loss(jnp.array(0.1), jnp.array([2.0]), -1.0) < loss


def test_gaussian_kl() -> None:
    """Against quadrature, both directions; zero for equal ones."""
    p, q = Gaussian(jnp.array([0.3]), jnp.array([-0.5])), Gaussian(jnp.array([-0.8]), jnp.array([0.4]))
    for a, b in ((p, q), (q, p), (p, p)):
        f, g = (stats.norm(float(x.mean[0]), float(np.exp(x.log_std[0]))) for x in (a, b))
        exact, _ = integrate.quad(lambda x, f=f, g=g: f.pdf(x) * (f.logpdf(x) - g.logpdf(x)), -12, 12)
        np.testing.assert_allclose(objectives.gaussian_kl(a, b), [exact], atol=1e-5)


def test_masked_mean() -> None:
    np.testing.assert_allclose(objectives.masked_mean(jnp.array([4.0, 100.0]), jnp.array([True, False])), 2.0)
