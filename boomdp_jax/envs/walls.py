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

import equinox as eqx
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
    middle, half = walls.middle.astype(dtype), walls.half_extents.astype(dtype)
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    turn = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    vertices = outline.vertices.astype(dtype) @ turn.T
    normals = outline.normals.astype(dtype) @ turn.T
    away = middle - pose[None, :2]
    # Along the axes of the world: the wall's faces.
    above = away - half - jnp.max(vertices, axis=0)[None]
    below = -away - half + jnp.min(vertices, axis=0)[None]
    by_wall = jnp.max(jnp.maximum(above, below), axis=1)
    # Along the outline's own normals.
    gaps = away @ normals.T - half @ jnp.abs(normals).T
    by_edge = jnp.max(gaps - outline.offsets.astype(dtype)[None], axis=1)
    return jnp.min(jnp.maximum(by_wall, by_edge))


def touches(walls: Walls, outline: Outline, pose: Float[Array, "3"]) -> BoolScalar:
    """Whether an outline reaches into a wall."""
    return wall_separation(walls, outline, pose) < 0.0


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
    is_clear = jnp.ones((), bool)
    reached = jnp.zeros((), before.dtype)
    for part in parts:
        pose = before + part * (after - before)
        is_clear = is_clear & ~touches(walls, outline, pose)
        reached = jnp.where(is_clear, part, reached)
    pose = jnp.where(is_clear, after, before + reached * (after - before))
    twist = jnp.where(is_clear, next_state.twist, 0.0)
    return State(pose[None], twist)
