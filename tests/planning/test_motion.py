"""Edges, lengths and timing of motions."""

import numpy as np
import pytest

from boomdp_jax.planning import (
    edge_points,
    motion_length,
    motion_points,
    timed_motion,
)

LEVERS = np.array([1.0, 0.5, 2.0])
PATH = np.array([[0.0, 0.0, 0.0], [0.3, -0.4, 0.1], [0.3, -0.4, 0.1], [-0.2, 0.5, 0.4]])


def test_points_are_no_further_apart_than_the_resolution_and_hold_all_corners():
    points = motion_points(PATH, LEVERS, 0.07)
    assert np.max(np.abs(np.diff(points, axis=0)) @ LEVERS) <= 0.07 + 1e-12
    for corner in PATH:
        assert np.min(np.abs(points - corner).sum(axis=1)) < 1e-12
    np.testing.assert_allclose(
        motion_length(points, LEVERS), motion_length(PATH, LEVERS)
    )


def test_timed_motion_keeps_its_limits_and_comes_to_rest_at_corners():
    dt, speed, acceleration = 1e-3, 0.3, 0.8
    timed = timed_motion(PATH, LEVERS, speed=speed, acceleration=acceleration, dt=dt)
    assert np.max(np.abs(timed.rate) @ LEVERS) <= speed * (1.0 + 1e-12)
    assert np.max(np.abs(timed.acceleration) @ LEVERS) <= acceleration * (1.0 + 1e-12)
    for corner in PATH[1:]:
        at = np.argmin(np.abs(timed.configuration - corner).sum(axis=1))
        assert np.max(np.abs(timed.configuration[at] - corner)) < 1e-12
        assert np.max(np.abs(timed.rate[at])) < 1e-12
    # The rate is the derivative, and its own derivative the acceleration.
    half = timed.configuration[1:-1]
    slope = (timed.configuration[2:] - timed.configuration[:-2]) / (2.0 * dt)
    is_smooth = np.abs(timed.acceleration[2:] - timed.acceleration[:-2]).max(1) < 0.02
    assert is_smooth.mean() > 0.9
    assert len(half) == len(slope)
    assert np.max(np.abs(slope - timed.rate[1:-1])[is_smooth]) < 1e-5


def test_motion_to_nowhere_takes_no_time():
    timed = timed_motion(PATH[1:3], LEVERS, speed=1.0, acceleration=1.0, dt=0.1)
    assert timed.configuration.shape == timed.rate.shape == (0, 3)


@pytest.mark.parametrize("name", ["speed", "acceleration", "dt"])
def test_limits_that_are_none_are_refused(name):
    limits = {"speed": 1.0, "acceleration": 1.0, "dt": 0.1} | {name: 0.0}
    with pytest.raises(ValueError, match=f"{name}: expected a number above 0"):
        timed_motion(PATH, LEVERS, **limits)


def test_resolution_that_is_none_is_refused():
    with pytest.raises(ValueError, match="resolution: expected a length above 0"):
        edge_points(PATH[0], PATH[1], LEVERS, 0.0)
