"""What a step reports: whether joints hold, outlines overlap, numbers are finite."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.physics.joints import Ends, Frames, Joints, bilateral_rows, of_body
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.trigonometry import sincos


class StepInfo(eqx.Module):
    """What a step reports and nobody needs to carry."""

    constraint_error: Float[Array, "*batch"]
    """Largest distance by which an active joint fails to hold after the step [m]."""
    is_finite: Bool[Array, "*batch"]
    overlap: Float[Array, "*batch"] | None = None
    """Deepest overlap of two outlines that may touch, when the last substep began [m];
    None in a scene without contact, like what follows."""
    overflow: Bool[Array, "*batch"] | None = None
    """Whether more pairs came near each other than there is room for, so that some
    contacts were left out."""
    cache: Any = None
    """Impulses of all contacts, which make the next step's start better if they are
    passed to it; `rollout` passes them on itself and does not return them."""
    contact_wrench: Float[Array, "*batch body 3"] | None = None
    """Mean over the step of what contacts did to each body, world frame, about its
    centre of mass [N, N, N m]: what a body's skin feels; zero for static bodies."""


def report(prepared: Prepared, motion: Motion) -> tuple[Array, Array]:
    """Joint drift and finiteness of motions, in lanes.

    Args:
        prepared: what does not depend on the state.
        motion: after a step.

    Returns:
        `StepInfo.constraint_error` and `StepInfo.is_finite`.
    """
    gyration = prepared.inertia / prepared.mass
    drift = joint_drift(prepared.joints, motion, gyration)
    return drift, jnp.isfinite(jnp.sum(sum(motion), axis=0))


def joint_drift(
    joints: Joints, motion: Motion, gyration: Float[Array, "body lane"]
) -> Float[Array, " lane"]:
    """Largest distance by which an active joint fails to hold [m], in lanes.

    Args:
        joints: all slots.
        motion: where the bodies are.
        gyration: squared radii of gyration, at which an angle is a distance [m²].

    Returns:
        The distance; where it is exactly zero its derivative is taken to be zero.
    """
    sin, cos = sincos(motion.theta)
    rows = bilateral_rows(joints, Frames(*motion[:3], cos, sin))
    square = jnp.zeros_like(motion.x[0])
    if rows is None:
        return square
    squares, first = rows.error**2, 0

    def take(ends: Ends | None) -> Array | None:
        nonlocal first
        if ends is None:
            return None
        first += ends.on.shape[0]
        return squares[first - ends.on.shape[0] : first]

    along, across = take(joints.points), take(joints.points)
    groups = [None if along is None or across is None else along + across]
    groups.append(take(joints.rods))
    angles = take(joints.angles)
    if joints.angles is not None and angles is not None:
        groups.append(angles * of_body(joints.angles.a, gyration))
    groups.append(take(joints.guides))
    for group in groups:
        if group is not None:
            square = jnp.maximum(square, jnp.max(group, axis=0))
    has_error = square > 0
    return jnp.where(has_error, jnp.sqrt(jnp.where(has_error, square, 1.0)), 0.0)
