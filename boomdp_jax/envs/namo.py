r"""The world of a robot that moves furniture out of its way: one step of it.

The robot is a disc with a hand at its rim. It drives with a bounded wrench, pushes what
it touches (the engine's contacts), and may hold a thing: the grasp is a weld of the
engine between thing and robot, made where both are, so that it transmits force and
torque. What it transmits follows from the robot's momentum balance,

$$f = m_r \Delta v / \Delta t - f_{drive} - f_{contact},$$

and is what a sensor at the wrist reads. A step in which that force would exceed the
grip's limit is taken without the grasp, which is lost: it is never stronger than it is
said to be.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key, on_device
from boomdp_jax.envs.namo_room import NUM_SUBSTEPS, Room, room_params, room_scene
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import separation
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import step

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
    """Readings that are still under way, latest first; leading axis `delay`, of length
    zero where there is none."""


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
    """
    spec = room_scene(room)
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
    past = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (delay, *leaf.shape)), state.physics
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

    def take(carry):
        """A step; what slips in it is taken again without the grasp."""
        _, holds, _, _, _ = carry
        physics = _with_grasp(world.physics, state, robot, holds)
        after, info = step(world.scene, physics, bodies, wrench)
        contact: Any = info.contact_wrench
        given = _transmitted(world, bodies, after, drive, contact)
        slips = holds & (jnp.sum(given[:2] ** 2) > world.grip**2)
        given = jnp.where(holds & ~slips, given, 0.0)
        return slips, holds & ~slips, after, given, info.overlap

    zero = jnp.zeros((), bodies.pose.dtype)
    begun = jnp.ones((), bool), state.held >= 0, bodies, jnp.zeros(3, zero.dtype), zero
    # A loop, so that the engine's step is compiled once.
    taken = jax.lax.while_loop(lambda carry: carry[0], take, begun)
    _, stays, after, given, overlap = taken
    slips = (state.held >= 0) & ~stays
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
    happened = NamoInfo(
        has_slipped=slips,
        force=jnp.where(stays, size, 0.0),
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


def _with_grasp(
    physics: Params, state: NamoState, robot: IntScalar, holds: BoolScalar
) -> Params:
    """The weld ties the thing to the robot, if it is held."""
    weld = physics.weld
    assert weld is not None
    body = jnp.maximum(state.held, 0).astype(weld.body_a.dtype)
    grasp = {
        "active": holds,
        "body_a": body,
        "body_b": robot.astype(weld.body_b.dtype),
        "anchor_a": state.anchor,
        "anchor_b": jnp.zeros(2),
        "angle": state.angle,
    }
    changed = {
        key: getattr(weld, key).at[0].set(value.astype(getattr(weld, key).dtype))
        for key, value in grasp.items()
    }
    return dataclasses.replace(physics, weld=type(weld)(**changed))


def _transmitted(
    world: NamoWorld, before: State, after: State, drive: Array, contact: Array
) -> Float[Array, "3"]:
    """What the hand does to what it holds, by the robot's momentum balance."""
    robot, scene = world.robot, world.scene
    mass = world.physics.density[robot] * scene.area[robot]
    inertia = mass * scene.gyration[robot]
    change = (after.twist[robot] - before.twist[robot]) / scene.dt
    gained = change * jnp.stack([mass, mass, inertia])
    return drive + contact[robot] - gained


def _read(key: Key, state: State, noise: Float[Array, "5"]) -> State:
    pose_key, twist_key = jax.random.split(key)
    place, angle, velocity, spin, _ = noise
    pose_noise = jnp.stack([place, place, angle])
    twist_noise = jnp.stack([velocity, velocity, spin])
    shape, dtype = state.pose.shape, state.pose.dtype
    return State(
        state.pose + pose_noise * jax.random.normal(pose_key, shape, dtype),
        state.twist + twist_noise * jax.random.normal(twist_key, shape, dtype),
    )


def _delayed(state: NamoState, reading: NamoReading) -> tuple[NamoState, NamoReading]:
    """Poses and twists as they were some steps ago; the wrist's sensor is at once."""
    delay = state.past.pose.shape[0]
    if delay == 0:
        return state, reading
    line = jax.tree.map(
        lambda new, old: jnp.concatenate([new[None], old]), reading.after, state.past
    )
    late = dataclasses.replace(
        reading,
        before=jax.tree.map(lambda leaf: leaf[-1], state.past),
        after=jax.tree.map(lambda leaf: leaf[-2], line),
    )
    past = jax.tree.map(lambda leaf: leaf[:delay], line)
    return dataclasses.replace(state, past=past), late
