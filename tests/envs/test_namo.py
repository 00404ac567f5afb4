"""The robot in its room: what it holds, feels, is told, and when it has arrived."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import (
    FreeSpace,
    NamoReading,
    drive,
    going,
    grasped,
    is_at_goal,
    make_world,
    pushing,
    with_delay,
)
from boomdp_jax.envs.namo import NOBODY, REACH, SENSORS, _delayed
from boomdp_jax.envs.namo_drive import NUM_STEPS
from boomdp_jax.physics import State
from boomdp_jax.physics.scene_spec import STANDARD_GRAVITY
from boomdp_jax.planning import ways_from
from tests.envs.namo_rooms import GOAL, poses_of, room, thing

ROBOT = room().robot
STEP = 0.1
MASS = thing().mass
WEIGHT = STANDARD_GRAVITY * MASS
KEY = jax.random.key(0)
SILENT = jnp.zeros(5)
AT = (1.5, 1.0, 0.0)
"""Of things that are held."""
hold, arrived = jax.jit(grasped), jax.jit(is_at_goal)


def holding(angle=np.pi, *, floor=True, at=AT, **changes):
    """The robot holds a thing from one side of it, and its sensors tell the truth."""
    one = thing(pose=at, **changes)
    world, state = make_world(room(one), noise=SILENT)
    side = np.array([np.cos(angle), np.sin(angle)])
    away = np.abs(side) @ one.outline + ROBOT.radius + 0.04
    state = placed(state, at[:2] + away * side)
    if not floor:
        ground = world.physics.ground
        ground = dataclasses.replace(ground, active=jnp.zeros_like(ground.active))
        physics = dataclasses.replace(world.physics, ground=ground)
        world = dataclasses.replace(world, physics=physics)
    state = hold(world, state, 0)
    assert state.held == 0
    return world, state


def placed(state, place, body=1):
    """A body of the room put elsewhere, at rest."""
    pose = np.array(state.physics.pose)
    pose[body, : len(place)] = place
    pose = jnp.asarray(pose)
    return dataclasses.replace(state, physics=State(pose, 0.0 * pose))


def moved(driven, body=0):
    """How far a body came from the first step's end on [m]."""
    place = np.asarray(driven.place)[:, body]
    return np.linalg.norm(place[-1, :2] - place[0, :2])


@pytest.mark.slow
def test_force_at_the_wrist_is_what_friction_and_inertia_of_the_thing_ask_for():
    world, state = holding(friction=0.3)
    pull = -200.0
    _, driven = drive(KEY, world, state, pushing(np.array([pull, 0.0, 0.0])))
    acceleration = (-pull - 0.3 * WEIGHT) / (MASS + ROBOT.mass)
    force = 0.3 * WEIGHT + MASS * acceleration
    # From the second step on it slides faster than friction needs to be at its limit.
    wrench = np.asarray(driven.reading.wrench)[1:]
    np.testing.assert_allclose(wrench[:, 0], -force, rtol=1e-6)
    np.testing.assert_allclose(wrench[:, 1:], 0.0, atol=1e-6)
    twist = np.asarray(driven.reading.after.twist)[:, 0, 0]
    np.testing.assert_allclose(np.diff(twist) / STEP, -acceleration, rtol=1e-6)
    assert np.all(driven.reading.held == 0)
    assert not driven.has_slipped
    np.testing.assert_allclose(driven.force, force, rtol=1e-6)


