"""Grasps and ways that are planned: free where looked at closely, refused where not."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import ArmClearance, Held, ManipulatorPlanner
from boomdp_jax.interop import plan_motion
from boomdp_jax.physics import State
from boomdp_jax.planning import motion_points
from tests.envs.arm_rooms import BOX_POSE, FOLDED, HALF_GAP, ROBOT, room, straight

WORLD = room()
BOX = WORLD.spec.index("box")
BELOW = np.array([0.0, -0.15])
"""A point of the box."""
START = WORLD.state(FOLDED)
GRIPPERS = jax.jit(jax.vmap(ROBOT.gripper))


def planner(plan=straight, **options) -> ManipulatorPlanner:
    return ManipulatorPlanner(WORLD, plan, (-3.0, -2.0), (3.0, 2.0), **options)


def in_frame(frame: np.ndarray, pose: np.ndarray) -> np.ndarray:
    spin = np.exp(-1j * frame[2])
    offset = complex(*(pose[:2] - frame[:2])) * spin
    return np.array([offset.real, offset.imag, pose[2] - frame[2]])


@pytest.mark.slow
def test_grasps_are_free_and_their_gripper_faces_the_point():
    grasps = planner().grasps(0, START, BOX, BELOW)
    assert len(grasps) > 10
    room_of = ArmClearance(WORLD, WORLD.spec.pose)
    assert room_of.is_free(grasps).all()
    local = [in_frame(BOX_POSE, np.asarray(g)) for g in GRIPPERS(grasps)]
    away = -0.15 - np.array(local)[:, 1]
    assert np.all((away > 0.01) & (away < 0.04))
    assert np.max(np.abs(np.array(local)[:, 0])) < 1e-9
    tilt = np.abs(np.array(local)[:, 2] - np.pi / 2.0)
    tilt = np.minimum(tilt % (2 * np.pi), 2 * np.pi - tilt % (2 * np.pi))
    assert np.all(np.diff(tilt) >= -1e-9)
    assert tilt[-1] <= 0.6


def test_no_grasp_where_the_room_ends_or_a_wall_stands():
    tight = ManipulatorPlanner(WORLD, straight, (-3.0, -2.0), (-1.0, 2.0))
    assert len(tight.grasps(0, START, BOX, BELOW)) == 0
    assert tight.reach(0, START, tight.grasps(0, START, BOX, BELOW)) is None
    pose = WORLD.spec.pose
    pose[BOX] = [0.3, 1.0, 0.0]
    beside = State(START.pose.at[BOX].set(pose[BOX]), START.twist)
    assert len(planner().grasps(0, beside, BOX, np.array([-0.2, 0.0]))) == 0


def test_object_stays_on_its_way_and_in_the_gripper():
    plan = planner()
    grasp = plan.grasps(0, START, BOX, BELOW)[0]
    poses = BOX_POSE + np.array([[0.1, -0.3, 0.0], [0.1, -0.4, 0.4]])
    carry = plan.carry(0, START, grasp, BOX, poses)
    np.testing.assert_allclose(carry.corners[0], grasp, atol=1e-9)
    grip = in_frame(np.asarray(ROBOT.gripper(jnp.asarray(grasp))), BOX_POSE)
    way = np.concatenate([[BOX_POSE], poses])
    for gripper in np.asarray(GRIPPERS(carry.motion.configuration)):
        spin = np.exp(1j * gripper[2])
        at = complex(*gripper[:2]) + complex(*grip[:2]) * spin
        pose = np.array([at.real, at.imag, gripper[2] + grip[2]])
        legs = [off_leg(pose, *leg) for leg in itertools.pairwise(way)]
        assert min(legs) < 1e-9
    np.testing.assert_allclose(pose, poses[-1], atol=1e-9)
    # Rates and accelerations are those of the configurations.
    rate = np.diff(carry.motion.configuration, axis=0) / WORLD.spec.dt
    middle = 0.5 * (carry.motion.rate[1:] + carry.motion.rate[:-1])
    assert np.max(np.abs(rate - middle)) < 0.02


def off_leg(pose: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    along = end - start
    share = np.clip((pose - start) @ along / (along @ along), 0.0, 1.0)
    return float(np.abs(start + share * along - pose).max())


def test_way_through_a_wall_is_refused():
    plan = planner()
    grasp = plan.grasps(0, START, BOX, BELOW)[0]
    through = BOX_POSE + np.array([[-2.0, 0.5, 0.0]])
    assert plan.carry(0, START, grasp, BOX, through) is None
    assert plan.manipulate(0, START, BOX, BELOW, through) is None


@pytest.mark.slow
def test_planned_motions_are_free_when_looked_at_ten_times_as_closely():
    pytest.importorskip("ompl")
    plan = planner(plan_motion)
    poses = BOX_POSE + np.array([[0.0, -0.5, 0.0]])
    for seed in range(3):
        reach, carry = plan.manipulate(seed, START, BOX, BELOW, poses)
        np.testing.assert_allclose(reach.corners[0], FOLDED, atol=1e-9)
        between = reach.corners[-1] - carry.corners[0]
        turns = between[2] / (2.0 * np.pi)
        assert abs(turns - round(turns)) < 1e-9
        assert np.max(np.abs(between[[0, 1, 3, 4]])) < 1e-9
        fine = plan.resolution / 10.0
        empty = ArmClearance(WORLD, WORLD.spec.pose)
        points = motion_points(reach.corners, ROBOT.levers, fine)
        is_grip = np.all(empty.pairs == [WORLD.bodies[-1], BOX], axis=1)
        left = plan.margin - 0.5 * plan.resolution
        # The gripper comes near the box, all else keeps what is sure.
        assert empty.is_free(points, np.where(is_grip, 0.0, left)).all()
        gripper = np.asarray(ROBOT.gripper(jnp.asarray(carry.corners[0])))
        full = ArmClearance(
            WORLD, WORLD.spec.pose, Held(BOX, in_frame(gripper, BOX_POSE))
        )
        assert full.is_free(carry.motion.configuration).all()
    assert HALF_GAP > ROBOT.base_radius + plan.margin


def test_margin_that_is_used_up_between_two_points_is_refused():
    with pytest.raises(ValueError, match="margin: expected at least half of the res"):
        planner(margin=0.01, resolution=0.04)


def test_least_place_that_is_not_below_the_greatest_is_refused():
    message = r"^lower: expected numbers below upper = \(3\.0, -2\.0\), got \(-3\.0, 2"
    with pytest.raises(ValueError, match=message):
        ManipulatorPlanner(WORLD, straight, (-3.0, 2.0), (3.0, -2.0))
