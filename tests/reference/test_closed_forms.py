"""The closed forms start and stop where they should."""

import numpy as np

from tests.reference import closed_forms


def test_a_slide_stops_after_its_braking_distance_and_stays():
    braking = 3.0**2 / (2 * 0.3 * 9.81)
    for time in (2.0, 5.0):
        distance, speed = closed_forms.dry_slide(3.0, 0.3, 9.81, time)
        np.testing.assert_allclose([distance, speed], [braking, 0.0], atol=1e-12)


def test_a_body_sticks_on_a_slope_that_is_flatter_than_its_friction():
    assert closed_forms.slope_slide(0.3, np.tan(0.31), 9.81, 2.0) == (0.0, 0.0)
    distance, speed = closed_forms.slope_slide(0.3, 0.0, 10.0, 2.0)
    np.testing.assert_allclose([distance, speed], 10 * np.sin(0.3) * np.array([2, 2]))


def test_a_wheel_brakes_each_direction_by_its_own_coefficient():
    distance, speed = closed_forms.wheel_decay([1.0, 2.0], [0.5, 10.0], 2.0, 50.0)
    np.testing.assert_allclose(distance, [1.0 * 2.0 / 0.5, 2.0 * 2.0 / 10.0], rtol=1e-5)
    assert speed[0] > speed[1] >= 0.0


def test_a_spinning_bar_keeps_its_anchor_on_the_pin():
    state = closed_forms.pinned_spin([0.2, 0.1], np.array([1.0, 2.0]), 0.4, 3.0, 0.7)
    cos, sin = np.cos(state[2]), np.sin(state[2])
    anchor = state[:2] + np.array([[cos, -sin], [sin, cos]]) @ [0.2, 0.1]
    np.testing.assert_allclose(anchor, [1.0, 2.0], atol=1e-12)
    turned = np.array([-(state[1] - 2.0), state[0] - 1.0])
    np.testing.assert_allclose(state[3:5], 3.0 * turned, atol=1e-12)


def test_free_flight_is_a_parabola():
    state = [0.0, 0.0, 0.1, 1.0, 2.0, 3.0]
    end = closed_forms.free_flight(state, (0.0, -10.0), 2.0)
    np.testing.assert_allclose(end, [2.0, 4.0 - 20.0, 6.1, 1.0, -18.0, 3.0])
