"""Ways on a grid: in the open by a closed form, round a wall by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import walls_between, way_to

GOAL = np.array([0.0, 0.0])
LOW, HIGH = np.array([-2.0, -2.0]), np.array([2.0, 2.0])
FAR = np.array([[8.0, 8.0, 9.0, 9.0]])


def test_in_the_open_ways_are_octagonal():
    way = way_to(walls_between(FAR), GOAL, LOW, HIGH, margin=0.1, spacing=0.25)
    place = np.random.default_rng(0).integers(-8, 8, size=(100, 2)) * 0.25
    low, high = np.sort(np.abs(place), axis=1).T
    octile = high - low + np.sqrt(2) * low
    np.testing.assert_allclose(jax.vmap(way)(place), octile, atol=1e-9)


def test_a_way_leads_round_a_wall():
    # A wall on the right of the goal, from far below up to y = 1.
    wall = np.array([[0.4, -9.0, 0.6, 0.9]])
    way = way_to(walls_between(wall), GOAL, LOW, HIGH, margin=0.01, spacing=0.1)
    # Up to the wall's upper corners, across, and down: two octagonal legs of 1 by 0.4.
    behind = float(way(jnp.array([1.0, 0.0])))
    assert behind == pytest.approx(2 * (0.6 + 0.4 * np.sqrt(2)) + 0.2, abs=1e-6)
    # Inside the wall it is finite, and leads out.
    assert np.isfinite(float(way(jnp.array([0.5, 0.0]))))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spacing": 0.0}, "spacing: expected a positive length, got 0.0"),
        ({"high": LOW}, "high: expected beyond low by 0.1"),
    ],
)
def test_a_grid_needs_room(options, message):
    settings = {"low": LOW, "high": HIGH, "margin": 0.1, **options}
    with pytest.raises(ValueError, match=message):
        way_to(walls_between(FAR), GOAL, **settings)
