"""Instants of which the end of a row and the start of the next have other channels.

That filters take each channel once is held against joint densities in `test_kalman`.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel
from boomdp_jax.inference.readings.at_rest import is_at_rest
from boomdp_jax.inference.readings.tie_tracks import bridged_tracks
from boomdp_jax.inference.readings.track_data import track_data
from tests.inference.online.test_parts import CAPACITY, appended_rows
from tests.inference.recordings import AREA, DT, MASS, box_scene, free_box, lacking

WAYS = ["next", "start", "some"]


@pytest.mark.parametrize("way", WAYS)
def test_a_table_made_row_by_row_has_each_channel_once(way):
    whole = free_box(np.random.default_rng(5), CAPACITY)
    history, full = lacking(whole, way)
    _, data = appended_rows(
        np.where(history.state_mask, history.state, np.nan),
        np.asarray(history.action),
        np.where(history.next_state_mask, history.next_state, np.nan),
        np.zeros(CAPACITY),
        DT,
    )
    spec = box_scene(density=MASS / AREA)
    noise = NoiseLevel(jnp.full((1, 4), 1e-3), jnp.full((1, 2), 1e-3))
    found, expected = (
        float(filter_density(spec.scene, spec.params(), each, noise))
        for each in (data, track_data(full, (0,), True))
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_tracks_of_poses_have_what_either_row_has(way):
    whole = free_box(np.random.default_rng(6), 20, num_episodes=2)
    found, expected = (bridged_tracks(each) for each in lacking(whole, way))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("way", WAYS)
def test_readings_that_tell_of_rest_are_counted_once(way):
    still = np.tile([0.3, -0.2, 0.4, 0.0, 0.0, 0.0], (9, 1))
    still += 1e-3 * np.random.default_rng(7).normal(size=still.shape)
    whole = free_box(np.random.default_rng(8), 8)
    whole = type(whole)(
        **{
            **vars(whole),
            "state": jnp.asarray(still[:-1, None]),
            "next_state": jnp.asarray(still[1:, None]),
        }
    )
    history, full = lacking(whole, way)
    num = int(full.next_state_mask[:, 0, 0].sum()) + 1
    for each in (history, full):
        assert is_at_rest(box_scene(), each, 0, fewest=num)
        assert not is_at_rest(box_scene(), each, 0, fewest=num + 1)
