import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from boomdp_jax.models.gauss_newton import gauss_newton, sum_of_squares


def test_linear_residuals_end_in_the_least_squares_solution():
    rng = np.random.default_rng(0)
    matrix, right = rng.normal(size=(20, 4)), rng.normal(size=20)
    point, loss = gauss_newton(
        lambda x: jnp.asarray(matrix) @ x - right, jnp.zeros(4), num_steps=8
    )
    truth, rest, *_ = np.linalg.lstsq(matrix, right)
    np.testing.assert_allclose(point, truth, atol=1e-8)
    np.testing.assert_allclose(loss, rest[0])


def test_curves_are_fitted_as_by_scipy_from_every_start():
    time = np.linspace(0, 3, 30)
    seen = 2.0 * np.exp(-1.3 * time) + 0.5 + 0.01 * np.sin(40 * time)

    def residual(x):
        return x[0] * jnp.exp(-jnp.exp(x[1]) * time) + x[2] - seen

    starts = jnp.array([[1.0, 0.0, 0.0], [3.0, 1.0, 1.0], [0.5, -1.0, 0.3]])
    points, losses = jax.jit(
        jax.vmap(lambda start: gauss_newton(residual, start, num_steps=30))
    )(starts)
    truth = least_squares(residual, starts[0], method="lm", xtol=1e-14)
    for point in points:
        np.testing.assert_allclose(point, truth.x, atol=1e-6)
    np.testing.assert_allclose(losses, 2 * truth.cost, rtol=1e-9)


def test_points_never_get_worse_and_impossible_ones_are_left_alone():
    def residual(x):
        return jnp.where(x[0] > 1.5, jnp.nan, 1.0) * (x - 2.0)

    point, loss = gauss_newton(residual, jnp.zeros(2), num_steps=30)
    assert float(point[0]) <= 1.5
    assert float(loss) <= float(sum_of_squares(residual(jnp.zeros(2))))
    assert np.isinf(sum_of_squares(jnp.array([1.0, jnp.nan])))


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="num_steps: expected at least 1, got 0"):
        gauss_newton(lambda x: x, jnp.zeros(1), num_steps=0)
