"""Gaussian policies under a belief, docs/theory.md, section 4: closed forms against optimisers and grids."""

import numpy as np
import pytest
from gaussians import gaussian_kl, moment_match, precision_weighted
from scipy.optimize import minimize
from tabular import Array

seeds = pytest.mark.parametrize("seed", range(4))


def gaussian_references(seed: int) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.ones(5)), rng.normal(size=(5, 2)), np.exp(rng.normal(size=(5, 2)))


@seeds
@pytest.mark.parametrize("forward", [True, False])
def test_closed_forms_for_gaussians(seed: int, forward: bool) -> None:
    weight, mean, variance = gaussian_references(seed)

    def objective(parameters: Array) -> float:
        own_mean, own_variance = parameters[:2], np.exp(parameters[2:])
        if forward:
            return float(weight @ gaussian_kl(mean, variance, own_mean, own_variance))
        return float(weight @ gaussian_kl(own_mean, own_variance, mean, variance))

    found = minimize(objective, np.zeros(4), tol=1e-12).x
    best_mean, best_variance = (moment_match if forward else precision_weighted)(weight, mean, variance)
    np.testing.assert_allclose(found[:2], best_mean, atol=1e-4)
    np.testing.assert_allclose(np.exp(found[2:]), best_variance, rtol=1e-4)


@seeds
def test_gaussian_closed_forms_are_the_moments_of_the_two_means(seed: int) -> None:
    """On a grid: the forward minimiser has the mixture's moments, the reverse one is the geometric mean."""
    weight, mean, variance = gaussian_references(seed)
    mean, variance = mean[:, :1], variance[:, :1]
    grid = np.linspace(-30, 30, 20001)
    density = np.exp(-((grid - mean) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    for function, shape in ((moment_match, weight @ density), (precision_weighted, None)):
        if shape is None:
            shape = np.exp(weight @ np.log(np.maximum(density, 1e-300)))
        shape = shape / shape.sum()
        centre = shape @ grid
        best_mean, best_variance = function(weight, mean, variance)
        assert best_mean[0] == pytest.approx(centre, abs=1e-6)
        assert best_variance[0] == pytest.approx(shape @ (grid - centre) ** 2, rel=1e-6)


def test_equal_widths_differ_in_width_only() -> None:
    """Two references at ±1, equally wide and likely: both minimisers sit between them, on neither."""
    weight, mean, variance = np.array([0.5, 0.5]), np.array([[-1.0], [1.0]]), np.full((2, 1), 0.04)
    np.testing.assert_allclose(moment_match(weight, mean, variance), [[0.0], [1.04]], atol=1e-12)
    np.testing.assert_allclose(precision_weighted(weight, mean, variance), [[0.0], [0.04]], atol=1e-12)
    sharper = np.array([[0.01], [0.09]])
    np.testing.assert_allclose(precision_weighted(weight, mean, sharper), [[-0.8], [0.018]], atol=1e-12)
    np.testing.assert_allclose(moment_match(weight, mean, sharper), [[0.0], [1.05]], atol=1e-12)


def test_averaged_reverse_kl_does_not_seek_modes() -> None:
    """KL(q ‖ E_b[π]) picks one mode; E_b KL(q ‖ π), which VDPO minimises, sits between them."""
    grid = np.linspace(-4, 4, 4001)
    width = grid[1] - grid[0]

    def log_density(mean: float, deviation: float) -> Array:
        density: Array = -0.5 * ((grid - mean) / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
        return density

    left, right = log_density(-1.0, 0.2), log_density(1.0, 0.2)
    both = np.logaddexp(left, right) - np.log(2)

    def to_the_mixture(parameters: Array) -> float:
        own = log_density(parameters[0], np.exp(parameters[1]))
        return float((np.exp(own) * (own - both)).sum() * width)

    mode = minimize(to_the_mixture, np.array([0.3, -1.0]), tol=1e-10).x
    assert mode[0] == pytest.approx(1, abs=1e-3)
    assert np.exp(mode[1]) == pytest.approx(0.2, abs=1e-3)
    between, _ = precision_weighted(np.array([0.5, 0.5]), np.array([[-1.0], [1.0]]), np.full((2, 1), 0.04))
    assert between == pytest.approx(0)
