"""The quasi-static reference dissipates most, and a towed body trails its tow."""

import numpy as np
import pytest

from tests.reference import limit_surface

FEET = np.array([[0.2, 0.1], [-0.2, 0.1], [-0.2, -0.1], [0.2, -0.1]])
LIMIT = np.full(4, 1.5)


@pytest.mark.parametrize(
    "law", [limit_surface.foot_wrench, limit_surface.ellipsoid_wrench]
)
def test_friction_dissipates_at_least_what_any_other_wrench_of_the_law_would(law):
    rng = np.random.default_rng(0)
    twists = rng.normal(size=(40, 3)) * [1.0, 1.0, 5.0]
    wrenches = np.array([law(FEET, LIMIT, twist) for twist in twists])
    power = wrenches @ twists.T
    assert np.all(np.diag(power) < 0.0)
    assert np.all(np.diag(power)[None, :] <= power + 1e-9)


@pytest.mark.parametrize(
    "law", [limit_surface.foot_wrench, limit_surface.ellipsoid_wrench]
)
def test_both_laws_agree_on_a_pure_slide_and_a_pure_spin(law):
    slide = law(FEET, LIMIT, np.array([0.3, -0.4, 0.0]))
    np.testing.assert_allclose(slide, [-3.6, 4.8, 0.0], atol=1e-12)
    spin = law(FEET, LIMIT, np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(spin, [0, 0, -6.0 * np.hypot(0.2, 0.1)], atol=1e-12)


def test_a_body_towed_in_line_does_not_turn():
    spin = limit_surface.towed_spin(FEET, LIMIT, [0.3, 0.0], [0.05, 0.0])
    assert abs(spin) < 1e-9


def test_the_tow_gives_no_moment_about_its_point():
    anchor, velocity = np.array([0.3, 0.1]), np.array([0.02, 0.05])
    spin = limit_surface.towed_spin(FEET, LIMIT, anchor, velocity)
    twist = [*(velocity - spin * np.array([-anchor[1], anchor[0]])), spin]
    wrench = limit_surface.foot_wrench(FEET, LIMIT, twist)
    assert abs(wrench[2] - anchor[0] * wrench[1] + anchor[1] * wrench[0]) < 1e-9
    assert spin > 0.05


def test_a_towed_body_falls_in_behind_its_tow():
    times = np.linspace(0.0, 60.0, 13)
    heading = limit_surface.towed_heading(
        FEET, LIMIT, [0.3, 0.0], [0.05, 0.0], 1.2, times
    )
    assert np.all(np.diff(heading) < 0.0)
    assert 0.0 <= heading[-1] < 0.02
