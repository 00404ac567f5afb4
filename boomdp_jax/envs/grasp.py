"""The gripper of the mobile arm: it closes on what is near, feels it, and lets go.

It holds a body as it finds it: closing it moves nothing. What it bears is exact while
the robot touches walls or furniture, as the engine reports what contacts do to it
(`weld_grasp`); beyond its limits it lets go.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar
from boomdp_jax.envs.mobile_arm import MobileArm
from boomdp_jax.envs.weld_grasp import (
    Holder,
    grasp_slot,
    with_active,
    with_grasp,
    yielding_step,
)
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import pair_separation
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import StepInfo

GRASP_REACH = 0.04
"""A body's outline no further than this from the gripper can be grasped [m]; fingers,
which would bridge it, are no bodies of their own."""


class Grip(NamedTuple):
    """How strong a gripper is; data, so that a weaker one is not compiled anew."""

    force: float = 150.0
    """Beyond which it lets go [N]."""
    torque: float = 60.0
    """Likewise [N m]."""


class GraspReport(eqx.Module):
    """What a gripper felt in a step."""

    force: Float[Array, "*batch 2"]
    """On the robot, world frame, mean over the step [N]."""
    torque: Float[Array, "*batch"]
    """On the robot about the gripper [N m]."""
    is_held: BoolScalar
    """Whether it held something throughout the step."""
    has_slipped: BoolScalar
    """Whether it let go as the step began, as it would have had to bear too much."""


def close_grasp(
    robot: MobileArm,
    bodies: Int[Array, "3"],
    scene: Scene,
    params: Params,
    state: State,
    body: Int[Array, ""],
) -> Params:
    """Close the gripper on a body, if there is one within `GRASP_REACH`.

    Args:
        robot: measures.
        bodies: indices of the robot's.
        scene: outlines.
        params: one hypothesis, the last weld slot of which is the grasp.
        state: where all is.
        body: index of what to hold; neither static nor one of the robot's.

    Returns:
        The params with the slot active; unchanged but for the slot's numbers, and the
        slot inactive, where the body is out of reach or cannot be held.
    """
    forearm = bodies[2]
    gripper = gripper_point(robot, state.pose[forearm])
    held = state.pose[body]
    cos, sin = jnp.cos(held[2]), jnp.sin(held[2])
    x, y = gripper[0] - held[0], gripper[1] - held[1]
    anchor = jnp.stack([cos * x + sin * y, cos * y - sin * x])
    can_hold = ~scene.is_static[body] & jnp.all(bodies != body)
    is_near = gripper_distance(robot, bodies, scene, state, body) <= GRASP_REACH
    ahead = jnp.array([0.5 * robot.forearm, 0.0], anchor.dtype)
    return with_grasp(
        params,
        can_hold & is_near,
        hand=forearm,
        held=body,
        on_hand=ahead,
        on_held=anchor,
        angle=state.pose[forearm, 2] - held[2],
    )


def open_grasp(params: Params) -> Params:
    """Let go of whatever the gripper holds.

    Args:
        params: one hypothesis, the last weld slot of which is the grasp.

    Returns:
        The same with the slot inactive.
    """
    return with_active(params, jnp.zeros((), bool))


def gripper_point(robot: MobileArm, forearm: Float[Array, "3"]) -> Float[Array, "2"]:
    """The gripper's position, given the pose of the forearm [m]."""
    half = 0.5 * robot.forearm
    return forearm[:2] + half * jnp.stack([jnp.cos(forearm[2]), jnp.sin(forearm[2])])


def gripper_distance(
    robot: MobileArm,
    bodies: Int[Array, "3"],
    scene: Scene,
    state: State,
    body: Int[Array, ""],
) -> FloatScalar:
    """Distance of the gripper from a body's outline, negative inside it [m]."""
    forearm = bodies[2]
    point = gripper_point(robot, state.pose[forearm])
    scene = dataclasses.replace(
        scene,
        vertices=scene.vertices.at[forearm].set(0.0),
        radius=scene.radius.at[forearm].set(0.0),
    )
    pose = state.pose.at[forearm, :2].set(point)
    return pair_separation(scene, State(pose, state.twist), forearm, body)


def grasping_step(
    robot: MobileArm,
    bodies: Int[Array, "3"],
    scene: Scene,
    params: Params,
    state: State,
    wrench: Float[Array, "body 3"],
    limit: Float[Array, "2"],
) -> tuple[Params, State, StepInfo, GraspReport]:
    """One step of the world in which the gripper lets go rather than bear too much.

    Costs two steps where it slips. There is no derivative in reverse mode.

    Args:
        robot: measures.
        bodies: indices of the robot's.
        scene: outlines.
        params: one hypothesis, the last weld slot of which is the grasp; what is
            commanded acts (no `actuator`).
        state: where all is.
        wrench: on all bodies, world frame [N, N, N m].
        limit: largest force and torque of the grasp [N, N m].

    Returns:
        The params, the slot inactive if the grasp slipped; the next state; reports of
        the engine and of the gripper.
    """
    arm = Holder(bodies, lambda poses: gripper_point(robot, poses[2]))
    taken = yielding_step(arm, scene, params, state, wrench, limit)
    report = GraspReport(
        force=taken.reaction[:2],
        torque=taken.reaction[2],
        is_held=grasp_slot(taken.params).active[-1],
        has_slipped=taken.has_slipped,
    )
    return taken.params, taken.after, taken.info, report
