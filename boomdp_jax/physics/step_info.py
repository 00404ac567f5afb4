"""What a step reports: whether joints hold, outlines overlap, numbers are finite."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.joints import Frames, Slot, joint_rows
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


def report(prepared: Prepared, motion: Motion) -> StepInfo:
    """Joint drift and finiteness of a motion.

    Args:
        prepared: what does not depend on the state.
        motion: after a step.

    Returns:
        The report of a world without contact.
    """
    total = jnp.sum(sum(motion))
    return StepInfo(
        constraint_error=joint_drift(prepared.slots, motion),
        is_finite=jnp.isfinite(total),
    )


def joint_drift(slots: list[Slot], motion: Motion) -> FloatScalar:
    """Largest distance by which an active joint fails to hold [m].

    Args:
        slots: pins and rods.
        motion: where the bodies are.

    Returns:
        The distance; where it is exactly zero its derivative is taken to be zero.
    """
    square = jnp.zeros((), motion.x.dtype)
    if slots:
        sin, cos = sincos(motion.theta)
        frames = Frames(motion.x, motion.y, cos, sin)
        for slot in slots:
            drift = sum(row.error**2 for row in joint_rows([slot], frames))
            square = jnp.maximum(square, drift)
    has_error = square > 0
    return jnp.where(has_error, jnp.sqrt(jnp.where(has_error, square, 1.0)), 0.0)
