r"""How deep convex outlines lie in each other, by one and the same rule for any engine.

Separating axes: along every edge's outward normal the overlap of two shadows is the
least push that parts them along it; the smallest over all edges of both is the depth.
Static bodies do not count among each other.
"""

import itertools

import numpy as np

from boomdp_jax.physics.scene_spec import SceneSpec


def deepest_overlap(spec: SceneSpec, pose: np.ndarray) -> np.ndarray:
    """Depth of the worst pair of polygons, zero where none overlap [m].

    Args:
        spec: the scene; every body of it is a polygon.
        pose: poses of all bodies, `[..., body, 3]`.

    Returns:
        One depth for each leading index.
    """
    corners, normals = zip(
        *(
            _placed(body.vertices, pose[..., i, :])
            for i, body in enumerate(spec.bodies)
        ),
        strict=True,
    )
    deepest = np.zeros(pose.shape[:-2])
    for a, b in itertools.combinations(range(spec.num_bodies), 2):
        if spec.bodies[a].is_static and spec.bodies[b].is_static:
            continue
        depth = np.minimum(
            _least_push(normals[a], corners[a], corners[b]),
            _least_push(normals[b], corners[b], corners[a]),
        )
        deepest = np.maximum(deepest, depth)
    return deepest


def _placed(vertices: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and outward unit normals of a polygon in the world frame."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    turn = np.stack([cos, sin, -sin, cos], axis=-1).reshape(*cos.shape, 2, 2)
    return vertices @ turn + pose[..., None, :2], normal @ turn


def _least_push(normals: np.ndarray, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Smallest overlap of the shadows along one polygon's outward normals."""
    edge = np.einsum("...ij,...ij->...i", normals, own)
    reach = np.einsum("...ij,...kj->...ik", normals, other).min(axis=-1)
    return (edge - reach).min(axis=-1)
