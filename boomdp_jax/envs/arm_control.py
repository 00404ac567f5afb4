r"""Following a planned motion in the engine, with bounded force, torque and motors.

The base is driven by $F = m (\ddot q_r + 2 \omega \dot e + \omega^2 e) - \bar R$, e the
error of its pose, m mass and inertia of the whole robot as it stands, and $\bar R$ what
the gripper felt of late (`grasp`), which takes the place of an integral: an object that
is dragged along does not leave the base behind. Motors are driven at the reference's
rate and what makes up an error of their angle in a tenth of a second. Force, torque and
motor torques are bounded by the robot's.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.envs.arm_scene import ArmScene
from boomdp_jax.envs.grasp import (
    GraspReport,
    Grip,
    close_grasp,
    grasping_step,
    gripper_point,
)
from boomdp_jax.envs.mobile_arm import MobileArm
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.quantities import mass_and_inertia
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.planning.motion import TimedMotion

_STIFFNESS = 8.0
"""Rate at which errors of the base fade [1/s]; steps of 20 ms stand up to thrice it."""
_MOTOR_RATE = 10.0
"""Rate at which errors of the arm fade [1/s]."""
_FRESHNESS = 0.3
"""Share of the newest reaction in what was felt of late."""
_GRIP = Grip()
_CHUNK = 64
"""Steps of one compiled loop."""


class Followed(NamedTuple):
    """How a motion was followed; leading axis `time`, after each step."""

    params: Params
    """As they are at the end: the grasp may have slipped."""
    state: State
    """At the end."""
    states: State
    error: Float[np.ndarray, "time 5"]
    """Configuration minus reference [m, m, rad, rad, rad]."""
    overlap: Float[np.ndarray, " time"]
    """Deepest overlap of two outlines that may touch [m]."""
    grasp: GraspReport


def follow_motion(
    world: ArmScene,
    params: Params,
    state: State,
    motion: TimedMotion,
    *,
    settle: float = 1.0,
    grip: Grip = _GRIP,
) -> Followed:
    """Let the robot follow a motion, and stand still at its end.

    Compiled once for each scene, whatever the motion and whoever is held.

    Args:
        world: the robot's scene.
        params: what is true of it; the last weld slot is the grasp.
        state: where all is.
        motion: reference, one row for each step of the scene's length.
        settle: how long to stand still [s].
        grip: how strong the gripper is.

    Returns:
        What happened.
    """
    num_still = round(settle / world.spec.dt)
    last = motion.configuration[-1:] if len(motion.configuration) else None
    start = np.asarray(world.configuration(state))
    if last is None:
        last = start[None]
    reference = np.concatenate([motion.configuration, np.repeat(last, num_still, 0)])
    # Headings count from where the robot is, whole turns from where it was planned.
    turns = np.round((start[2] - reference[0, 2]) / (2.0 * np.pi))
    reference[:, 2] += 2.0 * np.pi * turns
    rates = np.pad(np.stack(motion[1:], axis=1), ((0, num_still), (0, 0), (0, 0)))
    rows = np.concatenate([reference[:, None], rates], axis=1)
    num = len(rows)
    padded = np.pad(rows, ((0, -num % _CHUNK), (0, 0), (0, 0)))
    is_on = np.arange(len(padded)) < num
    carry = (params, state, jnp.zeros(3, state.pose.dtype))
    index = on_device(world.bodies, np.dtype(np.int32))
    limit, found = on_device(grip), []
    for first in range(0, len(padded), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        carry, out = _follow(
            world.robot,
            world.motors,
            index,
            world.scene,
            limit,
            carry,
            (on_device(padded[chunk]), on_device(is_on[chunk], bool)),
        )
        found.append(jax.tree.map(np.asarray, out))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts)[:num], *found)
    states, error, overlap, report = joined
    return Followed(carry[0], carry[1], states, error, overlap, report)


def take_hold(world: ArmScene, params: Params, state: State, body: int) -> Params:
    """Close the gripper on a body (`grasp.close_grasp`).

    Args:
        world: the robot's scene.
        params: what is true of it.
        state: where all is.
        body: index of what to hold.

    Returns:
        The params with the grasp closed.

    Raises:
        ValueError: the body is out of the gripper's reach, static, or the robot's own.
    """
    index = on_device(world.bodies, np.dtype(np.int32))
    number = on_device(body, np.dtype(np.int32))
    closed = _close(world.robot, index, world.scene, params, state, number)
    if closed.weld is None or not closed.weld.active[-1]:
        raise ValueError(
            "body: expected one that can move, within reach of the gripper, got "
            f"{world.spec.names[body]!r}"
        )
    return closed


def _follow_chunk(
    robot: MobileArm,
    motors: tuple[int, ...],
    bodies: Array,
    scene: Scene,
    limit: Float[Array, "2"],
    carry: tuple[Params, State, Array],
    inputs: tuple[Float[Array, "time 3 5"], Bool[Array, " time"]],
) -> tuple:
    def advance(carry, inputs):
        params, state, felt = carry
        reference, is_on = inputs
        commanded, wrench = _command(
            robot, motors, bodies, scene, params, state, reference, felt
        )
        params, after, info, report = grasping_step(
            robot, bodies, scene, commanded, state, wrench, limit
        )
        new = jnp.append(report.force, report.torque)
        felt = jnp.where(
            report.is_held, felt + _FRESHNESS * (new - felt), jnp.zeros_like(felt)
        )
        rows = after.pose[bodies]
        angles = rows[:, 2]
        now = jnp.concatenate([rows[0], angles[1:] - angles[:-1]])
        new_carry = jax.tree.map(
            lambda old, new: jnp.where(is_on, new, old), carry, (params, after, felt)
        )
        return new_carry, (after, now - reference[0], info.overlap, report)

    return jax.lax.scan(advance, carry, inputs)


_close = QuickCompile(close_grasp, static=("robot",))
_follow = QuickCompile(_follow_chunk, static=("robot", "motors"))


def _command(
    robot: MobileArm,
    motors: tuple[int, ...],
    bodies: Array,
    scene: Scene,
    params: Params,
    state: State,
    reference: Float[Array, "3 5"],
    felt: Float[Array, "3"],
) -> tuple[Params, Float[Array, "body 3"]]:
    """Speeds of the motors, as params, and the wrench on the base."""
    pose, twist = state.pose[bodies], state.twist[bodies]
    target, rate, acceleration = reference
    mass, inertia = (part[bodies] for part in mass_and_inertia(scene, params))
    arm = pose[:, :2] - pose[:1, :2]
    total = jnp.sum(mass)
    turning = jnp.sum(inertia + mass * jnp.sum(arm**2, axis=1))
    drive = acceleration[:3] + 2.0 * _STIFFNESS * (rate[:3] - twist[0])
    drive = drive + _STIFFNESS**2 * (target[:3] - pose[0])
    hand = gripper_point(robot, pose[2]) - pose[0, :2]
    borne = jnp.append(felt[:2], felt[2] + hand[0] * felt[1] - hand[1] * felt[0])
    push = jnp.stack([total, total, turning]) * drive - borne
    size = jnp.hypot(push[0], push[1])
    share = jnp.where(size > robot.base_force, robot.base_force, size)
    share = share / jnp.where(size > 0.0, size, 1.0)
    torque = jnp.clip(push[2], -robot.base_torque, robot.base_torque)
    wrench = jnp.zeros_like(state.twist)
    wrench = wrench.at[bodies[0]].set(jnp.append(share * push[:2], torque))
    angles = pose[1:, 2] - pose[:-1, 2]
    speed = rate[3:] + _MOTOR_RATE * (target[3:] - angles)
    pins = params.revolute
    assert pins.motor is not None
    motor = pins.motor.at[jnp.array(motors), 0].set(speed)
    pins = dataclasses.replace(pins, motor=motor)
    return dataclasses.replace(params, revolute=pins), wrench
