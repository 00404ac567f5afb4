"""Outlines: moments against closed forms and another engine, and where they stand."""

import numpy as np
import pymunk
import pytest

from boomdp_jax.physics.shapes import (
    box_outline,
    check_outline,
    circle_moments,
    foot_loads,
    polygon_moments,
    support_points,
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


@pytest.mark.parametrize("seed", range(4))
def test_support_points_have_the_second_moments_of_the_outline(seed: int):
    moments = polygon_moments(_random_convex(seed))
    feet = support_points(moments)
    np.testing.assert_allclose(np.mean(feet, axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(feet.T @ feet / 4, moments.covariance, atol=1e-12)


def test_support_points_of_a_box_lie_along_its_sides():
    feet = support_points(polygon_moments(box_outline(np.array([0.6, 0.3]))))
    expected = box_outline(np.array([0.6, 0.3])) / np.sqrt(3)
    np.testing.assert_allclose(
        sorted(feet.round(12).tolist()), sorted(expected.round(12).tolist())
    )


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
