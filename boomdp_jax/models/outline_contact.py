r"""Which sides of a body are next to others: rays from its middle, through its outline.

The outline is cut into sectors about the axes of the body frame, the first about +x.
Along each of several rays in a sector, from the centre of mass outwards, a convex
outline of another body is met between two distances; a side is touched if, on any of
its rays, these overlap the stretch that begins at the body's own outline and is
`radius` long (Scholz et al. 2014, section on object-oriented regression).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State


def touched_sectors(
    scene: Scene,
    state: State,
    body: IntScalar | int,
    *,
    radius: FloatScalar | float,
    num_sectors: int = 4,
    num_rays: int = 10,
) -> Bool[Array, " sector"]:
    """Sides of a body with something next to them.

    Args:
        scene: outlines; bodies that cannot touch (`Scene.collides`) are not met, and
            all can where the scene has no contact.
        state: where bodies are.
        body: whose sides.
        radius: how near something has to be to its outline [m].
        num_sectors: sides.
        num_rays: rays in each.

    Returns:
        Whether each side is touched.
    """
    dtype = state.pose.dtype
    turn = 2 * jnp.pi / num_sectors
    share = (jnp.arange(num_rays) + 0.5) / num_rays - 0.5
    angle = turn * (jnp.arange(num_sectors)[:, None] + share[None]).astype(dtype)
    angle = angle.reshape(-1) + state.pose[body, 2]
    rays = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    others = jnp.arange(scene.num_bodies)
    start, stop = jax.vmap(lambda other: _met(scene, state, body, other, rays))(others)
    edge = jnp.where(jnp.isfinite(stop[body]), stop[body], 0.0)[None]
    is_near = (start <= edge + radius) & (stop >= edge)
    can_touch = others != body
    if scene.collides is not None:
        can_touch = can_touch & scene.collides[body]
    is_near = is_near & can_touch[:, None]
    return jnp.any(is_near.reshape(-1, num_sectors, num_rays), axis=(0, 2))


def condition_number(sectors: Bool[Array, " sector"]) -> IntScalar:
    """One integer for each set of sides; zero where none is touched."""
    return jnp.sum(jnp.where(sectors, 2 ** jnp.arange(len(sectors)), 0)).astype(
        jnp.int32
    )


@full_precision
def _met(
    scene: Scene,
    state: State,
    body: IntScalar | int,
    other: IntScalar | int,
    rays: Float[Array, "ray 2"],
) -> tuple[Float[Array, " ray"], Float[Array, " ray"]]:
    """Between which distances rays are inside an outline; infinite and minus, if not.

    Rays begin at the centre of mass of `body`; only what is ahead counts.
    """
    far = jnp.asarray(jnp.inf, rays.dtype)
    # Where rays begin, in the frame of the other body.
    cos, sin = jnp.cos(state.pose[other, 2]), jnp.sin(state.pose[other, 2])
    turn = jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])
    origin = (state.pose[body, :2] - state.pose[other, :2]) @ turn
    rays = rays @ turn
    # A polygon: inside all edges.
    corners = scene.vertices[other]
    edges = jnp.roll(corners, -1, axis=0) - corners
    normals = jnp.stack([edges[:, 1], -edges[:, 0]], axis=-1)
    is_edge = jnp.sum(edges**2, axis=-1) > 0
    inward = jnp.sum((corners - origin[None]) * normals, axis=-1)[None]
    speed = rays @ normals.T
    # A ray along an edge is inside it all the way, or nowhere.
    is_along = speed == 0
    when = inward / jnp.where(is_along, 1.0, speed)
    start = jnp.where(speed < 0, when, jnp.where(is_along & (inward < 0), far, -far))
    stop = jnp.where(speed > 0, when, far)
    start = jnp.max(jnp.where(is_edge[None], start, -far), axis=1)
    stop = jnp.min(jnp.where(is_edge[None], stop, far), axis=1)
    # A circle: between the roots of a square.
    middle = -rays @ origin
    depth = middle**2 - jnp.sum(origin**2) + scene.radius[other] ** 2
    half = jnp.sqrt(jnp.maximum(depth, 0.0))
    is_circle = scene.radius[other] > 0
    start = jnp.where(is_circle, jnp.where(depth < 0, far, middle - half), start)
    stop = jnp.where(is_circle, jnp.where(depth < 0, -far, middle + half), stop)
    start = jnp.maximum(start, 0.0)
    is_met = start <= stop
    return jnp.where(is_met, start, far), jnp.where(is_met, stop, -far)
