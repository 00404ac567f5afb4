"""Configurations in which the gripper is at an object, and faces its outline."""

import functools
import math

import jax
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.envs.arm_clearance import compose, in_blocks
from boomdp_jax.envs.mobile_arm import MobileArm
from boomdp_jax.physics.body_spec import BodySpec

GRIP_GAP = 0.012
"""Between an outline and the nearest corner of the gripper that is to hold it [m]."""

_MOST_TILT = 0.6
"""Of the gripper against the outline's normal [rad]."""


def grasp_candidates(
    seed: int,
    robot: MobileArm,
    body: BodySpec,
    pose: Float[np.ndarray, "3"],
    point: Float[np.ndarray, "2"],
    num: int,
) -> Float[np.ndarray, "grasp 5"]:
    """Draw configurations with the gripper at a point of an object's outline.

    The angles of the arm are uniform within their ranges and that of the gripper is
    within 0.6 rad of the outline's normal; whatever is in the way is ignored.

    Args:
        seed: of the draws.
        robot: measures.
        body: the object.
        pose: where it stands [m, m, rad].
        point: of it, in its frame; the nearest point of its outline is meant [m].
        num: how many to draw.

    Returns:
        The configurations, the gripper least tilted first.
    """
    rng = np.random.default_rng(seed)
    surface, normal = outline_point(body, point)
    tilt = rng.uniform(-_MOST_TILT, _MOST_TILT, num)
    tilt = tilt[np.argsort(np.abs(tilt))]
    angles = rng.uniform(-robot.joint_limit, robot.joint_limit, (num, 2))
    # So that the corner that is ahead keeps its distance.
    away = GRIP_GAP + robot.half_width * np.abs(np.sin(tilt))
    tip = surface[None] + away[:, None] * normal[None]
    inward = math.atan2(-normal[1], -normal[0])
    grippers = np.column_stack([tip, inward + tilt])
    return holding(robot, np.repeat(pose[None], num, axis=0), grippers, angles)


def holding(
    robot: MobileArm,
    objects: Float[np.ndarray, "point 3"],
    grippers: Float[np.ndarray, "point 3"],
    angles: Float[np.ndarray, "point 2"],
) -> Float[np.ndarray, "point 5"]:
    """Configurations with the gripper somewhere on an object (`around_gripper`).

    Args:
        robot: measures.
        objects: poses of the object [m, m, rad].
        grippers: of the gripper in the object's frame [m, m, rad].
        angles: of shoulder and elbow [rad].

    Returns:
        One configuration each, headings not wrapped.
    """
    return in_blocks(functools.partial(_holding, robot), objects, grippers, angles)


@functools.partial(jax.jit, static_argnums=0)
def _holding(
    robot: MobileArm,
    objects: Float[Array, "point 3"],
    grippers: Float[Array, "point 3"],
    angles: Float[Array, "point 2"],
) -> Float[Array, "point 5"]:
    return jax.vmap(robot.around_gripper)(jax.vmap(compose)(objects, grippers), angles)


def outline_point(
    body: BodySpec, point: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The point of an outline nearest to a point, and the outward normal there.

    Args:
        body: whose outline.
        point: in its frame [m].

    Returns:
        Point and unit normal, in its frame [m].
    """
    if body.kind == "circle":
        distance = float(np.hypot(*point))
        normal = point / distance if distance > 0.0 else np.array([1.0, 0.0])
        return body.radius * normal, normal
    corners = body.vertices
    edges = np.roll(corners, -1, axis=0) - corners
    square = np.sum(edges**2, axis=1)
    share = np.clip(np.sum((point[None] - corners) * edges, axis=1) / square, 0.0, 1.0)
    nearest = corners + share[:, None] * edges
    edge = int(np.argmin(np.sum((nearest - point[None]) ** 2, axis=1)))
    normal = np.array([edges[edge, 1], -edges[edge, 0]]) / math.sqrt(square[edge])
    return nearest[edge], normal
