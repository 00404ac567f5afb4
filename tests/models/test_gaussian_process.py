import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from boomdp_jax.models import BodyRegression, GaussianProcess
from boomdp_jax.models.gaussian_process import Scales, log_marginal_likelihood

from .test_linear import fit_of, predictions
from .worlds import cart, error_share, expected, learn, only, part, ride

# What is added to the noise so that matrices can be factored, in 64 bit.
LEAST_NOISE = 1e-4


def covariance(scales, a, b):
    length = np.exp(np.asarray(scales.log_length))
    gap = (a[:, None] - b[None]) / length
    return np.exp(2 * float(scales.log_signal) - 0.5 * np.sum(gap**2, axis=-1))


def noise_variance(scales):
    signal = np.exp(2 * float(scales.log_signal))
    return np.exp(2 * float(scales.log_noise)) + LEAST_NOISE**2 * (1 + signal)


def example(num=20):
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(num, 3)) * np.array([1.0, 10.0, 0.1]) + 5.0
    targets = np.stack([np.sin(inputs[:, 0]), inputs[:, 1] * inputs[:, 2]], axis=1)
    query = rng.normal(size=(7, 3)) * np.array([1.0, 10.0, 0.1]) + 5.0
    return inputs, targets, query


def test_evidence_is_the_density_of_a_normal():
    inputs, targets, _ = example()
    for seed in range(5):
        signal, noise, *length = np.random.default_rng(seed).normal(size=5)
        scales = Scales(
            jnp.asarray(signal), jnp.asarray(length) + 1.0, jnp.asarray(noise - 1)
        )
        mask = np.arange(20) < 15
        x = (inputs - 5.0) / np.array([1.0, 10.0, 0.1])
        matrix = covariance(scales, x[mask], x[mask])
        matrix = matrix + noise_variance(scales) * np.eye(15)
        truth = multivariate_normal(np.zeros(15), matrix).logpdf(targets[mask, 0])
        told = log_marginal_likelihood(
            scales, jnp.asarray(x), jnp.asarray(targets[:, 0]), jnp.asarray(mask)
        )
        np.testing.assert_allclose(told, truth, rtol=1e-8)


def closed_form(fit, inputs, targets, query, output):
    """Mean and variance of the posterior, by NumPy."""
    scales = jax.tree.map(lambda leaf: leaf[output], fit.scales)
    mean, spread = inputs.mean(0), inputs.std(0)
    x, at = (inputs - mean) / spread, (query - mean) / spread
    size = np.sqrt(np.mean(targets[:, output] ** 2))
    matrix = covariance(scales, x, x) + noise_variance(scales) * np.eye(len(x))
    cross = covariance(scales, at, x)
    level = cross @ np.linalg.solve(matrix, targets[:, output] / size)
    known = np.sum(cross * np.linalg.solve(matrix, cross.T).T, axis=1)
    signal = np.exp(2 * float(scales.log_signal))
    return size * level, size**2 * (signal - known + noise_variance(scales))


def test_predictions_are_the_posterior_in_closed_form():
    inputs, targets, query = example()
    regressor = GaussianProcess(capacity=24, num_tuning_steps=10)
    tuned = jax.jit(regressor.tune)(fit_of(regressor, inputs, targets))
    told = predictions(regressor, tuned, query)
    for output in range(2):
        truth, _ = closed_form(tuned, inputs, targets, query, output)
        np.testing.assert_allclose(told[:, output], truth, rtol=1e-7, atol=1e-9)


def test_draws_have_the_predictive_mean_and_variance():
    inputs, targets, query = example()
    regressor = GaussianProcess(capacity=24, is_noisy=True)
    fit = fit_of(regressor, inputs, targets)
    hypothesis = jax.tree.map(lambda leaf: leaf[0], regressor.prepare(fit))
    num = 4000
    keys = jax.random.split(jax.random.key(3), num)
    drawn = jax.vmap(
        lambda key: regressor.predict(key, hypothesis, jnp.asarray(query[0]))
    )(keys)
    for output in range(2):
        mean, variance = closed_form(fit, inputs, targets, query[:1], output)
        # Four and a half standard errors: one false alarm in 70,000 each.
        error = np.sqrt(variance[0] / num)
        assert abs(float(jnp.mean(drawn[:, output])) - mean[0]) < 4.5 * error
        ratio = float(jnp.var(drawn[:, output])) / variance[0]
        assert abs(ratio - 1) < 4.5 * np.sqrt(2 / num)


@pytest.mark.slow
def test_tuning_raises_the_evidence_and_finds_what_does_not_matter():
    rng = np.random.default_rng(2)
    inputs = rng.normal(size=(40, 2))
    targets = np.sin(3.0 * inputs[:, :1])
    regressor = GaussianProcess(capacity=40, num_tuning_steps=200)
    fit = fit_of(regressor, inputs, targets)
    tuned = jax.jit(regressor.tune)(fit)
    length = np.exp(np.asarray(tuned.scales.log_length[0]))
    assert length[1] > 4 * length[0]
    told = predictions(regressor, tuned, inputs)
    np.testing.assert_allclose(told, targets, atol=0.05)


@pytest.mark.slow
def test_a_few_rows_are_enough_to_be_finite_and_a_cart_is_learnt(precision):
    regressor = GaussianProcess(capacity=60, num_tuning_rows=40, num_tuning_steps=15)
    model = BodyRegression(cart().scene, regressor)
    rows = jax.tree.map(lambda leaf: leaf.astype(float), ride(120))
    shown, held = part(rows, 0, 60), part(rows, 60, 120)
    for num_rows in (0, 1, 3, 60):
        learnt = learn(model, only(shown, num_rows))
        told = expected(model, learnt, held)
        assert np.all(np.isfinite(told.array))
        if num_rows == 0:
            np.testing.assert_array_equal(told.twist, held[0].twist)
    assert np.all(error_share(model, learnt, held) < 0.5)
    # Rows twice over do not make a matrix that cannot be factored.
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:30], leaf[:30]]), rows)
    assert np.all(np.isfinite(expected(model, learn(model, twice), held).array))


def test_nothing_known_means_coasting():
    model = BodyRegression(cart().scene, GaussianProcess(capacity=10))
    rows = part(ride(120), 0, 12)
    told = expected(model, eqx.filter_jit(model.init)(jax.random.key(0)), rows)
    np.testing.assert_array_equal(told.twist, rows[0].twist)


def test_a_full_table_still_counts_what_it_sees():
    inputs, targets, _ = example(30)
    regressor = GaussianProcess(capacity=12)
    fit = fit_of(regressor, inputs, targets)
    assert int(fit.table.num_rows) == 12
    assert int(fit.table.num_seen) == 30
    assert not regressor.is_due(dataclasses.replace(fit, num_tuned=jnp.int32(25)))


def test_bad_settings_are_refused():
    for name in ("capacity", "num_tuning_rows", "num_tuning_steps"):
        with pytest.raises(ValueError, match=f"{name}: expected at least 1, got 0"):
            GaussianProcess(**{name: 0})
