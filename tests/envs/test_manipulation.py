"""The robot in the engine: planned motions are followed, and grasps have limits."""

import dataclasses

import jax
import numpy as np
import pytest

from boomdp_jax.envs import (
    Grip,
    ManipulatorPlanner,
    follow_motion,
    open_grasp,
    take_hold,
)
from boomdp_jax.interop import plan_motion
from boomdp_jax.physics import Params
from boomdp_jax.physics.quantities import mass_and_inertia
from boomdp_jax.planning import TimedMotion
from tests.envs.arm_rooms import BOX_POSE, FOLDED, ROBOT, room, straight

WORLD = room()
BOX = WORLD.spec.index("box")
BELOW = np.array([0.0, -0.15])
PULL = np.array([0.0, -0.5, 0.0])
PIN, GROUND = 2, 0
"""Slots of the box's pin and floor."""
BEYOND = np.array([0.8, 0.0, 0.0, 1.4, -2.5])
"""Folded, behind the wall."""


def params(*, is_pinned: bool = False, is_on_floor: bool = True) -> Params:
    """The room, its structure as data."""
    known = WORLD.params()
    pins = known.revolute
    pins = dataclasses.replace(pins, active=pins.active.at[PIN].set(is_pinned))
    floor = known.ground
    active = floor.active.at[BOX, GROUND].set(is_on_floor)
    floor = dataclasses.replace(floor, active=active)
    return dataclasses.replace(known, revolute=pins, ground=floor)


def planner(plan=straight, **options) -> ManipulatorPlanner:
    return ManipulatorPlanner(WORLD, plan, (-3.0, -2.0), (3.0, 2.0), **options)


def grasping(**options):
    """A state in which the gripper is at the box, and the way to pull it."""
    start = WORLD.state(FOLDED)
    grasp = planner().grasps(0, start, BOX, BELOW)[0]
    carry = planner(**options).carry(0, start, grasp, BOX, BOX_POSE[None] + PULL)
    return WORLD.state(grasp), carry.motion


@pytest.mark.slow
def test_robot_drives_through_the_gap_and_pulls_the_box_where_it_should_go():
    pytest.importorskip("ompl")
    plan = planner(plan_motion)
    state, truth = WORLD.state(FOLDED), params()
    drive = plan.move(0, state, BEYOND[None])
    through = follow_motion(WORLD, truth, state, drive.motion)
    place = WORLD.configuration(through.state)
    assert np.max(np.abs(np.asarray(place) - BEYOND)) < 0.01
    found = plan.manipulate(0, through.state, BOX, BELOW, BOX_POSE[None] + PULL)
    reached = follow_motion(WORLD, truth, through.state, found.reach.motion)
    np.testing.assert_array_equal(reached.state.pose[BOX], BOX_POSE)
    held = take_hold(WORLD, reached.params, reached.state, BOX)
    pulled = follow_motion(WORLD, held, reached.state, found.carry.motion)
    for part in (through, reached, pulled):
        # Contact lets outlines overlap by about a millimetre.
        assert part.overlap.max() < 1e-3
        # Less than what planned configurations have to spare.
        assert np.abs(part.error[:, :2]).max() < 0.02
    assert pulled.grasp.is_held.all()
    # The base gives way by a few mm to a floor that rubs with 21 N.
    off = np.asarray(pulled.state.pose[BOX]) - (BOX_POSE + PULL)
    assert np.abs(off[:2]).max() < 0.02
    assert abs(off[2]) < 0.03
    # Let go, the robot leaves the box where it is, and comes home.
    home = plan.move(0, pulled.state, FOLDED[None])
    let_go = open_grasp(pulled.params)
    left = follow_motion(WORLD, let_go, pulled.state, home.motion)
    assert not left.grasp.is_held.any()
    assert not left.grasp.has_slipped.any()
    assert left.overlap.max() < 1e-3
    moved = np.asarray(left.state.pose[BOX] - pulled.state.pose[BOX])
    assert np.abs(moved).max() < 1e-3
    error = np.asarray(WORLD.configuration(left.state)) - home.corners[-1]
    assert np.abs((error + np.pi) % (2.0 * np.pi) - np.pi).max() < 0.01


@pytest.mark.slow
def test_box_is_turned_and_taken_through_the_gap():
    pytest.importorskip("ompl")
    plan, state = planner(plan_motion), WORLD.state(FOLDED)
    poses = np.array([[0.9, 0.0, 0.0], [-0.8, 0.0, 0.0]])
    found = plan.manipulate(0, state, BOX, np.array([-0.2, 0.0]), poses)
    reached = follow_motion(WORLD, params(), state, found.reach.motion)
    held = take_hold(WORLD, reached.params, reached.state, BOX)
    carried = follow_motion(WORLD, held, reached.state, found.carry.motion)
    assert carried.grasp.is_held.all()
    assert max(reached.overlap.max(), carried.overlap.max()) < 1e-3
    assert np.abs(carried.state.pose[BOX] - poses[-1]).max() < 0.02


