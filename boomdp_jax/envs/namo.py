r"""The world of a robot that moves furniture out of its way: one step of it.

The robot is a disc with a hand at its rim. It drives with a bounded wrench, pushes what
it touches (the engine's contacts), and may hold a thing: the grasp is a weld of the
engine between thing and robot, made where both are, so that it transmits force and
torque. What it transmits, by the robot's momentum (`weld_grasp`), is what a sensor at
the wrist reads, and is never more than the grip's limit: a grasp that would have to
bear more is lost.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key, on_device
from boomdp_jax.envs.checked_room import check_room
from boomdp_jax.envs.namo_room import (
    NUM_SUBSTEPS,
    Room,
    room_params,
    room_scene,
)
from boomdp_jax.envs.weld_grasp import Holder, with_grasp, yielding_step
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import separation
from boomdp_jax.physics.state import State

NOBODY = -1
"""Held by the robot."""
REACH = 0.08
"""Most between the robot's rim and a thing that it takes hold of [m]."""
GOAL_RADIUS = 0.15
"""How near its goal the robot has to come [m]."""
SENSORS = (1e-3, 1e-3, 4e-3, 4e-3, 1.0)
"""Standard deviations of readings: position [m], angle [rad], velocity [m/s], spin
[rad/s], force at the wrist [N] (and torque [N m])."""


class NamoWorld(eqx.Module):
    """All that is true of one room; data, so that rooms of one size are one program."""

    scene: Scene
    physics: Params
    goal: Float[Array, "2"]
    robot: IntScalar
    """Index of its body."""
    grip: FloatScalar
    """[N]"""
    most: Float[Array, "2"]
    """Largest drive: force [N], torque [N m]."""
    noise: Float[Array, "5"]
    """See `SENSORS`."""


class NamoState(eqx.Module):
    """Where everything is, and what the robot holds."""

    physics: State
    held: IntScalar
    """Index of the thing; `NOBODY`."""
    anchor: Float[Array, "2"]
    """Of the robot's middle in the frame of the thing that is held [m]."""
    angle: FloatScalar
    """Of the thing against the robot [rad]."""
    past: State
    """Readings that are still under way, latest first; leading axis one more than the
    delay, or of length zero where there is none."""


class NamoReading(eqx.Module):
    """What the robot is told at the end of a step."""

    before: State
    """Poses and twists at its start, and at its end; with noise, and some steps old if
    there is a delay."""
    after: State
    wrench: Float[Array, "3"]
    """Mean over the step of what the hand did to the thing that it held, about that
    thing's middle [N, N, N m]; zero if it held none."""
    held: IntScalar
    """The thing held throughout the step; `NOBODY`."""


class NamoInfo(eqx.Module):
    """What happened, as nobody in the room knows it."""

    has_slipped: BoolScalar
    """Whether the grasp was lost."""
    force: FloatScalar
    """Transmitted by the grasp [N]."""
    overlap: FloatScalar
    """Deepest of any two outlines [m]."""


def make_world(
    room: Room, *, noise: Float[Array, "5"] | None = None
) -> tuple[NamoWorld, NamoState]:
    """A room as the engine sees it, and the state in which it starts.

    Args:
        room: things, walls, start and goal.
        noise: of the sensors; default: `SENSORS`.

    Returns:
        World and first state, without a delay (see `with_delay`).

    Raises:
        ValueError: what is no room (`check_room`).
    """
    spec = room_scene(check_room(room))
    robot = room.robot
    state = spec.initial_state()
    zero = on_device(0.0)
    world = NamoWorld(
        scene=dataclasses.replace(spec.scene, num_substeps=NUM_SUBSTEPS),
        physics=room_params(room, spec),
        goal=on_device(room.goal),
        robot=on_device(room.num_things, jnp.int32),
        grip=on_device(robot.grip),
        most=on_device([robot.force, robot.torque]),
        noise=on_device(SENSORS if noise is None else noise),
    )
    nothing = NamoState(
        physics=state,
        held=on_device(NOBODY, jnp.int32),
        anchor=on_device([0.0, 0.0]),
        angle=zero,
        past=jax.tree.map(lambda leaf: jnp.zeros((0, *leaf.shape)), state),
    )
    return world, nothing


def with_delay(state: NamoState, delay: int) -> NamoState:
    """The same, with readings that come some steps late.

    Args:
        state: at the start.
        delay: in steps; 0 is none.

    Raises:
        ValueError: a negative delay.
    """
    if delay < 0:
        raise ValueError(f"delay: expected at least 0 steps, got {delay}")
    num = delay + 1 if delay > 0 else 0
    past = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), state.physics
    )
    return dataclasses.replace(state, past=past)


def grasped(world: NamoWorld, state: NamoState, thing: IntScalar) -> NamoState:
    """Take hold of a thing that the hand reaches; else hold nothing.

    Args:
        world: the room.
        state: now; whatever is held is let go.
        thing: index of a thing, or `NOBODY`.

    Returns:
        The state, with the grasp as the bodies are now.
    """
    robot, bodies = world.robot, state.physics
    body = jnp.maximum(thing, 0)
    gap = separation(world.scene, bodies)[body, robot]
    reaches = (thing >= 0) & (thing < robot) & (gap <= REACH)
    pose, own = bodies.pose[body], bodies.pose[robot]
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = own[0] - pose[0], own[1] - pose[1]
    return dataclasses.replace(
        state,
        held=jnp.where(reaches, thing, NOBODY).astype(state.held.dtype),
        anchor=jnp.stack([cos * x + sin * y, cos * y - sin * x]),
        angle=pose[2] - own[2],
    )


