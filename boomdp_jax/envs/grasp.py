r"""A grasp as data: a weld slot that closes, feels what it bears, and lets go.

The gripper holds a body as it finds it: closing it moves nothing. What it bears is told
by the momentum of the robot, on which nothing acts but what drives its base and the
reaction R at the gripper (motors and joints are within it):

$$\Delta P = h\,(F + R), \qquad
  \Delta L = h\,(x \times F + \tau + g \times R + \tau_R),$$

with positions at mid-step. A step that would make the gripper bear more than its
limits is not taken: the grasp opens as it begins, and the step is taken without it. So
no step's mean reaction ever exceeds the limits.

A robot that touches something else is pushed there as well, which the balance cannot
tell from the reaction; `GraspReport.is_exact` is then false, and the limits are applied
to the sum: a robot that bumps into a wall may drop what it holds, and one that braces
itself against a wall may pull harder than it feels.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar
from boomdp_jax.envs.mobile_arm import MobileArm
from boomdp_jax.physics.params import Params, Weld
from boomdp_jax.physics.quantities import mass_and_inertia
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import pair_separation
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import StepInfo, step

GRASP_REACH = 0.04
"""A body's outline no further than this from the gripper can be grasped [m]; fingers,
which would bridge it, are no bodies of their own."""

_TOUCHING = 1e-3
"""Bodies this near each other may push each other in a step [m]."""


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
    is_exact: BoolScalar
    """Whether the robot touched nothing but what it held, so that all of this is the
    grasp's."""


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
    weld = _weld(params)
    forearm = bodies[2]
    gripper = gripper_point(robot, state.pose[forearm])
    held = state.pose[body]
    cos, sin = jnp.cos(held[2]), jnp.sin(held[2])
    x, y = gripper[0] - held[0], gripper[1] - held[1]
    anchor = jnp.stack([cos * x + sin * y, cos * y - sin * x])
    can_hold = ~scene.is_static[body] & jnp.all(bodies != body)
    is_near = gripper_distance(robot, bodies, scene, state, body) <= GRASP_REACH
    ahead = jnp.array([0.5 * robot.forearm, 0.0], anchor.dtype)
    closed = Weld(
        active=weld.active.at[-1].set(can_hold & is_near),
        body_a=weld.body_a.at[-1].set(forearm.astype(weld.body_a.dtype)),
        body_b=weld.body_b.at[-1].set(body.astype(weld.body_b.dtype)),
        anchor_a=weld.anchor_a.at[-1].set(ahead),
        anchor_b=weld.anchor_b.at[-1].set(anchor),
        angle=weld.angle.at[-1].set(state.pose[forearm, 2] - held[2]),
    )
    return dataclasses.replace(params, weld=closed)


def open_grasp(params: Params) -> Params:
    """Let go of whatever the gripper holds.

    Args:
        params: one hypothesis, the last weld slot of which is the grasp.

    Returns:
        The same with the slot inactive.
    """
    return _with_active(params, jnp.zeros((), bool))


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
    was_held = _weld(params).active[-1]

    def attempt(params: Params) -> tuple:
        after, info = step(scene, params, state, wrench)
        return after, info, *_felt(robot, bodies, scene, params, (state, after), wrench)

    def goes_on(carry: tuple) -> BoolScalar:
        count, params, (_, _, force, torque) = carry
        bears = jnp.stack([jnp.hypot(force[0], force[1]), jnp.abs(torque)])
        is_too_much = _weld(params).active[-1] & jnp.any(bears > limit)
        return (count == 0) | is_too_much

    def again(carry: tuple) -> tuple:
        count, params, _ = carry
        params = _with_active(params, _weld(params).active[-1] & (count == 0))
        return count + 1, params, attempt(params)

    # A loop, so that the step is compiled once.
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(attempt, params)
    )
    _, params, (after, info, force, torque) = jax.lax.while_loop(
        goes_on, again, (0, params, blank)
    )
    is_held = _weld(params).active[-1]
    touches = [_touches(bodies, scene, params, at) for at in (state, after)]
    report = GraspReport(
        force=jnp.where(is_held, force, 0.0),
        torque=jnp.where(is_held, torque, 0.0),
        is_held=is_held,
        has_slipped=was_held & ~is_held,
        is_exact=~(touches[0] | touches[1]),
    )
    return params, after, info, report


def _felt(
    robot: MobileArm,
    bodies: Int[Array, "3"],
    scene: Scene,
    params: Params,
    states: tuple[State, State],
    wrench: Float[Array, "body 3"],
) -> tuple[Float[Array, "2"], FloatScalar]:
    """Force and torque at the gripper, of the robot's balance of momentum."""
    mass, inertia = (part[bodies] for part in mass_and_inertia(scene, params))
    before, after = states
    middle = 0.5 * (before.pose[bodies] + after.pose[bodies])
    change = after.twist[bodies] - before.twist[bodies]
    given = wrench[bodies]
    push = mass[:, None] * change[:, :2] / scene.dt - given[:, :2]
    push = push - mass[:, None] * scene.gravity[None]
    force = jnp.sum(push, axis=0)
    grips = [gripper_point(robot, state.pose[bodies[2]]) for state in states]
    grip = 0.5 * (grips[0] + grips[1])
    arm = middle[:, :2] - grip[None]
    turn = inertia * change[:, 2] / scene.dt - given[:, 2]
    return force, jnp.sum(turn + arm[:, 0] * push[:, 1] - arm[:, 1] * push[:, 0])


def _touches(
    bodies: Int[Array, "3"], scene: Scene, params: Params, state: State
) -> BoolScalar:
    """Whether a body of the robot is at one that it does not hold."""
    weld = _weld(params)
    others = jnp.arange(scene.num_bodies)
    is_own = jnp.any(others[:, None] == bodies[None], axis=1)
    is_held = weld.active[-1] & (others == weld.body_b[-1])

    def gaps(body):
        return jax.vmap(lambda other: pair_separation(scene, state, body, other))(
            others
        )

    near = jax.vmap(gaps)(bodies) <= _TOUCHING
    is_forearm = bodies == bodies[2]
    counts = ~is_own[None] & ~(is_held[None] & is_forearm[:, None])
    return jnp.any(near & counts)


def _with_active(params: Params, is_active: BoolScalar) -> Params:
    weld = _weld(params)
    active = weld.active.at[-1].set(is_active)
    return dataclasses.replace(params, weld=dataclasses.replace(weld, active=active))


def _weld(params: Params) -> Weld:
    if params.weld is None:
        raise ValueError(
            "params: weld: expected a slot for the grasp (ArmScene.params), got None"
        )
    return params.weld
