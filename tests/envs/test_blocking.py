"""Boxes that stop boxes, against linear programming and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from boomdp_jax.envs import Boxes, stopped_by_boxes
from boomdp_jax.envs.blocking import box_separation
from boomdp_jax.physics import State

HALF = jnp.array([0.5, 0.2])


def half_planes(pose, half):
    """A box as A x <= b."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    normals = np.array([[cos, sin], [-sin, cos]])
    normals = np.concatenate([normals, -normals])
    return normals, normals @ np.asarray(pose[:2]) + np.tile(half, 2)


def depth_of_overlap(one, other):
    """How far both boxes can be shrunk and still share a point; negative: apart."""
    (a, b), (c, d) = one, other
    rows = np.concatenate([a, c])
    found = linprog(
        [0.0, 0.0, -1.0],
        A_ub=np.concatenate([rows, np.ones((8, 1))], axis=1),
        b_ub=np.concatenate([b, d]),
        bounds=[(None, None)] * 3,
    )
    assert found.success
    return found.x[2]


def test_boxes_are_apart_exactly_where_no_point_is_in_both():
    rng = np.random.default_rng(4)
    separation = jax.jit(box_separation)
    num_apart = 0
    for _ in range(60):
        poses = np.concatenate(
            [rng.uniform(-0.9, 0.9, (3, 2)), rng.uniform(-4, 4, (3, 1))], axis=1
        )
        half = rng.uniform(0.1, 0.6, (3, 2))
        others = Boxes(jnp.asarray(poses[1:]), jnp.asarray(half[1:]))
        gap = float(separation(others, half[0], poses[0]))
        own = half_planes(poses[0], half[0])
        depth = max(
            depth_of_overlap(own, half_planes(pose, size))
            for pose, size in zip(poses[1:], half[1:], strict=True)
        )
        assert np.sign(gap) == -np.sign(depth)
        num_apart += gap > 0
    assert 10 < num_apart < 50


def test_the_gap_between_parallel_boxes_is_their_distance():
    boxes = Boxes(jnp.array([[2.0, 0.1, np.pi / 2]]), jnp.array([[0.3, 0.4]]))
    gap = box_separation(boxes, HALF, jnp.zeros(3))
    np.testing.assert_allclose(gap, 2.0 - 0.5 - 0.4, atol=1e-12)


def shifted(x, start=0.0, y=0.0, speed=1.0):
    """A step along the x axis."""
    before = State(jnp.array([[start, y, 0.0]]), jnp.zeros((1, 3)))
    after = State(jnp.array([[x, y, 0.0]]), jnp.array([[speed, 0.0, 0.0]]))
    return before, after


@pytest.mark.parametrize(
    ("target", "reached"), [(0.9, 0.9), (1.1, 0.825), (1.6, 0.8), (-2.0, -2.0)]
)
def test_a_box_stops_at_the_last_check_before_another_one(target, reached):
    # The wall's face is at x = 1.5, and so is the box's at x = 1.
    wall = Boxes(jnp.array([[2.0, 0.0, 0.0]]), jnp.array([[0.5, 3.0]]))
    found = stopped_by_boxes(wall, HALF, *shifted(target))
    np.testing.assert_allclose(found.pose[0, 0], reached, atol=1e-12)
    assert float(found.twist[0, 0]) == (1.0 if reached == target else 0.0)


def test_a_box_that_overlaps_gets_away_but_no_deeper():
    wall = Boxes(jnp.array([[2.0, 0.0, 0.0]]), jnp.array([[0.5, 3.0]]))
    deeper = stopped_by_boxes(wall, HALF, *shifted(1.2, start=1.05))
    assert float(deeper.pose[0, 0]) == 1.05
    away = stopped_by_boxes(wall, HALF, *shifted(0.6, start=1.05))
    np.testing.assert_allclose(away.pose[0, 0], 0.6)
    before, after = shifted(1.05, start=1.05)
    along = State(after.pose.at[0, 1].set(0.4), after.twist)
    np.testing.assert_allclose(
        stopped_by_boxes(wall, HALF, before, along).pose, along.pose
    )