@pytest.mark.slow
def test_reaction_felt_is_what_gives_the_box_its_momentum():
    state, motion = grasping()
    truth = take_hold(WORLD, params(is_on_floor=False), state, BOX)
    followed = follow_motion(WORLD, truth, state, motion)
    twist = np.concatenate([[state.twist[BOX]], followed.states.twist[:, BOX]])
    pose = np.concatenate([[state.pose[BOX]], followed.states.pose[:, BOX]])
    change = np.diff(twist, axis=0) / WORLD.spec.dt
    mass, inertia = (
        float(m[BOX]) for m in jax.jit(mass_and_inertia)(WORLD.scene, truth)
    )
    force = followed.grasp.force
    assert np.abs(force).max() > 5.0
    np.testing.assert_allclose(-mass * change[:, :2], force, atol=1e-6)
    forearms = np.concatenate(
        [[state.pose[WORLD.bodies[2]]], followed.states.pose[:, WORLD.bodies[2]]]
    )
    angle = forearms[:, 2:]
    tip = forearms[:, :2] + 0.5 * ROBOT.forearm * np.concatenate(
        [np.cos(angle), np.sin(angle)], axis=1
    )
    arm = (pose[:, :2] - tip)[1:] / 2.0 + (pose[:, :2] - tip)[:-1] / 2.0
    moment = inertia * change[:, 2]
    moment += mass * (arm[:, 0] * change[:, 1] - arm[:, 1] * change[:, 0])
    # Forces act throughout the step, arms are those of its middle.
    scale = np.abs(moment).max()
    assert np.abs(moment + followed.grasp.torque).max() < 0.01 * scale


@pytest.mark.slow
def test_weak_gripper_lets_go_of_a_pinned_box_and_never_bore_more_than_it_may():
    # So gently that the pull grows by less than a tenth of the limit in a step.
    state, motion = grasping(acceleration=0.1)
    limit = 40.0
    truth = take_hold(WORLD, params(is_pinned=True), state, BOX)
    followed = follow_motion(WORLD, truth, state, motion, grip=Grip(force=limit))
    size = np.hypot(*followed.grasp.force.T)
    last = int(np.argmax(followed.grasp.has_slipped))
    assert followed.grasp.has_slipped.sum() == 1
    assert followed.grasp.is_held[:last].all()
    assert not followed.grasp.is_held[last:].any()
    assert 0.9 * limit < size.max() <= limit
    assert np.abs(followed.grasp.torque).max() <= Grip().torque
    moved = np.asarray(followed.states.pose[:last, BOX, :2]) - BOX_POSE[:2]
    assert np.abs(moved).max() < 1e-4
    assert not followed.params.weld.active[-1]
    # Let go, the robot comes to where it was to come.
    assert np.abs(followed.error[-1]).max() < 0.01
    # A strong one does not let go, and feels more.
    strong = follow_motion(WORLD, truth, state, motion, grip=Grip(1e4, 1e4))
    assert strong.grasp.is_held.all()
    assert np.hypot(*strong.grasp.force.T).max() > limit


@pytest.mark.slow
def test_bumping_into_a_wall_does_not_drop_what_is_held():
    state, _ = grasping()
    truth = take_hold(WORLD, params(is_on_floor=False), state, BOX)
    # Aslant at the wall, beside its gap, as if there were none, and on.
    start = np.asarray(WORLD.configuration(state))
    seconds = WORLD.spec.dt * np.arange(256)
    offset = np.outer(seconds, [-0.3, -0.2, 0.0, 0.0, 0.0])
    rate = np.gradient(offset, WORLD.spec.dt, axis=0)
    motion = TimedMotion(start + offset, rate, np.zeros_like(rate))
    followed = follow_motion(WORLD, truth, state, motion)
    # The base stands at the wall, and pushes with all it has.
    gap = followed.states.pose[-1, WORLD.bodies[0], 0] - 0.1 - ROBOT.base_radius
    assert abs(gap) < 1e-3
    assert followed.error[-1, 0] > 0.1
    assert ROBOT.base_force > Grip().force
    assert followed.grasp.is_held.all()
    # What is felt is what the box is given all the same, bump included.
    twist = np.concatenate([[state.twist[BOX]], followed.states.twist[:, BOX]])
    mass = float(jax.jit(mass_and_inertia)(WORLD.scene, truth)[0][BOX])
    given = mass * np.diff(twist, axis=0)[:, :2] / WORLD.spec.dt
    assert np.abs(given).max() > 5.0
    np.testing.assert_allclose(-given, followed.grasp.force, atol=1e-6)


def test_gripper_holds_only_what_is_near_and_can_move_and_closing_moves_nothing():
    state, _ = grasping()
    held = take_hold(WORLD, params(), state, BOX)
    weld = held.weld
    # The same shapes and types: whatever is compiled for the one does for the other.
    opened = open_grasp(held)
    assert jax.tree.map(jax.typeof, held) == jax.tree.map(jax.typeof, opened)
    gripper = np.asarray(ROBOT.gripper(WORLD.configuration(state)))
    spin = np.exp(1j * BOX_POSE[2])
    at = complex(*BOX_POSE[:2]) + complex(*weld.anchor_b[-1]) * spin
    assert abs(at - complex(*gripper[:2])) < 1e-12
    assert abs(weld.angle[-1] - (gripper[2] - BOX_POSE[2])) < 1e-12
    assert weld.active[-1]
    assert not opened.weld.active[-1]
    for body in ("wall 0", "robot base"):
        with pytest.raises(ValueError, match="body: expected one that can move, with"):
            take_hold(WORLD, params(), state, WORLD.spec.index(body))
    with pytest.raises(ValueError, match="within reach of the gripper, got 'box'"):
        take_hold(WORLD, params(), WORLD.state(FOLDED), BOX)


def test_params_without_room_for_a_grasp_are_refused():
    with pytest.raises(ValueError, match="weld: expected a slot for the grasp"):
        open_grasp(WORLD.spec.params())
