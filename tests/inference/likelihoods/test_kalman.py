"""The filter against the joint normal density of all readings, written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from boomdp_jax.core.history import History
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel, extended_filter
from boomdp_jax.inference.likelihoods.tracking import innovations
from boomdp_jax.inference.readings.track_data import track_data
from tests.inference.recordings import (
    AREA,
    MASS,
    box_scene,
    free_box,
    lacking,
    response,
    transition_matrix,
)

READING = np.array([1e-3, 2e-3, 5e-3, 4e-3])
IMPULSE = np.array([3e-3, 2e-3])
SCALE = READING[[0, 0, 1, 2, 2, 3]]
KICK = np.concatenate([np.zeros(3), IMPULSE[[0, 0, 1]]])


def joint_log_density(history: History, mass: float) -> float:
    """Log-density of all readings given the first of each episode.

    Every reading is a linear function of the episode's first reading error, the kicks
    and the reading errors, all normal; the joint covariance is written out.
    """
    state, action = np.asarray(history.state)[:, 0], np.asarray(history.action)[:, 0]
    last = np.asarray(history.next_state)[:, 0]
    first_mask = np.asarray(history.state_mask)[:, 0]
    last_mask = np.asarray(history.next_state_mask)[:, 0]
    episode = np.asarray(history.episode)
    matrix, total = transition_matrix(), 0.0
    for name in np.unique(episode):
        rows = np.flatnonzero(episode == name)
        num_latent = 6 * (1 + len(rows))
        mean = state[rows[0]]
        # How the state depends on the start's error and on each kick.
        slope = np.zeros((6, num_latent))
        slope[:, :6] = np.diag(SCALE)
        values, means, slopes, variances = [], [], [], []
        for place, t in enumerate(rows):
            if place > 0 and not bool(history.is_chained[t]):
                seen = first_mask[t]
                values.append(state[t][seen])
                means.append(mean[seen])
                slopes.append(slope[seen])
                variances.append(SCALE[seen] ** 2)
            begin = 6 * (1 + place)
            slope = slope.copy()
            slope[:, begin : begin + 6] += np.diag(KICK)
            mean = matrix @ mean + response(mass) @ action[t]
            slope = matrix @ slope
            seen = last_mask[t]
            values.append(last[t][seen])
            means.append(mean[seen])
            slopes.append(slope[seen])
            variances.append(SCALE[seen] ** 2)
        whole = np.concatenate(slopes)
        covariance = whole @ whole.T + np.diag(np.concatenate(variances))
        total += multivariate_normal.logpdf(
            np.concatenate(values), np.concatenate(means), covariance
        )
    return total


def run(history: History, mass: float):
    """Filter a recording at a mass."""
    spec = box_scene(density=mass / AREA)
    data = track_data(history, (0,), True)
    noise = NoiseLevel(jnp.asarray(READING[None]), jnp.asarray(IMPULSE[None]))
    params = spec.params()
    return data, spec.scene, params, extended_filter(spec.scene, params, data, noise)


def test_filter_gives_the_joint_density_of_one_reading_an_instant():
    history = free_box(np.random.default_rng(0), 12, num_episodes=2)
    for mass in (MASS, 1.1 * MASS):
        found = run(history, mass)[-1]
        expected = joint_log_density(history, mass)
        np.testing.assert_allclose(found.log_likelihood, expected, rtol=1e-6)


def test_filter_uses_both_readings_of_an_instant():
    history = free_box(np.random.default_rng(1), 10, is_chained=False)
    found = run(history, MASS)[-1]
    expected = joint_log_density(history, MASS)
    np.testing.assert_allclose(found.log_likelihood, expected, rtol=1e-6)
    single = run(free_box(np.random.default_rng(1), 10), MASS)[-1]
    assert float(jnp.sum(found.gains.counts)) == 6 * 19
    assert float(jnp.sum(single.gains.counts)) == 6 * 10


def test_missing_channels_are_left_out():
    history = free_box(np.random.default_rng(2), 10, is_chained=False)
    rng = np.random.default_rng(3)
    keep_first, keep_last = rng.random((2, 10, 1, 6)) > 0.3
    keep_first[0] = True
    history = History(
        **{
            **vars(history),
            "state_mask": jnp.asarray(keep_first),
            "next_state_mask": jnp.asarray(keep_last),
            "state": jnp.where(jnp.asarray(keep_first), history.state, 0.0),
            "next_state": jnp.where(jnp.asarray(keep_last), history.next_state, 0.0),
        }
    )
    found = run(history, MASS)[-1]
    expected = joint_log_density(history, MASS)
    np.testing.assert_allclose(found.log_likelihood, expected, rtol=1e-6)


@pytest.mark.parametrize("way", ["next", "start", "some"])
def test_a_channel_that_one_end_of_an_instant_lacks_is_read_once(way):
    whole = free_box(np.random.default_rng(7), 12, num_episodes=2)
    history, full = lacking(whole, way)
    found, same = run(history, MASS)[-1], run(full, MASS)[-1]
    expected = joint_log_density(full, MASS)
    np.testing.assert_allclose(found.log_likelihood, expected, rtol=1e-6)
    np.testing.assert_allclose(same.log_likelihood, expected, rtol=1e-6)
    assert float(found.gains.counts.sum()) == float(same.gains.counts.sum())


def test_tracking_with_the_gains_repeats_the_filter():
    history = free_box(np.random.default_rng(4), 10, is_chained=False)
    data, scene, params, found = run(history, MASS)
    whitened = jax.jit(innovations)(scene, params, data, found.gains)
    counts = found.gains.counts
    value = found.gains.log_volume - 0.5 * jnp.sum(whitened**2)
    value = value - 0.5 * jnp.sum(counts) * jnp.log(2.0 * jnp.pi)
    np.testing.assert_allclose(value, found.log_likelihood, rtol=1e-9)


def test_gains_that_are_fixed_stay_right_near_their_hypothesis():
    # A free body's gains do not depend on its mass at all.
    history = free_box(np.random.default_rng(5), 12)
    data, _, _, found = run(history, MASS)
    spec = box_scene(density=1.02 * MASS / AREA)
    whitened = innovations(spec.scene, spec.params(), data, found.gains)
    value = found.gains.log_volume - 0.5 * jnp.sum(whitened**2)
    value = value - 0.5 * jnp.sum(found.gains.counts) * jnp.log(2.0 * jnp.pi)
    expected = joint_log_density(history, 1.02 * MASS)
    np.testing.assert_allclose(value, expected, rtol=1e-6)


@pytest.mark.parametrize("num_rows", [0, 3])
def test_rows_that_are_not_in_use_say_nothing(num_rows):
    history = free_box(np.random.default_rng(6), 3)
    mask = jnp.arange(3) < num_rows
    history = History(**{**vars(history), "mask": mask})
    found = run(history, MASS)[-1]
    assert float(jnp.sum(found.gains.counts)) == 6 * num_rows
    assert bool(jnp.isfinite(found.log_likelihood))
