"""The papers' sampler: without data it returns the prior."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.envs import Cart
from boomdp_jax.inference import plain_metropolis, plain_problem
from boomdp_jax.inference.samplers.plain_metropolis import PlainDraws

NUM_CHAINS = 64


@pytest.fixture(scope="module")
def blank():
    """A cart that nobody has pushed."""
    spec = Cart().spec
    none = np.zeros((0, 1, 6))
    history = make_history(none, none[..., :3], none, float(spec.dt), capacity=1)
    dt = jnp.full_like(history.dt, float(spec.dt))
    return plain_problem(spec, eqx.tree_at(lambda h: h.dt, history, dt))[1]


@pytest.mark.slow
def test_without_data_it_returns_the_prior(blank):
    draws = plain_metropolis(
        jax.random.key(0),
        blank,
        num_chains=NUM_CHAINS,
        num_iterations=3000,
        num_burn_in=1000,
        thin=10,
    )
    assert draws.x.shape == (NUM_CHAINS, 200, blank.size)
    x = np.asarray(draws.x)
    period = np.append(np.asarray(blank.period), np.zeros(blank.size - blank.dim))
    # Normal numbers, and angles that are uniform over their period.
    variance = np.where(period > 0, period**2 / 12, 1.0)
    for moment, expected in ((x, 0.0), (x**2, variance[None])):
        by_chain = moment.mean(axis=1)
        error = by_chain.std(axis=0, ddof=1) / np.sqrt(NUM_CHAINS)
        # Chains are independent; five errors of some forty means: 1 alarm in 40,000.
        assert np.all(np.abs(by_chain.mean(axis=0) - expected) < 5 * error)


@pytest.mark.slow
def test_the_best_draw_is_of_the_highest_density(blank):
    draws = jax.vmap(blank.draw)(jax.random.split(jax.random.key(1), 6))
    density = jax.vmap(blank.log_density)(draws)
    best = PlainDraws(draws.reshape(2, 3, -1), density.reshape(2, 3)).best
    np.testing.assert_array_equal(best, draws[np.argmax(np.asarray(density))])
