import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from boomdp_jax.core import make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.likelihoods.one_step import (
    NoiseStatistics,
    OneStepLikelihood,
    draw_noise,
    group_sums,
    log_marginal,
)
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.physics import scene_spec_from_dict


def test_marginal_likelihood_is_the_integral_over_the_noise_variance():
    residual = np.array([0.3, -0.1, 0.25, 0.05]) * 1e-2
    scale = 2e-3

    def integrand(log_variance):
        variance = np.exp(log_variance)
        likelihood = np.prod(scipy.stats.norm.pdf(residual, 0, np.sqrt(variance)))
        prior = scipy.stats.invgamma.pdf(variance, 1.0, scale=scale**2)
        return likelihood * prior * variance

    expected, _ = scipy.integrate.quad(integrand, -25, 5, epsrel=1e-10, limit=500)
    statistics = NoiseStatistics(
        jnp.array([[4.0, 0, 0, 0]]), jnp.array([[np.sum(residual**2), 0, 0, 0]])
    )
    scales = jnp.array([scale, 1.0, 1.0, 1.0])
    # The empty groups integrate to one.
    assert float(log_marginal(statistics, scales)) == pytest.approx(np.log(expected))


@pytest.mark.slow
def test_noise_draws_follow_their_inverse_gamma_distribution():
    statistics = NoiseStatistics(jnp.full((1, 4), 30.0), jnp.full((1, 4), 2e-3))
    scales = jnp.full(4, 5e-3)
    keys = jax.random.split(jax.random.key(0), 4000)
    draws = jax.vmap(lambda k: draw_noise(k, statistics, scales))(keys)
    variance = np.asarray(draws[:, 0, 0]) ** 2
    expected = scipy.stats.invgamma(1 + 15, scale=25e-6 + 1e-3)
    # One false alarm in a thousand.
    assert scipy.stats.kstest(variance, expected.cdf).pvalue > 1e-3


def test_group_sums_add_the_two_axes_of_position_and_velocity():
    values = jnp.arange(12.0).reshape(2, 1, 6)
    np.testing.assert_array_equal(group_sums(values)[0], [14.0, 10.0, 26.0, 16.0])


def _scene(num_bodies, **fields):
    body = {"shape": {"type": "box", "half_extents": [0.2, 0.1]}, "pose": [0, 0, 0]}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [{"name": f"b{i}", **body} for i in range(num_bodies)],
            **fields,
        }
    )


def _free_flight(num_rows, density, force):
    """A box of 0.4 m by 0.2 m under a constant force, in closed form."""
    mass, dt = density * 0.08, 0.02
    time = np.arange(num_rows + 1) * dt
    state = np.zeros((num_rows + 1, 1, 6))
    state[:, 0, 0] = 0.5 * force / mass * time**2
    state[:, 0, 3] = force / mass * time
    action = np.zeros((num_rows, 1, 3))
    action[:, 0, 0] = force
    return make_history(state[:-1], action, state[1:], dt)


def _one_step(spec, history):
    tracked = make_block(spec, (0,), history).target.log_likelihood
    return OneStepLikelihood(tracked.coordinates, tracked.data.steps)


def test_the_true_density_has_no_residuals():
    spec = _scene(1)
    likelihood = _one_step(spec, _free_flight(20, 12.0, 3.0))
    scale, spread = np.log(30.0), 1.5
    z = jnp.array([(np.log(12.0) - scale) / spread])
    r = likelihood.residuals(z, jnp.zeros(0, bool))
    np.testing.assert_allclose(r, 0.0, atol=1e-12)
    other = likelihood.residuals(z + 0.1, jnp.zeros(0, bool))
    gained = 3.0 / (12.0 * 0.08) * 0.02
    np.testing.assert_allclose(other[..., 3], gained * np.expm1(-0.15), rtol=1e-9)


def test_masked_rows_and_channels_do_not_count():
    spec, history = _scene(1), _free_flight(20, 12.0, 3.0)
    state = np.array(history.next_state)
    state[3, 0, 4] = np.nan
    gaps = make_history(history.state, history.action, state, 0.02, capacity=32)
    statistics = _one_step(spec, gaps).statistics(jnp.zeros(1), jnp.zeros(0, bool))
    np.testing.assert_array_equal(statistics.num[0], [40, 20, 39, 20])


def _two(pinned):
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.1, (40, 2)), axis=0)
    place = np.cumsum(rng.normal(0, 0.05, (40, 2, 2)), axis=0)
    if pinned:
        turned = np.stack([np.cos(angle), np.sin(angle)], -1)
        place[:, 1] = place[:, 0] + 0.2 * turned[:, 0] + 0.15 * turned[:, 1]
    state = np.concatenate([place, angle[..., None], np.zeros((40, 2, 3))], -1)
    return make_history(state[:-1], np.zeros((39, 2, 3)), state[1:], 0.02)


@pytest.mark.parametrize(("pinned", "expected"), [(True, 1), (False, 2)])
def test_bodies_that_keep_a_common_point_form_one_block(pinned, expected):
    spec = _scene(2, unknown={"revolute": 1})
    blocks, notes = independent_blocks(spec, _two(pinned))
    assert len(blocks) == expected
    assert bool(notes) != pinned


def test_a_known_joint_ties_its_bodies():
    joint = {"type": "revolute", "a": "b0", "b": "b1", "anchor_a": [0, 0]}
    spec = _scene(2, constraints=[joint | {"anchor_b": [0, 0]}])
    assert independent_blocks(spec, _two(False))[0] == [(0, 1)]
