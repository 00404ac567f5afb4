"""Bumps times a kind's density, against linear algebra done the long way."""

import numpy as np
import pytest
from scipy import stats

from boomdp_jax.inference.kinds.likelihood_bumps import (
    bump_of_posterior,
    draw_product,
    join_bumps,
    log_bump,
    log_mass,
    start_of_bumps,
)
from boomdp_jax.inference.kinds.likelihood_fit import StructureDraws, fit_bumps

PERIOD = np.zeros(3)
IN_USE = np.array([True, True, True])


def correlated() -> tuple[np.ndarray, np.ndarray]:
    """A posterior that is narrower than the prior in two directions of three."""
    factor = np.array([[1.0, 0.0], [0.5, 0.8], [0.0, 1.0]]) * 3.0
    return np.array([0.4, -0.3, 0.6]), np.linalg.inv(np.eye(3) + factor @ factor.T)


def test_a_bump_times_the_prior_is_the_posterior():
    mean, covariance = correlated()
    bumps = join_bumps([bump_of_posterior(0, IN_USE, PERIOD, mean, covariance, -2.5)])
    points = np.random.default_rng(0).normal(size=(20, 3))
    found = log_bump(bumps, points, PERIOD)[:, 0]
    found = found + stats.norm.logpdf(points).sum(1)
    expected = stats.multivariate_normal(mean, covariance).logpdf(points) - 2.5
    # The direction that the data leave open is as wide as the prior to rounding only,
    # but its mean is not the prior's: what is left of it is dropped.
    size, direction = np.linalg.eigh(np.linalg.inv(covariance) - np.eye(3))
    open_way = direction[:, size < 0.02][:, 0]
    expected += stats.norm.logpdf(points @ open_way) - stats.norm.logpdf(
        points @ open_way - mean @ open_way
    )
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_the_mass_is_the_integral_over_a_kinds_density():
    mean, covariance = correlated()
    bumps = join_bumps([bump_of_posterior(0, IN_USE, PERIOD, mean, covariance, -2.5)])
    centre, variance = np.array([0.5, -0.2, 0.3]), np.array([0.02, 0.5, 1.0])
    start = start_of_bumps(bumps, PERIOD, centre, variance)
    mass, lower = log_mass(bumps, start, variance)
    factor, residual = bumps.factor[0], bumps.residual[0]
    seen = np.eye(2) + (factor.T * variance) @ factor
    predicted = factor.T @ (centre - mean)
    density = stats.multivariate_normal(predicted, seen).logpdf(residual)
    density += np.log(2 * np.pi)  # Two readings of unit noise, less their normaliser.
    assert mass[0] == pytest.approx(bumps.log_height[0] + density, rel=1e-9)
    rng, num = np.random.default_rng(1), 40_000
    drawn = draw_product(
        np.broadcast_to(factor, (num, *factor.shape)),
        np.broadcast_to(residual, (num, 2)),
        np.broadcast_to(lower[0], (num, 2, 2)),
        np.broadcast_to(start[0], (num, 3)),
        np.broadcast_to(variance, (num, 3)),
        rng.standard_normal((num, 3)),
        rng.standard_normal((num, 2)),
    )
    product = np.linalg.inv(np.diag(1 / variance) + factor @ factor.T)
    middle = product @ ((centre - mean) / variance + factor @ residual)
    error = np.sqrt(np.diag(product) / num)
    assert np.all(np.abs(drawn.mean(0) - middle) < 4.5 * error)
    scale = np.sqrt(np.outer(np.diag(product), np.diag(product)))
    assert np.max(np.abs(np.cov(drawn.T) - product) / scale) < 0.03


def test_moments_of_a_heading_do_not_mind_where_it_is_cut():
    rng = np.random.default_rng(2)
    heading = np.pi / 2 + 0.1 * rng.normal(size=5000)
    period = np.array([0.0, np.pi])
    cut = heading - np.pi * np.floor(heading / np.pi + 0.5)
    draws = StructureDraws(np.column_stack([0.3 * heading, cut]), np.ones(5000))
    mean, covariance = draws.moments(period)
    away = abs(mean[1] - np.pi / 2)
    assert min(away, np.pi - away) < 0.01
    assert covariance[1, 1] == pytest.approx(0.01, rel=0.1)
    assert covariance[0, 1] == pytest.approx(0.003, rel=0.1)


@pytest.mark.parametrize("scale", [1.0, 1e-200, 1e-315])
def test_draws_of_a_structure_all_but_impossible_are_counted_right(scale):
    z = np.arange(6.0)[:, None]
    draws = StructureDraws(z, scale * np.array([1.0, 1.0, 2.0, 0.0, 1.0, 3.0]))
    np.testing.assert_allclose(draws.size, 8.0**2 / 16.0, rtol=1e-6)


def test_a_structure_without_draws_is_fitted_by_its_mode():
    rng = np.random.default_rng(3)
    in_use = np.array([[True, False], [True, True]])
    z = np.column_stack([0.5 + 0.1 * rng.normal(size=400), np.zeros(400)])
    precision = np.broadcast_to(np.diag([50.0, 20.0]), (2, 2, 2))
    bumps = fit_bumps(
        in_use,
        np.zeros(2),
        np.log([0.5, 0.5]),
        np.array([-3.0, -np.inf]),
        (np.zeros(400, int), z),
        (np.zeros(400, int), z, np.full(400, 1 / 400)),
        (
            np.array([0, 1]),
            np.array([[0.5, 0.0], [0.4, -0.6]]),
            precision,
            np.array([-2.0, -6.0]),
        ),
    )
    assert bumps.structure.tolist() == [0, 1]
    np.testing.assert_allclose(bumps.centre[1], [0.4, -0.6])
    found = np.einsum("dr,er->de", bumps.factor[1], bumps.factor[1])
    np.testing.assert_allclose(found, np.diag([49.0, 19.0]), atol=1e-3)
