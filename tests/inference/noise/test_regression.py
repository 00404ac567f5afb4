"""Regressions over noise and along ridges of draws, against known functions."""

import numpy as np
import pytest

from boomdp_jax.inference.noise import expansion as noise_expansion
from boomdp_jax.inference.noise.draw_ridge import DrawRidge
from boomdp_jax.inference.noise.regression import NoiseRegression


def test_linear_functions_are_found_exactly():
    rng = np.random.default_rng(0)
    vector = rng.normal(size=(200, 4)) * [0.1, 2.0, 1.0, 0.5] - [7.0, 5.0, 0.0, 3.0]
    factor, offset = rng.normal(size=(4, 3)), np.array([1.0, -2.0, 30.0])
    found = NoiseRegression.fit(vector, vector @ factor + offset)
    # Not as far out as where it stops to follow.
    new = 0.4 * vector[:50] + 0.6 * vector.mean(axis=0)
    expected = new @ factor + offset
    np.testing.assert_allclose(found(new), expected, atol=0.02 * factor.std())


def test_a_function_that_levels_off_is_followed():
    """As a posterior's spread does where the motion's noise is nothing to the other."""
    rng = np.random.default_rng(1)

    def value(vector):
        turned = vector @ np.array([[1.0, 0.5], [0.3, -1.0], [0.0, 0.2]])
        return np.log1p(np.exp(turned))

    vector, new = rng.normal(size=(2, 400, 3)) * [1.0, 0.4, 2.0]
    found = NoiseRegression.fit(vector, value(vector))
    near = np.all(np.abs(new) < 2.0 * np.array([1.0, 0.4, 2.0]), axis=1)
    error = (found(new) - value(new))[near]
    # A linear function alone is off by a fifth.
    assert np.sqrt(np.mean(error**2)) < 0.04 * value(new).std()


def test_far_from_the_draws_values_stay_near_theirs():
    rng = np.random.default_rng(2)
    vector = rng.normal(size=(100, 2))
    value = vector[:, :1] ** 2
    found = NoiseRegression.fit(vector, value)(np.array([[1e3, 0.0], [-50.0, 80.0]]))
    assert np.abs(found).max() < 3.0 * value.max()


@pytest.mark.parametrize("num_draws", [400, 20, 3])
def test_a_ridge_of_second_degree_is_followed_as_far_as_draws_tell(num_draws):
    rng = np.random.default_rng(3)
    z = rng.normal(size=(num_draws, 4))
    # Numbers 1 and 3 are tight, 0 is wide, 2 is not in use.
    z[:, 1] = 2.0 + 0.3 * z[:, 0] - 0.1 * z[:, 0] ** 2
    z[:, 3] = -1.0 + 0.2 * z[:, 0]
    place, wide = np.array([3, 1, 4]), np.array([0])
    champion = np.array([0.0, 2.0, 0.0, -1.0])
    ridge = DrawRidge.fit(z, place, wide, champion, np.zeros(4))
    found = ridge(z)
    assert found.shape == (num_draws, 3)
    if num_draws < 4:
        np.testing.assert_allclose(found[:, :2], [[-1.0, 2.0]] * num_draws)
    else:
        np.testing.assert_allclose(found[:, :2], z[:, [3, 1]], atol=1e-6)


def test_a_ridge_over_an_angle_closes_after_a_turn():
    rng = np.random.default_rng(4)
    period = np.array([np.pi, 0.0])
    z = np.stack([rng.uniform(-0.5 * np.pi, 0.5 * np.pi, 300), np.zeros(300)], axis=1)
    z[:, 1] = 0.4 * np.sin(2.0 * z[:, 0]) + 0.1 * np.cos(2.0 * z[:, 0])
    ridge = DrawRidge.fit(z, np.array([1]), np.array([0]), z[0], period)
    turned = z + np.array([np.pi, 0.0])
    np.testing.assert_allclose(ridge(turned), ridge(z), atol=1e-9)
    np.testing.assert_allclose(ridge(z)[:, 0], z[:, 1], atol=1e-6)


def test_factors_of_inverses_despite_rounding():
    rng = np.random.default_rng(5)
    half = rng.normal(size=(20, 6, 6))
    matrix = half @ np.swapaxes(half, 1, 2)
    factor = noise_expansion._inverse_factor(matrix)
    np.testing.assert_allclose(np.triu(factor, 1), 0.0)
    product = factor @ np.swapaxes(factor, 1, 2)
    np.testing.assert_allclose(
        product @ matrix, np.tile(np.eye(6), (20, 1, 1)), atol=1e-6
    )
    # Of rank two but for what single precision leaves, which may be negative.
    thin = rng.normal(size=(50, 9, 2))
    matrix = thin @ np.swapaxes(thin, 1, 2)
    length = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    unit = matrix / (length[:, :, None] * length[:, None, :])
    unit = unit.astype(np.float32).astype(float)
    # A correlation above one is no rounding error, and does no harm either.
    unit[0, 0, 1] = unit[0, 1, 0] = 1.5
    factor = noise_expansion._inverse_factor(noise_expansion._positive(unit))
    assert np.isfinite(factor).all()
    assert np.all(np.diagonal(factor, axis1=1, axis2=2) > 0.0)
