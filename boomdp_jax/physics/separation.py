r"""Signed distance between outlines: positive apart, negative overlapping.

An outline is a convex core inflated by a radius: a polygon by zero, and for a circle a
point by its radius. For two cores, with $n_i$ the outward normals of the edges of one
(through $v_i$) and $q_j$ the corners of the other,

- the separating axis test $s = \max_i \min_j n_i \cdot (q_j - v_i)$, over the edges of
  both, is positive exactly where the cores are apart;
- then the distance is the least over pairs of a corner of one and an edge of the other;
- else $-s$ is the depth: the shortest push that parts them is along an edge's normal,
  as those are the normals of the edges of the Minkowski difference.

Both radii are subtracted from the result. Work and memory are the square of the number
of corners for each pair of bodies.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State


def separation(scene: Scene, state: State) -> Float[Array, "body body"]:
    """Signed distance between the outlines of every two bodies.

    Derivatives are finite everywhere. They mean nothing where two features are equally
    near (a kink), nor where the centres of two circles coincide.

    Args:
        scene: outlines.
        state: where the bodies are.

    Returns:
        Distance where outlines are apart, minus the depth of penetration (the shortest
        push that parts them) where they overlap [m]; symmetric, and infinite on the
        diagonal, so that a row's minimum is a body's nearest neighbour.
    """
    num = scene.num_bodies
    first, second = (index.astype(np.int32) for index in np.triu_indices(num, 1))
    apart = jax.vmap(lambda a, b: pair_separation(scene, state, a, b))(first, second)
    table = jnp.full((num, num), jnp.inf, state.pose.dtype)
    return table.at[first, second].set(apart).at[second, first].set(apart)


def pair_separation(
    scene: Scene, state: State, body_a: IntScalar | int, body_b: IntScalar | int
) -> FloatScalar:
    """Signed distance between the outlines of two bodies; cheaper than all pairs.

    Args:
        scene: outlines.
        state: where the bodies are.
        body_a: index of one body.
        body_b: index of another.

    Returns:
        As in `separation` [m]; of a body and itself, minus its least width.
    """
    corners_a, normals_a, is_edge_a = _core(scene, state, body_a)
    corners_b, normals_b, is_edge_b = _core(scene, state, body_b)
    # Relative to body a: far from the origin of the world nothing is lost.
    offset = state.pose[body_b, :2] - state.pose[body_a, :2]
    corners_b = corners_b + offset[None]
    axes = jnp.stack(
        [
            _widest_gap(corners_a, normals_a, is_edge_a, corners_b),
            _widest_gap(corners_b, normals_b, is_edge_b, corners_a),
        ]
    )
    gap = jnp.max(axes)
    has_edge = jnp.any(is_edge_a) | jnp.any(is_edge_b)
    is_apart = (gap > 0) | ~has_edge
    square = jnp.minimum(
        _least_square(corners_a, corners_b), _least_square(corners_b, corners_a)
    )
    is_distant = is_apart & (square > 0)
    distance = jnp.sqrt(jnp.where(is_distant, square, 1.0))
    core = jnp.where(is_distant, distance, jnp.where(is_apart, 0.0, gap))
    return core - scene.radius[body_a] - scene.radius[body_b]


@full_precision
def _core(scene: Scene, state: State, body: IntScalar | int):
    """Corners and outward normals, turned as the body is, and which edges are some.

    An edge goes from each corner to the next. One between a corner and its repetition
    has no length, which is told in the body's frame, where it is so to the bit.
    """
    corners = scene.vertices[body]
    edges = jnp.roll(corners, -1, axis=0) - corners
    square = jnp.sum(edges**2, axis=-1)
    is_edge = square > 0
    length = jnp.sqrt(jnp.where(is_edge, square, 1.0))
    normals = jnp.stack([edges[:, 1], -edges[:, 0]], axis=-1) / length[:, None]
    cos, sin = jnp.cos(state.pose[body, 2]), jnp.sin(state.pose[body, 2])
    turn = jnp.stack([jnp.stack([cos, sin]), jnp.stack([-sin, cos])])
    return corners @ turn, normals @ turn, is_edge


@full_precision
def _widest_gap(corners, normals, is_edge, others) -> FloatScalar:
    """Of all edges, the most by which every other corner is in front of it."""
    ahead = others @ normals.T - jnp.sum(corners * normals, axis=-1)[None, :]
    return jnp.max(jnp.where(is_edge, jnp.min(ahead, axis=0), -jnp.inf))


def _least_square(points, corners) -> FloatScalar:
    """Least squared distance between points and the edges of an outline."""
    edges = jnp.roll(corners, -1, axis=0) - corners
    square = jnp.sum(edges**2, axis=-1)
    offset = points[:, None, :] - corners[None, :, :]
    is_edge = square > 0
    along = jnp.sum(offset * edges[None], axis=-1)
    share = along / jnp.where(is_edge, square, 1.0)[None, :]
    share = jnp.where(is_edge[None, :], jnp.clip(share, 0.0, 1.0), 0.0)
    return jnp.min(jnp.sum((offset - share[..., None] * edges[None]) ** 2, axis=-1))
