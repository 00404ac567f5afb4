"""Outlines: moments against closed forms and another engine, and where they stand."""

import numpy as np
import pymunk
import pytest

from boomdp_jax.physics.shapes import (
    box_outline,
    check_outline,
    circle_moments,
    foot_loads,
    longer_axis,
    polygon_moments,
    support_feet,
)


def _regular(num: int, radius: float = 1.0) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(num) / num
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _random_convex(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 7))
    on_ellipse = np.stack([1.3 * np.cos(angle), 0.4 * np.sin(angle)], axis=-1)
    return on_ellipse @ _rotation(rng.uniform(0.0, 6.0)).T + rng.normal(size=2)


def test_a_box_has_its_textbook_moments():
    moments = polygon_moments(box_outline(np.array([0.6, 0.3])))
    np.testing.assert_allclose(moments.area, 4 * 0.6 * 0.3)
    np.testing.assert_allclose(moments.centroid, 0.0, atol=1e-15)
    np.testing.assert_allclose(
        moments.covariance, np.diag([0.6**2 / 3, 0.3**2 / 3]), atol=1e-15
    )
    np.testing.assert_allclose(moments.gyration, (0.6**2 + 0.3**2) / 3)


def test_a_right_triangle_has_its_textbook_moments():
    moments = polygon_moments(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 1.5]]))
    np.testing.assert_allclose(moments.area, 2.25)
    np.testing.assert_allclose(moments.centroid, [1.0, 0.5])
    # b²/18 along each leg, and -b h/36 between them.
    expected = np.array([[9.0 / 18, -4.5 / 36], [-4.5 / 36, 2.25 / 18]])
    np.testing.assert_allclose(moments.covariance, expected)


def test_a_polygon_of_many_sides_tends_to_the_circle():
    circle = circle_moments(0.7)
    errors = []
    for num in (50, 100):
        polygon = polygon_moments(_regular(num, 0.7))
        errors.append(
            [abs(polygon.area / circle.area - 1), abs(polygon.gyration / 0.245 - 1)]
        )
    # The inscribed polygon's error falls as the square of the number of sides.
    np.testing.assert_allclose(np.divide(*errors), 4.0, rtol=0.02)
    np.testing.assert_allclose(circle.gyration, 0.7**2 / 2)


@pytest.mark.parametrize("seed", range(8))
def test_moments_agree_with_chipmunk(seed: int):
    vertices = _random_convex(seed)
    moments = polygon_moments(vertices)
    corners = [tuple(corner) for corner in vertices - moments.centroid]
    body = pymunk.Body(1.0, 1.0)
    shape = pymunk.Poly(body, corners)
    np.testing.assert_allclose(moments.area, shape.area, rtol=1e-9)
    np.testing.assert_allclose(
        [shape.center_of_gravity.x, shape.center_of_gravity.y], 0.0, atol=1e-9
    )
    inertia = pymunk.moment_for_poly(1.0, corners)
    np.testing.assert_allclose(moments.gyration, inertia, rtol=1e-9)


def test_moments_do_not_depend_on_where_the_outline_lies():
    near = polygon_moments(_random_convex(0))
    far = polygon_moments(_random_convex(0) + 1e4)
    np.testing.assert_allclose(far.covariance, near.covariance, rtol=1e-6)


