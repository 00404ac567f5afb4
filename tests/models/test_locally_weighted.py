import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import BodyRegression, LocallyWeighted
from boomdp_jax.models.locally_weighted import kth_least

from .test_features import moved, turned
from .test_linear import fit_of, predictions
from .worlds import cart, error_share, expected, learn, only, part, ride


def locally_weighted_by_numpy(
    inputs, targets, query, bandwidth, ridge, k=10**9, units=None
):
    """One loop over queries, rows sorted, weighted least squares by NumPy."""
    units = inputs if units is None else units
    mean, spread = units.mean(0), units.std(0)
    x, told = (inputs - mean) / spread, []
    for point in (query - mean) / spread:
        square = np.sum((x - point) ** 2, axis=1)
        near = np.argsort(square)[:k]
        weight = np.exp(-square[near] / (2 * bandwidth**2))
        root = np.sqrt(weight)[:, None]
        rows = root * np.concatenate([np.ones((len(near), 1)), x[near] - point], axis=1)
        penalty = np.sqrt(ridge * weight.sum()) * np.eye(x.shape[1] + 1)[1:]
        right = np.concatenate([root * targets[near], np.zeros((len(penalty), 2))])
        told.append(
            np.linalg.lstsq(np.concatenate([rows, penalty]), right, rcond=None)[0][0]
        )
    low, high = targets.min(0), targets.max(0)
    return np.clip(told, low - (high - low) / 2, high + (high - low) / 2)


def example(num=60):
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(num, 3)) * np.array([1.0, 10.0, 0.1]) + 5.0
    targets = np.stack([np.sin(inputs[:, 0]), inputs[:, 1] * inputs[:, 2]], axis=1)
    query = rng.normal(size=(7, 3)) * np.array([1.0, 10.0, 0.1]) + 5.0
    return inputs, targets, query


