"""Room of configurations: against the Minkowski difference, and held objects' laws."""

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import ArmClearance, Held
from tests.envs.arm_rooms import FOLDED, ROBOT, room
from tests.reference.minkowski import signed_distance

WORLD = room()
POSE = WORLD.spec.pose
BASE, UPPER_ARM, FOREARM = WORLD.bodies
BOX = WORLD.spec.index("box")


def draws(num: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (num, 5)) * [2.0, 1.5, 3.2, *ROBOT.joint_limit]


def corners_of(body: int, pose: np.ndarray) -> np.ndarray:
    corners = WORLD.spec.bodies[body].vertices
    corners = corners if len(corners) else np.zeros((1, 2))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return corners @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]


def test_clearance_is_that_of_the_minkowski_difference():
    room_of = ArmClearance(WORLD, POSE)
    cases = draws(70)
    found = room_of.clearance(cases)
    assert found.shape == (70, 3 * 3 + 1)
    for q, row in zip(cases, found, strict=True):
        pose = np.array(POSE)
        pose[list(WORLD.bodies)] = np.asarray(ROBOT.body_poses(jnp.asarray(q)))
        for (a, b), gap in zip(room_of.pairs, row, strict=True):
            radius = WORLD.spec.bodies[a].radius + WORLD.spec.bodies[b].radius
            one, other = (corners_of(i, pose[i]) for i in (a, b))
            assert abs(gap - signed_distance(one, other, radius)) < 1e-9


def test_held_object_is_where_the_gripper_has_it():
    q = draws(1, 1)[0]
    gripper = np.asarray(ROBOT.gripper(jnp.asarray(q)))
    cos, sin = np.cos(gripper[2]), np.sin(gripper[2])
    grip = np.array([0.3, -0.1, 0.7])
    put = np.array(POSE)
    turned = np.array([[cos, -sin], [sin, cos]]) @ grip[:2]
    put[BOX] = gripper + np.array([*turned, grip[2]])
    held = ArmClearance(WORLD, POSE, Held(BOX, grip))
    there = ArmClearance(WORLD, put)

    def by_pair(room_of):
        pairs = (frozenset(pair) for pair in room_of.pairs.tolist())
        return dict(zip(pairs, room_of.clearance(q[None])[0], strict=True))

    found, expected = by_pair(held), by_pair(there)
    assert frozenset({FOREARM, BOX}) not in found
    # What the robot holds meets walls, which a box that lies there was not asked about.
    assert len(found) == len(expected) - 1 + 2
    for pair, gap in found.items():
        if pair in expected:
            assert abs(gap - expected[pair]) < 1e-12


def test_joints_beyond_their_range_and_the_forearm_in_the_base_are_not_free():
    room_of = ArmClearance(WORLD, POSE)
    beyond = np.array([*FOLDED[:4], -2.7])
    inside = np.array([*FOLDED[:3], 1.8, 2.3])
    assert room_of.is_free(np.stack([FOLDED, beyond, inside])).tolist() == [
        True,
        False,
        False,
    ]
    assert room_of.clearance(inside[None])[0, -1] < 0.0
    assert not room_of.is_free(FOLDED[None], margin=3.0)[0]


def test_wall_cannot_be_held():
    wall = WORLD.spec.index("wall 0")
    with pytest.raises(ValueError, match="held: body: expected one of"):
        ArmClearance(WORLD, POSE, Held(wall, np.zeros(3)))