def inside(corners, num=300):
    """Points of a fine grid that lie in a convex outline."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    share = (np.arange(num) + 0.5) / num
    grid = np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2)
    points = low + grid * (high - low)
    edges = np.roll(corners, -1, axis=0) - corners
    ahead = points[:, None] - corners[None]
    cross = edges[:, 0] * ahead[..., 1] - edges[:, 1] * ahead[..., 0]
    return points[np.all(cross > 0, axis=1)]


@pytest.mark.parametrize("seed", range(4))
def test_reach_is_the_mean_distance_from_the_centroid(seed: int):
    corners = _random_convex(seed)
    moments = polygon_moments(corners)
    distance = np.linalg.norm(inside(corners) - moments.centroid, axis=1)
    assert moments.reach == pytest.approx(np.mean(distance), rel=2e-3)


def test_reach_of_a_square_and_of_a_disc_is_that_of_the_tables():
    square = polygon_moments(box_outline(np.array([0.5, 0.5])))
    assert square.reach == pytest.approx((np.sqrt(2) + np.arcsinh(1)) / 6)
    assert circle_moments(0.3).reach == pytest.approx(0.2)
    assert polygon_moments(_regular(360)).reach == pytest.approx(2 / 3, rel=1e-4)


OUTLINES = {
    "disc": (_regular(360), 0.015),
    "square": (box_outline(np.array([0.2, 0.2])), 0.025),
    "box": (box_outline(np.array([0.6, 0.3])), 0.025),
    "plank": (box_outline(np.array([1.0, 0.1])), 0.06),
    "polygon": (_random_convex(2), 0.05),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTLINES)
def test_feet_of_an_outline_rub_as_all_of_it_does(name: str):
    """Friction of an even pressure, integrated, in every ratio of spin to speed."""
    corners, most = OUTLINES[name]
    moments = polygon_moments(corners)
    points = inside(corners) - moments.centroid
    feet, size = support_feet(moments, is_round=name == "disc")
    np.testing.assert_allclose(np.mean(feet, axis=0), 0.0, atol=1e-12)
    rng = np.random.default_rng(0)
    misses = []
    for _ in range(200):
        angle = rng.uniform(-np.pi, np.pi)
        velocity = np.array([np.cos(angle), np.sin(angle)])
        spin = np.exp(1.2 * rng.normal() + 0.5) / np.max(np.hypot(*points.T))

        def force(place, lever, velocity=velocity, spin=spin):
            turn = np.stack([-place[:, 1], place[:, 0]], axis=1)
            speed = velocity + spin * turn
            total = np.sqrt(np.sum(speed**2, axis=1) + (lever * spin) ** 2)
            torque = (np.sum(speed * turn, axis=1) + lever**2 * spin) / total
            x, y = np.mean(speed / total[:, None], axis=0)
            return np.array([x, y, np.mean(torque) / moments.reach])

        misses.append(np.sum((force(points, 0.0) - force(feet, size)) ** 2))
    assert np.sqrt(np.mean(misses)) < most


def test_feet_resist_a_pure_spin_as_all_of_the_outline_does():
    moments = polygon_moments(_random_convex(1))
    feet, size = support_feet(moments)
    arms = np.hypot(np.hypot(*feet.T), size)
    assert np.mean(arms) == pytest.approx(moments.reach, rel=1e-12)


def test_feet_of_a_box_stand_about_the_middles_of_equal_parts():
    feet, _ = support_feet(polygon_moments(box_outline(np.array([0.6, 0.3]))))
    rows, columns = (np.unique(np.round(feet[:, axis], 9)) for axis in (1, 0))
    np.testing.assert_allclose(rows, [-0.95 * 0.2, 0.0, 0.95 * 0.2], atol=1e-9)
    np.testing.assert_allclose(columns, [-0.95 * 0.4, 0.0, 0.95 * 0.4], atol=1e-9)


def test_loads_on_three_feet_are_the_lever_rule():
    feet = np.array([[1.0, 0.0], [-1.0, 1.0], [-1.0, -3.0]])
    # Moments about both axes: w1 = w2 + w3, w2 = 3 w3, all summing to one.
    np.testing.assert_allclose(foot_loads(feet), [0.5, 0.375, 0.125])


@pytest.mark.parametrize("seed", range(6))
def test_loads_balance_wherever_they_can(seed: int):
    feet = np.random.default_rng(seed).normal(size=(6, 2))
    feet -= np.random.default_rng(seed + 100).dirichlet(np.ones(6)) @ feet
    loads = foot_loads(feet)
    assert np.all(loads >= 0)
    np.testing.assert_allclose(np.sum(loads), 1.0)
    np.testing.assert_allclose(loads @ feet, 0.0, atol=1e-9)


def test_feet_that_cannot_balance_carry_the_same():
    np.testing.assert_allclose(
        foot_loads(np.array([[1.0, 0.0], [2.0, 1.0], [2.0, -1.0]])), 1 / 3
    )


@pytest.mark.parametrize(
    "vertices",
    [
        box_outline(np.array([0.6, 0.3])),
        np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 1.0]]),
        _regular(64),
        _random_convex(3),
    ],
    ids=["box", "corner on an edge", "many corners", "random"],
)
def test_convex_outlines_pass(vertices: np.ndarray):
    check_outline(vertices)
    with pytest.raises(ValueError, match="counter-clockwise, got them clockwise"):
        check_outline(vertices[::-1])


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        ([[0, 0], [1, 0]], "at least 3 corners, got 2"),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], r"distinct corners, got \[1.0, 0.0\] twice"),
        ([[0, 0], [2, 0], [0.5, 0.5], [0, 2]], r"turns in at corner 2, \[0.5, 0.5\]"),
        ([[0, 0], [1, 0], [2, 0]], "convex outline"),
        ([[0, 0], [2, 0], [1, 0], [0, 1]], "convex outline"),
        (_regular(5)[[0, 2, 4, 1, 3]], "winds more than once"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "convex outline"),
    ],
    ids=["segment", "twice", "dent", "line", "spike", "star", "bow tie"],
)
def test_other_outlines_are_refused(vertices: list, message: str):
    with pytest.raises(ValueError, match=message):
        check_outline(np.asarray(vertices, float))


def test_the_longer_axis_of_a_turned_box_is_its_turn():
    for turn in (0.0, 0.7, -1.2):
        cos, sin = np.cos(turn), np.sin(turn)
        corners = box_outline(np.array([0.6, 0.3])) @ np.array(
            [[cos, sin], [-sin, cos]]
        )
        assert longer_axis(polygon_moments(corners)) == pytest.approx(turn, abs=1e-9)
    assert longer_axis(circle_moments(0.3)) == 0.0
    assert longer_axis(polygon_moments(box_outline(np.array([0.2, 0.2])))) == 0.0
