import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import BodyRegression, NeuralEnsemble

from .worlds import cart, error_share, expected, learn, only, part, ride

SMALL = {"num_members": 3, "width": 16, "batch_size": 16, "capacity": 150}


def learn_rows(regressor, inputs, targets):
    def take(fit, row):
        return regressor.tune(regressor.add(fit, *row, jnp.asarray(True))), None

    first = regressor.init(jax.random.key(0), inputs.shape[1], targets.shape[1])
    rows = (jnp.asarray(inputs), jnp.asarray(targets))
    return jax.jit(lambda first: jax.lax.scan(take, first, rows)[0])(first)


def members_of(regressor, fit, inputs):
    key = jax.random.key(5)
    keys = jax.random.split(key, len(inputs))
    return jax.vmap(
        lambda member: jax.vmap(lambda key, one: regressor.predict(key, member, one))(
            keys, jnp.asarray(inputs)
        )
    )(regressor.prepare(fit))


@pytest.mark.slow
@pytest.mark.parametrize(
    "is_probabilistic", [True, pytest.param(False, marks=pytest.mark.slow)]
)
def test_every_member_learns_a_linear_system(is_probabilistic):
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(150, 3)) * np.array([1.0, 10.0, 0.1]) + 2.0
    matrix = np.array([[1.0, -1.0], [0.1, 0.0], [0.0, 10.0]])
    targets = (inputs - 2.0) @ matrix
    regressor = NeuralEnsemble(
        **SMALL, learning_rate=1e-2, is_probabilistic=is_probabilistic
    )
    fit = learn_rows(regressor, inputs, targets)
    query = rng.normal(size=(50, 3)) * np.array([1.0, 10.0, 0.1]) + 2.0
    truth = (query - 2.0) @ matrix
    told = members_of(regressor, fit, query)
    missed = np.sqrt(np.mean((np.asarray(told) - truth) ** 2, axis=(1, 2)))
    assert np.all(missed < 0.2 * truth.std())
    # Resamples and starts differ, and so do members.
    assert np.all(np.std(told, axis=0) > 0)


@pytest.mark.slow
def test_members_learn_how_noisy_targets_are():
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(150, 1))
    targets = 0.5 * rng.normal(size=(150, 1))
    regressor = NeuralEnsemble(**SMALL, is_noisy=True)
    fit = learn_rows(regressor, inputs, targets)
    drawn = members_of(regressor, fit, np.zeros((2000, 1)))
    spread = np.std(np.asarray(drawn), axis=1)
    # A hundred and fifty rows tell a spread to six percent; networks overfit a little.
    assert np.all((spread > 0.3) & (spread < 0.7))


def test_a_bootstrap_draws_each_row_once_on_average():
    regressor = NeuralEnsemble(num_members=50, capacity=400, width=2)
    add = jax.jit(
        lambda fit: jax.lax.scan(
            lambda fit, _: (
                regressor.add(fit, jnp.ones(1), jnp.ones(1), jnp.asarray(True)),
                None,
            ),
            fit,
            None,
            400,
        )[0]
    )
    drawn = np.asarray(add(regressor.init(jax.random.key(0), 1, 1)).num_drawn)
    # 20,000 Poisson numbers: mean and variance one to within 4.5 standard errors.
    assert abs(drawn.mean() - 1) < 4.5 / np.sqrt(20_000)
    assert abs(drawn.var() - 1) < 4.5 * np.sqrt(3 / 20_000)


@pytest.mark.slow
def test_nothing_known_means_coasting_and_members_are_hypotheses():
    model = BodyRegression(cart().scene, NeuralEnsemble(**SMALL))
    rows = part(ride(120), 0, 12)
    learnt = eqx.filter_jit(model.init)(jax.random.key(0))
    told = expected(model, learnt, rows)
    np.testing.assert_array_equal(told.twist, rows[0].twist)
    key = jax.random.key(0)
    draw = eqx.filter_jit(lambda num: model.sample(key, learnt, num))
    assert draw(10).num_hypotheses == 3
    two = draw(2)
    assert two.num_hypotheses == 2
    first = two.hypotheses.layers[0].weight
    assert not np.array_equal(first[0], first[1])


@pytest.mark.slow
def test_a_few_rows_are_enough_to_be_finite(precision):
    model = BodyRegression(cart().scene, NeuralEnsemble(**SMALL, num_steps=2))
    rows = jax.tree.map(lambda leaf: leaf.astype(float), part(ride(120), 0, 12))
    for num_rows in (0, 1, 12):
        learnt = learn(model, only(rows, num_rows))
        assert np.all(np.isfinite(expected(model, learnt, rows).array))


@pytest.mark.slow
def test_a_cart_is_learnt():
    model = BodyRegression(cart().scene, NeuralEnsemble())
    rows = ride(460)
    learnt = learn(model, part(rows, 0, 400))
    assert np.all(error_share(model, learnt, part(rows, 400, 460)) < 0.3)


def test_bad_settings_are_refused():
    for name in ("num_members", "width", "capacity", "num_steps", "batch_size"):
        with pytest.raises(ValueError, match=f"{name}: expected at least 1, got 0"):
            NeuralEnsemble(**{name: 0})
    with pytest.raises(ValueError, match="learning_rate: expected a positive number"):
        NeuralEnsemble(learning_rate=0.0)
    with pytest.raises(ValueError, match="is_noisy: expected only of members that"):
        NeuralEnsemble(is_noisy=True, is_probabilistic=False)
