import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import BodyRegression, LinearRegression
from boomdp_jax.models.linear import leave_one_out_error

from .test_table import filled
from .worlds import cart, error_share, expected, learn, part, ride


def fit_of(regressor, inputs, targets):
    def take(fit, row):
        return regressor.add(fit, *row, jnp.asarray(True)), None

    first = regressor.init(jax.random.key(0), inputs.shape[1], targets.shape[1])
    rows = (jnp.asarray(inputs), jnp.asarray(targets))
    return jax.lax.scan(take, first, rows)[0]


def predictions(regressor, fit, inputs):
    hypothesis = jax.tree.map(lambda leaf: leaf[0], regressor.prepare(fit))
    key = jax.random.key(0)
    return jax.vmap(lambda one: regressor.predict(key, hypothesis, one))(
        jnp.asarray(inputs)
    )


def ridge_by_numpy(inputs, targets, ridge, query):
    """Rows of a penalty under the standardised rows; least squares by NumPy."""
    mean, spread = inputs.mean(0), inputs.std(0)
    x = (inputs - mean) / spread
    n, d = x.shape
    rows = np.concatenate([np.ones((n, 1)), x], axis=1)
    penalty = np.sqrt(n * ridge) * np.eye(d + 1)[1:]
    rows = np.concatenate([rows, penalty])
    right = np.concatenate([targets, np.zeros((d, targets.shape[1]))])
    weights = np.linalg.lstsq(rows, right, rcond=None)[0]
    units = (query - mean) / spread
    return np.concatenate([np.ones((len(units), 1)), units], axis=1) @ weights


def example(num=30):
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(num, 4)) * np.array([1, 10, 0.1, 3]) + 5.0
    targets = inputs @ rng.normal(size=(4, 2)) + rng.normal(size=(num, 2))
    return inputs, targets, rng.normal(size=(6, 4)) + 5.0


def test_a_push_along_another_axis_than_all_before_is_not_told_from_rounding():
    """Whose slope, from some 1e-15 N, would move it by more than there is."""
    angles = np.pi * np.array([0, 1, 0, 1, 1, 0, 1, 0])
    inputs = 10.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    targets = inputs @ np.array([[0.1], [0.1]]) + 1e-3 * np.cos(np.arange(8))[:, None]
    regressor = LinearRegression(capacity=10)
    fit = regressor.tune(fit_of(regressor, inputs, targets))
    told = predictions(regressor, fit, np.array([[0.0, 10.0], [10.0, 0.0]]))
    np.testing.assert_allclose(told, [[0.0], [1.0]], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("ridge", [1e-6, 1e-2, 3.0])
def test_ridge_regression_is_least_squares_with_penalty_rows(ridge):
    inputs, targets, query = example()
    regressor = LinearRegression(capacity=40, ridges=(ridge,))
    fit = regressor.tune(fit_of(regressor, inputs, targets))
    told = predictions(regressor, fit, query)
    truth = ridge_by_numpy(inputs, targets, ridge, query)
    np.testing.assert_allclose(told, truth, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("ridge", [1e-4, 0.3])
def test_leave_one_out_error_is_that_of_leaving_rows_out(ridge):
    rng = np.random.default_rng(2)
    inputs = rng.normal(size=(25, 3))
    targets = 2.0 * inputs[:, :1]
    table = filled(inputs, 30)
    # With the units of all rows, as columns are standardised once.
    x = (inputs - inputs.mean(0)) / inputs.std(0)
    n, d = x.shape
    design = np.concatenate([np.ones((n, 1)), x], axis=1)
    penalty = n * ridge * np.diag([0.0] + [1.0] * d)
    missed = []
    for row in range(n):
        rest = np.arange(n) != row
        gram = design[rest].T @ design[rest] + penalty
        weights = np.linalg.solve(gram, design[rest].T @ targets[rest])
        missed.append(targets[row] - design[row] @ weights)
    truth = np.mean(np.square(missed) / targets.var(0))
    np.testing.assert_allclose(
        leave_one_out_error(table, jnp.asarray(ridge)), truth, rtol=1e-8
    )


def test_tuning_chooses_little_for_a_law_and_much_for_noise():
    rng = np.random.default_rng(3)
    inputs = rng.normal(size=(20, 6))
    regressor = LinearRegression(capacity=20)
    law = regressor.tune(fit_of(regressor, inputs, inputs[:, :2]))
    noise = regressor.tune(fit_of(regressor, inputs, rng.normal(size=(20, 2))))
    assert float(law.ridge) == 1e-6
    assert float(noise.ridge) >= 0.1


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["world", "body"])
def test_nothing_known_means_coasting(frame, precision):
    model = BodyRegression(cart(walls=True).scene, LinearRegression(), frame=frame)
    before, wrench, after = part(ride(40), 30, 33)
    two = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, leaf], 1).astype(float),
        (before, wrench, after),
    )
    told = expected(model, model.init(jax.random.key(0)), two)
    pose, twist = two[0].pose, two[0].twist
    np.testing.assert_allclose(told.twist, twist, atol=1e-6)
    np.testing.assert_allclose(told.pose[:, 0], (pose + 0.1 * twist)[:, 0], atol=1e-6)
    np.testing.assert_array_equal(told.pose[:, 1], pose[:, 1])
    learnt = learn(model, part(two, 0, 1))
    assert np.all(np.isfinite(expected(model, learnt, two).array))


@pytest.mark.slow
def test_missing_readings_teach_nothing():
    model = BodyRegression(cart().scene, LinearRegression(capacity=20))
    before, wrench, after = part(ride(40), 0, 10)
    holes = after.pose.at[3, 0, 1].set(jnp.nan)
    learnt = learn(model, (before, wrench, type(after)(holes, after.twist)))
    assert int(learnt.table.num_seen[0]) == 9
    assert np.all(np.isfinite(expected(model, learnt, part(ride(40), 0, 40)).array))


@pytest.mark.slow
def test_a_free_body_is_learnt_in_the_body_frame():
    model = BodyRegression(cart().scene, LinearRegression())
    rows = ride(260)
    share = error_share(model, learn(model, part(rows, 0, 200)), part(rows, 200, 260))
    assert np.all(share < 0.6)


def test_one_loop_equals_many_updates():
    model = BodyRegression(cart().scene, LinearRegression(capacity=8))
    rows = part(ride(40), 0, 12)
    learnt = model.init(jax.random.key(0))
    update = eqx.filter_jit(model.update)
    for t in range(12):
        learnt = update(learnt, *jax.tree.map(lambda leaf, t=t: leaf[t], rows))
    for one, other in zip(
        jax.tree.leaves(learnt), jax.tree.leaves(learn(model, rows)), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="capacity: expected at least 1, got 0"):
        LinearRegression(capacity=0)
    with pytest.raises(ValueError, match="ridges: expected positive numbers, got"):
        LinearRegression(ridges=(1.0, 0.0))
