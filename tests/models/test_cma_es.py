import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models.cma_es import cma_ask, cma_init, cma_minimise, cma_tell

PLACE = np.array([1.0, -2.0, 0.5, 3.0, -1.0])


def sphere(x):
    return jnp.sum((x - PLACE) ** 2)


def ellipsoid(x):
    return jnp.sum(10.0 ** (6 * jnp.arange(5) / 4) * (x - PLACE) ** 2)


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


@pytest.mark.parametrize(
    ("fn", "optimum", "num_generations"),
    [(sphere, PLACE, 150), (ellipsoid, PLACE, 400), (rosenbrock, np.ones(5), 500)],
    ids=["sphere", "ellipsoid", "rosenbrock"],
)
def test_known_optima_are_found(fn, optimum, num_generations):
    found = jax.jit(
        lambda key: cma_minimise(
            key, fn, jnp.zeros(5), num_generations=num_generations, population=12
        )
    )(jax.random.key(0))
    assert float(found.best_value) < 1e-12
    np.testing.assert_allclose(found.best, optimum, atol=1e-5)


@pytest.mark.slow
def test_ask_and_tell_are_the_loop():
    key = jax.random.key(2)
    state = cma_init(jnp.zeros(5), 0.5)
    for one in jax.random.split(key, 6):
        points = cma_ask(one, state, 8)
        state = cma_tell(state, points, jax.vmap(sphere)(points))
    loop = cma_minimise(key, sphere, jnp.zeros(5), num_generations=6, population=8)
    np.testing.assert_allclose(state.mean, loop.mean, rtol=1e-9)
    np.testing.assert_allclose(state.covariance, loop.covariance, rtol=1e-8)


def test_the_search_does_not_see_the_scale_of_values():
    def run(fn):
        return cma_minimise(
            jax.random.key(1), fn, jnp.zeros(5), num_generations=30, population=8
        )

    one, other = run(sphere), run(lambda x: jnp.exp(sphere(x)) - 7.0)
    np.testing.assert_array_equal(one.best, other.best)


def test_what_is_not_a_number_is_never_the_best():
    def broken(x):
        return jnp.where(x[0] > 0, jnp.nan, sphere(x))

    found = cma_minimise(
        jax.random.key(1), broken, -jnp.ones(5), num_generations=150, population=12
    )
    assert np.all(np.isfinite(found.mean))
    assert float(found.best[0]) <= 0
    np.testing.assert_allclose(found.best[1:], PLACE[1:], atol=0.05)


def test_the_start_is_never_lost():
    found = cma_minimise(
        jax.random.key(1), sphere, jnp.asarray(PLACE), num_generations=2, population=4
    )
    np.testing.assert_array_equal(found.best, PLACE)


def test_bad_settings_are_refused():
    start = jnp.zeros(2)
    with pytest.raises(ValueError, match="population: expected at least 4, got 3"):
        cma_minimise(jax.random.key(0), sphere, start, population=3)
    with pytest.raises(ValueError, match="num_generations: expected at least 1, got"):
        cma_minimise(jax.random.key(0), sphere, start, num_generations=0)
    with pytest.raises(ValueError, match="scale: expected a positive number, got 0"):
        cma_minimise(jax.random.key(0), sphere, start, scale=0.0)