@pytest.mark.slow
@pytest.mark.parametrize("k", [15, 1000])
@pytest.mark.parametrize("bandwidth", [0.4, 1.5])
def test_predictions_are_those_of_a_slow_version(k, bandwidth):
    inputs, targets, query = example()
    regressor = LocallyWeighted(
        capacity=80, num_neighbours=k, bandwidths=(bandwidth,), ridges=(1e-3,)
    )
    told = predictions(regressor, fit_of(regressor, inputs, targets), query)
    truth = locally_weighted_by_numpy(inputs, targets, query, bandwidth, 1e-3, k)
    np.testing.assert_allclose(told, truth, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_tuning_takes_the_least_leave_one_out_error():
    inputs, targets, _ = example(40)
    regressor = LocallyWeighted(capacity=50, num_held_out=40)
    fit = regressor.tune(fit_of(regressor, inputs, targets))
    mean, spread = inputs.mean(0), inputs.std(0)
    x, errors = (inputs - mean) / spread, {}
    # Rows are standardised once, by all of them.
    for bandwidth in regressor.bandwidths:
        for ridge in regressor.ridges:
            missed = []
            for row in range(40):
                rest = np.arange(40) != row
                square = np.sum((x[rest] - x[row]) ** 2, axis=1)
                weight = np.exp(-square / (2 * bandwidth**2))
                weight /= weight.sum()
                level = weight @ targets[rest]
                middle = weight @ x[rest]
                gram = (x[rest] - middle).T * weight @ (x[rest] - middle)
                cross = (x[rest] - middle).T * weight @ (targets[rest] - level)
                slope = np.linalg.solve(gram + ridge * np.eye(3), cross)
                missed.append(level + (x[row] - middle) @ slope - targets[row])
            errors[bandwidth, ridge] = np.mean(np.square(missed) / targets.var(0))
    best = min(errors, key=lambda pair: errors[pair])
    assert (float(fit.bandwidth), float(fit.ridge)) == pytest.approx(best)


@pytest.mark.slow
def test_groups_are_regressions_of_their_own_and_fall_back_on_zero():
    inputs, targets, query = example()
    group = np.arange(60) % 3
    regressor = LocallyWeighted(capacity=64, bandwidths=(1.5,), ridges=(1e-3,))
    fit = fit_of(regressor, inputs, targets)
    table = dataclasses.replace(
        fit.table, group=fit.table.group.at[:60].set(jnp.asarray(group, jnp.int32))
    )
    fit = dataclasses.replace(fit, table=table)
    rows = jax.tree.map(lambda leaf: leaf[0], regressor.prepare(fit))
    point = jnp.asarray(query[0])
    told = {
        g: regressor.predict(jax.random.key(0), rows, point, jnp.asarray(g))
        for g in (0, 1, 7)
    }
    for g in (0, 1):
        own = group == g
        alone = locally_weighted_by_numpy(
            inputs[own], targets[own], query, 1.5, 1e-3, units=inputs
        )
        np.testing.assert_allclose(told[g], alone[0], rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(told[7], told[0])
    assert np.any(np.abs(told[1] - told[0]) > 1e-3)


def test_kth_least_is_what_sorting_says(precision):
    values = jnp.asarray(np.random.default_rng(0).exponential(size=200), float)
    for k in (1, 7, 199, 200):
        assert float(kth_least(values, k)) == float(np.sort(values)[k - 1])


@pytest.mark.slow
def test_far_from_all_rows_predictions_are_finite_and_bounded(precision):
    model = BodyRegression(cart().scene, LocallyWeighted(capacity=60))
    rows = jax.tree.map(lambda leaf: leaf.astype(float), ride(80))
    learnt = learn(model, part(rows, 0, 60))
    before, wrench, after = part(rows, 20, 80)
    before = dataclasses.replace(before, twist=before.twist + 30.0)
    told = expected(model, learnt, (before, wrench, after))
    assert np.all(np.isfinite(told.array))
    assert np.max(np.abs(told.twist)) < 300.0


@pytest.mark.slow
def test_a_few_rows_are_enough_to_be_finite(precision):
    model = BodyRegression(cart().scene, LocallyWeighted(capacity=60))
    rows = jax.tree.map(lambda leaf: leaf.astype(float), part(ride(80), 0, 60))
    for num_rows in (0, 1, 2, 5):
        told = expected(model, learn(model, only(rows, num_rows)), rows)
        assert np.all(np.isfinite(told.array))
        if num_rows == 0:
            np.testing.assert_allclose(told.twist, rows[0].twist, atol=1e-6)


@pytest.mark.slow
def test_what_is_learnt_in_the_body_frame_turns_with_the_world():
    model = BodyRegression(cart().scene, LocallyWeighted(capacity=120))
    before, wrench, after = part(ride(240), 0, 120)
    plain = learn(model, (before, wrench, after))
    turn = 1.1, (3.0, -2.0)

    def far(state):
        return jax.vmap(lambda one: moved(one, *turn))(state)

    shifted = learn(model, (far(before), turned(wrench, 1.1), far(after)))
    before, wrench, after = part(ride(240), 120, 240)
    one = expected(model, plain, (before, wrench, after))
    other = expected(model, shifted, (far(before), turned(wrench, 1.1), far(after)))
    np.testing.assert_allclose(far(one).array, other.array, atol=1e-6)
    share = np.sqrt(np.mean(np.asarray(one.twist - after.twist) ** 2))
    assert share < 0.5 * np.sqrt(np.mean(np.asarray(before.twist - after.twist) ** 2))


@pytest.mark.slow
def test_a_cart_is_learnt_better_in_the_body_frame():
    rows, shares = ride(460), {}
    for frame in ("world", "body"):
        model = BodyRegression(cart().scene, LocallyWeighted(capacity=400), frame=frame)
        learnt = learn(model, part(rows, 0, 400))
        shares[frame] = error_share(model, learnt, part(rows, 400, 460))
    assert np.all(shares["body"] < 0.25)
    assert np.all(shares["body"] < shares["world"])


def test_bad_settings_are_refused():
    for name in ("capacity", "num_neighbours", "num_held_out"):
        with pytest.raises(ValueError, match=f"{name}: expected at least 1, got 0"):
            LocallyWeighted(**{name: 0})
    for name in ("bandwidths", "ridges"):
        with pytest.raises(ValueError, match=f"{name}: expected positive numbers, got"):
            LocallyWeighted(**{name: (-1.0,)})
