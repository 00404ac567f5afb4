r"""Walls that stop what runs into them: a cheap, exact test, for planners and worlds.

A step is followed along the straight way from its pose to the next one, at some points
in between; the body stops, at rest, at the last of them up to which its outline was
clear of all walls. An outline is convex and a wall a box along the axes, so that they
are apart exactly where the axes or one of the outline's edge normals separates them:
for a normal n in the world frame, with the outline's offset $d = \max_v n \cdot v$ from
its origin x, and a wall of centre c and half extents h,

$$n \cdot (c - x) - |n_x| h_x - |n_y| h_y > d.$$

This is a law of these tasks and not of the engine's (which has contact, with friction
and rebound): some hundred times faster than contacts with a whole room, which matters
where ten thousand steps are tried a decision.
"""

import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar
from boomdp_jax.physics.state import State

_NUM_CHECKS = 4


class Walls(eqx.Module):
    """Boxes along the axes of the world that nothing can enter."""

    middle: Float[Array, "wall 2"]
    half_extents: Float[Array, "wall 2"]


class Outline(eqx.Module):
    """A convex polygon in the frame of its body, as its edges' lines."""

    vertices: Float[Array, "vertex 2"]
    normals: Float[Array, "vertex 2"]
    """Outward, of length one."""
    offsets: Float[Array, " vertex"]
    """Distance of each edge's line from the body's origin [m]."""


def walls_between(corners: Float[np.ndarray, "wall 4"]) -> Walls:
    """Walls from their least x and y and greatest x and y [m].

    Raises:
        ValueError: a wall without inside.
    """
    low, high = np.asarray(corners, float)[:, :2], np.asarray(corners, float)[:, 2:]
    if not np.all(high > low):
        bad = int(np.argmin(np.min(high - low, axis=1)))
        raise ValueError(
            f"walls[{bad}]: expected greatest x and y above the least, got "
            f"{corners[bad]}"
        )
    return Walls(jnp.asarray((low + high) / 2), jnp.asarray((high - low) / 2))


def outline_of(vertices: Float[np.ndarray, "vertex 2"]) -> Outline:
    """A convex polygon, counter-clockwise, about its body's origin."""
    vertices = np.asarray(vertices, float)
    along = np.roll(vertices, -1, axis=0) - vertices
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = np.sum(normals * vertices, axis=1)
    return Outline(*(jnp.asarray(part) for part in (vertices, normals, offsets)))


def wall_separation(
    walls: Walls, outline: Outline, pose: Float[Array, "3"]
) -> FloatScalar:
    """Largest gap along any separating axis to the nearest wall; negative: overlap [m].

    No more than the distance where outlines are apart, and their depth where they
    overlap.

    Args:
        walls: all of them.
        outline: of the body.
        pose: of the body [m, m, rad].

    Returns:
        The least over walls.
    """
    dtype = pose.dtype
    # Scalars, written out: of small arrays in a batch the compiler makes loops of a few
    # rounds each, which took twenty times as long.
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    vertices = _turned(outline.vertices.astype(dtype), cos, sin)
    normals = _turned(outline.normals.astype(dtype), cos, sin)
    extents = [
        (_best(v, jnp.minimum), _best(v, jnp.maximum))
        for v in zip(*vertices, strict=True)
    ]
    gaps = []
    for middle, half in zip(
        walls.middle.astype(dtype), walls.half_extents.astype(dtype), strict=True
    ):
        away = middle[0] - pose[0], middle[1] - pose[1]
        # Along the axes of the world: the wall's faces.
        along = [
            gap
            for axis, (low, high) in enumerate(extents)
            for gap in (
                away[axis] - half[axis] - high,
                low - away[axis] - half[axis],
            )
        ]
        # Along the outline's own normals.
        along += [
            x * away[0]
            + y * away[1]
            - jnp.abs(x) * half[0]
            - jnp.abs(y) * half[1]
            - offset
            for (x, y), offset in zip(
                normals, outline.offsets.astype(dtype), strict=True
            )
        ]
        gaps.append(_best(along, jnp.maximum))
    return _best(gaps, jnp.minimum)


def _turned(
    vectors: Float[Array, "vertex 2"], cos: FloatScalar, sin: FloatScalar
) -> list[tuple[FloatScalar, FloatScalar]]:
    """Into the world frame, as scalars."""
    return [(cos * x - sin * y, sin * x + cos * y) for x, y in vectors]


def _best(
    numbers: Sequence[FloatScalar],
    better: Callable[[FloatScalar, FloatScalar], FloatScalar],
) -> FloatScalar:
    """The best of some scalars, such as the least by `jnp.minimum`."""
    return functools.reduce(better, numbers)


def touches(walls: Walls, outline: Outline, pose: Float[Array, "3"]) -> BoolScalar:
    """Whether an outline reaches into a wall."""
    return wall_separation(walls, outline, pose) < 0.0


# Inlined wherever it is traced; by itself it is compiled once.
@functools.partial(jax.jit, inline=True)
def stopped_at_walls(
    walls: Walls, outline: Outline, state: State, next_state: State
) -> State:
    """Where a lone body's step ends, if it stops at the first wall.

    Args:
        walls: all of them.
        outline: of the body.
        state: before, clear of walls.
        next_state: after, as if there were none.

    Returns:
        The next state, at rest where it was stopped.
    """
    before, after = state.pose[0], next_state.pose[0]
    parts = jnp.arange(1, _NUM_CHECKS + 1, dtype=before.dtype) / _NUM_CHECKS

    # A loop, since all checks at once are more than the compiler keeps as one function.
    def check(carry, part):
        is_clear, reached = carry
        pose = before + part * (after - before)
        is_clear = is_clear & ~touches(walls, outline, pose)
        return (is_clear, jnp.where(is_clear, part, reached)), None

    begun = jnp.ones((), bool), jnp.zeros((), before.dtype)
    (is_clear, reached), _ = jax.lax.scan(check, begun, parts)
    pose = jnp.where(is_clear, after, before + reached * (after - before))
    twist = jnp.where(is_clear, next_state.twist, 0.0)
    return State(pose[None], twist)