def namo_step(
    key: Key, world: NamoWorld, state: NamoState, drive: Float[Array, "3"]
) -> tuple[NamoState, NamoReading, NamoInfo]:
    """Drive for one step.

    Args:
        key: of the sensors' noise.
        world: the room.
        state: now.
        drive: wrench on the robot, world frame [N, N, N m]; more than it has is scaled
            back to that, along its own direction.

    Returns:
        The next state, what the robot reads, what happened.
    """
    robot, bodies = world.robot, state.physics
    size = jnp.sqrt(jnp.sum(drive[:2] ** 2) + 1e-12)
    force = drive[:2] * jnp.minimum(1.0, world.most[0] / size)
    torque = jnp.clip(drive[2], -world.most[1], world.most[1])
    drive = jnp.concatenate([force, torque[None]])
    wrench = jnp.zeros_like(bodies.pose).at[robot].set(drive)

    hand = Holder(robot[None], lambda poses: poses[0, :2])
    limit = jnp.stack([world.grip, jnp.full_like(world.grip, jnp.inf)])
    held = _with_grasp(world.physics, state, robot)
    taken = yielding_step(hand, world.scene, held, bodies, wrench, limit)
    after, given = taken.after, -taken.reaction
    stays = (state.held >= 0) & ~taken.has_slipped
    size = jnp.sqrt(jnp.sum(given[:2] ** 2))
    body = jnp.maximum(state.held, 0)
    # About the middle of the thing, as it was half-way.
    arm = bodies.pose[robot, :2] - bodies.pose[body, :2]
    arm = 0.5 * (arm + after.pose[robot, :2] - after.pose[body, :2])
    moment = given[2] + arm[0] * given[1] - arm[1] * given[0]
    on_thing = jnp.stack([given[0], given[1], moment])
    before_key, after_key, force_key = jax.random.split(key, 3)
    told_before, told_after = (
        _read(one, each, world.noise)
        for one, each in ((before_key, bodies), (after_key, after))
    )
    noisy = on_thing + world.noise[4] * jax.random.normal(force_key, (3,))
    reading = NamoReading(
        before=told_before,
        after=told_after,
        wrench=jnp.where(stays, noisy, 0.0),
        held=jnp.where(stays, state.held, NOBODY),
    )
    following = dataclasses.replace(
        state, physics=after, held=jnp.where(stays, state.held, NOBODY)
    )
    overlap = taken.info.overlap
    assert overlap is not None
    happened = NamoInfo(
        has_slipped=taken.has_slipped,
        force=size,
        overlap=overlap,
    )
    return *_delayed(following, reading), happened


def is_at_goal(world: NamoWorld, state: NamoState) -> BoolScalar:
    """Whether the robot is at its goal and its body overlaps nothing.

    Args:
        world: the room.
        state: now.

    Returns:
        True if its middle is within `GOAL_RADIUS`, and no outline reaches deeper into
        its own than contacts leave (2 mm).
    """
    pose = state.physics.pose[world.robot]
    away = jnp.sqrt(jnp.sum((pose[:2] - world.goal) ** 2))
    gap = jnp.min(separation(world.scene, state.physics)[world.robot])
    return (away < GOAL_RADIUS) & (gap > -2e-3)


def _with_grasp(physics: Params, state: NamoState, robot: IntScalar) -> Params:
    """The weld ties the robot to the thing, if one is held."""
    return with_grasp(
        physics,
        state.held >= 0,
        hand=robot,
        held=jnp.maximum(state.held, 0),
        on_hand=jnp.zeros_like(state.anchor),
        on_held=state.anchor,
        angle=-state.angle,
    )


def _read(key: Key, state: State, noise: Float[Array, "5"]) -> State:
    pose_key, twist_key = jax.random.split(key)
    place, angle, velocity, spin, _ = noise
    pose_noise = jnp.stack([place, place, angle])
    twist_noise = jnp.stack([velocity, velocity, spin])
    shape, dtype = state.pose.shape, state.pose.dtype
    return State(
        state.pose + pose_noise[None] * jax.random.normal(pose_key, shape, dtype),
        state.twist + twist_noise[None] * jax.random.normal(twist_key, shape, dtype),
    )


def _delayed(state: NamoState, reading: NamoReading) -> tuple[NamoState, NamoReading]:
    """Poses and twists as they were some steps ago; the wrist's sensor is at once."""
    num = state.past.pose.shape[0]
    if num == 0:
        return state, reading
    line = jax.tree.map(
        lambda new, old: jnp.concatenate([new[None], old]), reading.after, state.past
    )
    late = dataclasses.replace(
        reading,
        before=jax.tree.map(lambda leaf: leaf[-1], state.past),
        after=jax.tree.map(lambda leaf: leaf[-2], line),
    )
    past = jax.tree.map(lambda leaf: leaf[:num], line)
    return dataclasses.replace(state, past=past), late
