r"""Boxes that stop a box: what a planner thinks of furniture in the way.

A step of a lone box is followed along the straight way from its pose to the next one,
at some points in between; it stops, at rest, at the last of them up to which it came no
nearer to another box than it was, once they touch. Two boxes are apart exactly where
one of their four face normals separates them: for a normal n, the vector d between the
centres and half extents a and b along the axes u of each,

$$|n \cdot d| - \sum_k a_k |n \cdot u_k| - \sum_k b_k |n \cdot u'_k| > 0.$$

A world with contact lets a box shove another one out of the way; this rule does not,
and is some hundred times faster.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.state import State

_NUM_CHECKS = 4
_SLACK = 1e-3
"""Boxes that touch may slide past each other by this much of overlap more [m]."""


class Boxes(eqx.Module):
    """Boxes in the plane."""

    pose: Float[Array, "box 3"]
    """Centre and angle [m, m, rad]."""
    half_extents: Float[Array, "box 2"]
    """Along their own axes [m]; a box without size at infinity is none."""

    @property
    def num_boxes(self) -> int:
        """How many there are."""
        return self.half_extents.shape[0]


def box_separation(
    boxes: Boxes, half_extents: Float[Array, "2"], pose: Float[Array, "3"]
) -> FloatScalar:
    """Largest gap along any separating axis to the nearest box; negative: overlap [m].

    No more than the distance where boxes are apart, and their depth where they overlap.

    Args:
        boxes: all that may be in the way.
        half_extents: of the box that moves [m].
        pose: of it [m, m, rad].

    Returns:
        The least over boxes.
    """
    wide, high = half_extents[0], half_extents[1]
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    gaps = []
    # Scalars, written out: in a batch they are one loop over its members.
    for index in range(boxes.num_boxes):
        other, half = boxes.pose[index], boxes.half_extents[index]
        other_cos, other_sin = jnp.cos(other[2]), jnp.sin(other[2])
        x, y = other[0] - pose[0], other[1] - pose[1]
        along = jnp.abs(cos * other_cos + sin * other_sin)
        across = jnp.abs(sin * other_cos - cos * other_sin)
        own = (
            jnp.abs(cos * x + sin * y) - wide - half[0] * along - half[1] * across,
            jnp.abs(cos * y - sin * x) - high - half[0] * across - half[1] * along,
        )
        others = (
            jnp.abs(other_cos * x + other_sin * y)
            - half[0]
            - wide * along
            - high * across,
            jnp.abs(other_cos * y - other_sin * x)
            - half[1]
            - wide * across
            - high * along,
        )
        gaps.append(functools.reduce(jnp.maximum, own + others))
    return functools.reduce(jnp.minimum, gaps)


def stopped_by_boxes(
    boxes: Boxes, half_extents: Float[Array, "2"], state: State, next_state: State
) -> State:
    """Where a lone box's step ends, if it stops at the first box in its way.

    Args:
        boxes: all that may be in the way; at least one.
        half_extents: of the box that moves [m].
        state: before; it may touch or overlap others, and then get away from them.
        next_state: after, as if there were none.

    Returns:
        The next state, at rest where it was stopped.
    """
    before, after = state.pose[0], next_state.pose[0]
    least = jnp.minimum(box_separation(boxes, half_extents, before), 0.0) - _SLACK
    parts = jnp.arange(1, _NUM_CHECKS + 1, dtype=before.dtype) / _NUM_CHECKS

    def check(carry, part):
        is_clear, reached = carry
        pose = before + part * (after - before)
        is_clear = is_clear & (box_separation(boxes, half_extents, pose) > least)
        return (is_clear, jnp.where(is_clear, part, reached)), None

    begun = jnp.ones((), bool), jnp.zeros((), before.dtype)
    (is_clear, reached), _ = jax.lax.scan(check, begun, parts)
    pose = jnp.where(is_clear, after, before + reached * (after - before))
    twist = jnp.where(is_clear, next_state.twist, 0.0)
    return State(pose[None], twist)