@pytest.mark.slow
def test_to_hold_a_thing_however_it_stands_moves_nothing():
    for side, turn in ((np.pi, 0.5 * np.pi), (0.5 * np.pi, -2.5 * np.pi)):
        at = (*AT[:2], turn)
        world, state = holding(side, at=at, outline=(0.3, 0.3), floor=False)
        after, driven = drive(KEY, world, state, pushing(np.zeros(3)))
        np.testing.assert_allclose(
            after.physics.pose, state.physics.pose, rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(driven.reading.wrench, 0.0, atol=1e-6)


@pytest.mark.slow
def test_grasp_is_lost_rather_than_bear_more_than_the_grip():
    for kind in ("free", "fixed", "revolute"):
        world, state = holding(kind=kind, friction=0.3, pin=(0.0, 0.0))
        command = pushing(np.array([-200.0, 0.0, 0.0]))
        _, strong = drive(KEY, world, state, command)
        borne = np.abs(strong.reading.wrench[:, 0])
        assert np.all(strong.reading.held == 0)
        # Of what cannot be moved the hand bears all that the robot has.
        if kind != "free":
            np.testing.assert_allclose(borne, 200.0, rtol=1e-3)
        weak = dataclasses.replace(world, grip=jnp.asarray(0.5 * borne.min()))
        after, driven = drive(KEY, weak, state, command)
        assert driven.has_slipped
        assert driven.force <= weak.grip
        assert after.held == NOBODY
        assert np.all(driven.reading.held == NOBODY)
        assert np.all(driven.reading.wrench == 0.0)
        # The step is taken without the grasp: the thing stays, the robot drives off.
        np.testing.assert_allclose(after.physics.pose[0], AT, atol=1e-9)
        speed = after.physics.twist[1, 0]
        np.testing.assert_allclose(speed, -200.0 / 60.0 * STEP * NUM_STEPS, rtol=1e-6)
        enough = dataclasses.replace(world, grip=jnp.asarray(1.01 * borne.max()))
        assert not drive(KEY, enough, state, command)[1].has_slipped


@pytest.mark.slow
def test_each_kind_gives_way_as_its_name_says():
    across, along = np.array([0.0, -40.0, 0.0]), np.array([-200.0, 0.0, 0.0])
    creep = 0.02 * STEP * NUM_STEPS
    world, state = holding(kind="wheels")
    _, driven = drive(KEY, world, state, pushing(along))
    twist = np.asarray(driven.reading.after.twist)[:, 0, 0]
    rolling = (200.0 - 0.03 * WEIGHT) / (MASS + ROBOT.mass)
    np.testing.assert_allclose(np.diff(twist) / STEP, -rolling, rtol=1e-3)
    # Held from above, so that the pull goes through the wheel.
    world, state = holding(np.pi / 2, kind="wheels")
    assert 40.0 < 0.6 * WEIGHT
    assert moved(drive(KEY, world, state, pushing(across))[1]) < creep
    world, state = holding(kind="heavy", friction=3.0)
    assert moved(drive(KEY, world, state, pushing(along))[1]) < creep
    world, state = holding(kind="fixed")
    assert moved(drive(KEY, world, state, pushing(along))[1]) == 0.0
    world, state = holding(kind="revolute", pin=(0.2, 0.1))
    after, driven = drive(KEY, world, state, pushing(5.0 * across))
    angle = float(after.physics.pose[0, 2])
    assert abs(angle) > 0.1
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pin = np.asarray(after.physics.pose)[0, :2] + turn @ [0.2, 0.1]
    np.testing.assert_allclose(pin, np.add(AT[:2], (0.2, 0.1)), atol=1e-3)


@pytest.mark.slow
def test_wrench_at_the_wrist_explains_the_thing_while_the_robot_is_at_a_wall():
    # The robot stands at the lower wall, with the thing beside it, and pushes down.
    at = (1.5, ROBOT.radius - 5e-4, 0.0)
    world, state = holding(floor=False, at=at, outline=(0.3, 0.25))
    command = pushing(np.array([-120.0, -150.0, 0.0]))
    after, driven = drive(KEY, world, state, command)
    reading = driven.reading
    gained = np.asarray(reading.after.twist - reading.before.twist)[:, 0] / STEP
    inertia = MASS * (0.3**2 + 0.25**2) / 3.0
    wanted = gained * [MASS, MASS, inertia]
    wrench = np.asarray(reading.wrench)
    np.testing.assert_allclose(wrench[:, :2], wanted[:, :2], atol=1e-6)
    # Arms are those of the middle of the step.
    np.testing.assert_allclose(
        wrench[:, 2], wanted[:, 2], atol=0.02 * np.abs(wrench).max()
    )
    # The wall bears what the robot pushes down with, which is not the thing's.
    assert abs(float(after.physics.pose[1, 1]) - ROBOT.radius) < 1e-3
    assert np.abs(wrench[:, 1]).max() < 50.0
    assert np.abs(wrench[:, 0]).min() > 10.0


@pytest.mark.slow
def test_robot_drives_with_no_more_than_it_has():
    world, state = make_world(room(), noise=SILENT)
    command = pushing(np.array([3000.0, -4000.0, 1e4]))
    after, driven = drive(KEY, world, state, command)
    seconds = STEP * NUM_STEPS
    speed = np.array([0.6, -0.8]) * ROBOT.force / ROBOT.mass * seconds
    inertia = 0.5 * ROBOT.mass * ROBOT.radius**2
    wanted = np.append(speed, ROBOT.torque / inertia * seconds)
    np.testing.assert_allclose(after.physics.twist[1], wanted, rtol=1e-6)
    np.testing.assert_allclose(driven.effort, seconds)
    _, idle = drive(KEY, world, state, pushing(np.array([0.0, 100.0, 0.0])))
    np.testing.assert_allclose(idle.effort, 0.4 * seconds)


@pytest.mark.slow
def test_readings_have_the_noise_that_is_stated():
    world, state = holding(kind="fixed", floor=False)
    world = dataclasses.replace(world, noise=jnp.asarray(SENSORS))
    rest = pushing(np.zeros(3))
    readings = [drive(key, world, state, rest)[1].reading for key in keys(30)]
    told = jax.tree.map(lambda *parts: np.stack(parts), *readings)
    noise = [
        np.concatenate([(part - true).reshape(-1, 3) for part in parts])
        for parts, true in (
            ((told.before.pose, told.after.pose), np.asarray(state.physics.pose)),
            ((told.before.twist, told.after.twist), 0.0),
        )
    ]
    samples = [noise[0][:, :2], noise[0][:, 2], noise[1][:, :2], noise[1][:, 2]]
    samples.append(told.wrench)
    for sample, wanted in zip(samples, SENSORS, strict=True):
        # Of a normal sample's standard deviation and mean, one in 10^5 is further off.
        size = sample.size
        assert abs(np.std(sample) / wanted - 1.0) < 4.5 / np.sqrt(2.0 * size)
        assert abs(np.mean(sample)) < 4.5 * wanted / np.sqrt(size)
    # What is read at the end of a step and at the next one's start is read twice.
    both = (told.after.pose[:, :-1] - told.before.pose[:, 1:])[..., 0]
    spread = np.std(both) / SENSORS[0]
    assert abs(spread / np.sqrt(2.0) - 1.0) < 4.5 / np.sqrt(2.0 * both.size)


def keys(num):
    return jax.random.split(KEY, num)


@pytest.mark.slow
def test_a_planned_way_through_the_door_is_driven_to_its_end_without_touching():
    for place in ((1.0, 3.2), (2.55, 0.5)):
        one = room(start=place)
        space = FreeSpace(one)
        world, state = make_world(one, noise=SILENT)
        free = space.free(poses_of(one))
        ways = ways_from(space.grid, free, space.grid.cell(np.array(place)))
        way = ways.path_to(space.grid.cell(np.array(GOAL)))
        command = going(np.concatenate([way, [GOAL]]), ROBOT.speed)
        overlap = 0.0
        for _ in range(40):
            state, driven = drive(KEY, world, state, command)
            overlap = max(overlap, float(driven.overlap))
        assert overlap < 1e-3
        np.testing.assert_allclose(state.physics.pose[1, :2], GOAL, atol=0.02)
        assert arrived(world, state)
        # The thing is where it was.
        np.testing.assert_array_equal(state.physics.pose[0], poses_of(one)[0])


def test_a_robot_holds_only_things_within_its_reach():
    world, state = make_world(room())
    x, y, _ = thing().pose
    rim = x - 0.3 - ROBOT.radius
    near = placed(state, (rim - 0.9 * REACH, y))
    far = placed(state, (rim - 1.1 * REACH, y))
    assert hold(world, near, 0).held == 0
    assert hold(world, far, 0).held == NOBODY
    # The robot itself and walls are no things, near or not.
    at_wall = placed(state, (ROBOT.radius, 1.0))
    for body in (NOBODY, 1, 2):
        assert hold(world, at_wall, body).held == NOBODY
    # To take hold of nothing is to let go.
    assert hold(world, hold(world, near, 0), NOBODY).held == NOBODY
    # Nothing is moved by it.
    jax.tree.map(
        np.testing.assert_array_equal, hold(world, near, 0).physics, near.physics
    )


def test_arrived_is_a_robot_at_its_goal_that_overlaps_nothing():
    world, state = make_world(room())
    goal = np.array(GOAL)
    at_goal = placed(state, goal)
    assert not arrived(world, state)
    assert arrived(world, at_goal)
    assert arrived(world, placed(state, goal + 0.1))
    assert not arrived(world, placed(state, goal + 0.12))
    edge = goal[0] - ROBOT.radius - 0.3
    assert arrived(world, placed(at_goal, (edge, goal[1]), 0))
    assert arrived(world, placed(at_goal, (edge + 1e-3, goal[1]), 0))
    assert not arrived(world, placed(at_goal, (edge + 5e-3, goal[1]), 0))
    # Nor is it in a wall, or on top of a thing.
    assert not arrived(world, placed(at_goal, goal, 0))
    assert not arrived(world, placed(at_goal, (*goal, 0.0), 5))


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_readings_are_late_by_the_delay(delay):
    _, state = make_world(room())
    state = with_delay(state, delay)
    start = state.physics

    def at(step):
        """What is told of a moment; before the start all is as at the start."""
        return jax.tree.map(lambda leaf: leaf + max(step, 0), start)

    for step in range(6):
        reading = NamoReading(
            at(step), at(step + 1), jnp.full(3, float(step)), jnp.asarray(0)
        )
        state, told = _delayed(state, reading)
        wanted = NamoReading(
            at(step - delay), at(step + 1 - delay), reading.wrench, reading.held
        )
        jax.tree.map(np.testing.assert_array_equal, told, wanted)


def test_delays_and_ways_that_are_none_are_refused():
    _, state = make_world(room())
    with pytest.raises(ValueError, match="delay: expected at least 0 steps, got -1"):
        with_delay(state, -1)
    with pytest.raises(ValueError, match="way: expected one point at least, got none"):
        going(np.zeros((0, 2)), 1.0)


def test_a_way_is_filled_up_with_its_end():
    way = np.array([[0.0, 0.0], [1.0, 2.0]])
    command = going(way, 0.5)
    np.testing.assert_array_equal(command.way[:2], way)
    assert np.all(np.asarray(command.way)[2:] == [1.0, 2.0])
    assert not command.is_push
    # One program does for both.
    push = pushing(np.ones(3))
    assert jax.tree.map(jax.typeof, command) == jax.tree.map(jax.typeof, push)
