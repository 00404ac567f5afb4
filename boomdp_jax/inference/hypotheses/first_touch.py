r"""When outlines that move first touch: Newton's method on their distance.

With d(t) the distance of two outlines along a motion of constant acceleration,
$t \leftarrow t - d(t) / \dot d(t)$ from t = 0. For discs and for outlines that do not
turn, without acceleration, d is convex, and the iteration comes from below. The
distance of two discs or of a disc and a polygon is that of their points; for two
polygons it is the separating axis test, the largest gap along the normal of any edge,
which is zero where they touch and otherwise no larger than their distance.

All arrays are in lanes (`core.lanes`), pairs of a sort one below the other, `[pair,
lane]`: in small trailing axes the same search costs ten times a step.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.lanes import in_lanes
from boomdp_jax.physics.scene import Scene

NEVER, PARTING = 1e3, 2e3
"""When outlines touch that hardly move against each other, and that part [s]."""

SLOW = 0.05
"""Speed at which outlines approach or part, at least; up to it bodies that meet do not
bounce, and may as well lie on each other [m/s]."""

_NUM_NEWTON = 4
# Speed below which the search does not go on [m/s].
_LEAST_SPEED = 1e-6
_FAR = 1e9


class PairSort(NamedTuple):
    """Pairs of bodies with outlines of the same sorts; static."""

    is_disc: tuple[bool, bool]
    """A disc and a polygon come as (False, True)."""
    pairs: tuple[tuple[int, int], ...]


def sort_pairs(
    pairs: list[tuple[int, int]], is_disc: np.ndarray
) -> tuple[PairSort, ...]:
    """Put pairs of bodies together by the sort of their outlines.

    Args:
        pairs: of bodies.
        is_disc: which bodies are discs, `[body]`.

    Returns:
        At most three groups.
    """
    groups: dict[tuple[bool, bool], list[tuple[int, int]]] = {}
    for a, b in pairs:
        first, second = sorted((a, b), key=lambda body: bool(is_disc[body]))
        sort = (bool(is_disc[first]), bool(is_disc[second]))
        groups.setdefault(sort, []).append((first, second))
    return tuple(PairSort(sort, tuple(groups[sort])) for sort in sorted(groups))


def touch_times(
    scene: Scene,
    pose: Float[Array, "body 3"],
    twist: Float[Array, "body 3"],
    acceleration: Float[Array, "body 3"],
    sorts: tuple[PairSort, ...],
) -> Float[Array, "body body"]:
    """When bodies first touch, if nothing happens before.

    Args:
        scene: outlines.
        pose: where bodies are [m, m, rad].
        twist: with which they go on [m/s, m/s, rad/s].
        acceleration: constant, of the same.
        sorts: which pairs.

    Returns:
        Time from now of each pair, symmetric [s]; negative where outlines that approach
        overlap already. `NEVER` where they hardly move against each other and for all
        other pairs, `PARTING` where they part.
    """
    table = jnp.full((scene.num_bodies, scene.num_bodies), NEVER, pose.dtype)
    if not sorts:
        return table
    found = in_lanes(
        _in_lanes,
        scene.vertices,
        scene.radius,
        pose,
        twist,
        acceleration,
        static=(sorts,),
    )
    pairs = [pair for sort in sorts for pair in sort.pairs]
    a, b = np.array(pairs, np.int32).T
    return table.at[a, b].set(found).at[b, a].set(found)


class _Body(NamedTuple):
    """One side of some pairs."""

    place: tuple
    """x, y, theta."""
    twist: tuple
    acceleration: tuple
    corners: list
    """In the body's frame."""
    radius: Any


def _in_lanes(sorts, vertices, radius, *motion):
    times = []
    for sort in sorts:
        sides = []
        for side in range(2):
            index = np.array([pair[side] for pair in sort.pairs])
            corners = [
                (vertices[index, i, 0], vertices[index, i, 1])
                for i in range(vertices.shape[1])
            ]
            moving = (tuple(array[index, i] for i in range(3)) for array in motion)
            sides.append(_Body(*moving, corners, radius[index]))
        apart = functools.partial(_APART[sort.is_disc], *sides)

        def better(time, _, apart=apart):
            gap, rate = jax.jvp(apart, (time,), (jnp.ones_like(time),))
            closes = rate < -_LEAST_SPEED
            later = time - gap / jnp.where(closes, rate, -1.0)
            return jnp.where(closes, jnp.clip(later, -NEVER, NEVER), NEVER), None

        start = jnp.zeros_like(sides[0].radius)
        rate = jax.jvp(apart, (start,), (jnp.ones_like(start),))[1]
        found, _ = jax.lax.scan(better, start, None, length=_NUM_NEWTON)
        found = jnp.where(rate < -SLOW, found, NEVER)
        times.append(jnp.where(rate > SLOW, PARTING, found))
    return jnp.concatenate(times)


def _moved(body: _Body, time) -> tuple:
    return tuple(
        place + time * (speed + 0.5 * time * rise)
        for place, speed, rise in zip(*body[:3], strict=True)
    )


def _discs(a: _Body, b: _Body, time):
    (ax, ay, _), (bx, by, _) = _moved(a, time), _moved(b, time)
    square = (bx - ax) ** 2 + (by - ay) ** 2
    return jnp.sqrt(jnp.maximum(square, 1e-12)) - a.radius - b.radius


def _polygon_and_disc(a: _Body, b: _Body, time):
    (ax, ay, angle), (bx, by, _) = _moved(a, time), _moved(b, time)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x = cos * (bx - ax) + sin * (by - ay)
    y = cos * (by - ay) - sin * (bx - ax)
    inside, square = -_FAR, _FAR
    for (px, py), (ex, ey), length in _edges(a.corners):
        is_edge = length > 0.0
        inverse = 1.0 / jnp.where(is_edge, length, 1.0)
        ahead = ((x - px) * ey - (y - py) * ex) * inverse
        inside = jnp.maximum(inside, jnp.where(is_edge, ahead, -_FAR))
        share = ((x - px) * ex + (y - py) * ey) * inverse**2
        share = jnp.where(is_edge, jnp.clip(share, 0.0, 1.0), 0.0)
        each = (x - px - share * ex) ** 2 + (y - py - share * ey) ** 2
        square = jnp.minimum(square, each)
    distance = jnp.sqrt(jnp.maximum(square, 1e-12))
    return jnp.where(inside > 0.0, distance, inside) - b.radius


def _polygons(a: _Body, b: _Body, time):
    corners = []
    for body in (a, b):
        x, y, angle = _moved(body, time)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        corners.append(
            [(x + cos * u - sin * v, y + sin * u + cos * v) for u, v in body.corners]
        )
    gap = -_FAR
    for own, other in (corners, corners[::-1]):
        for (px, py), (ex, ey), length in _edges(own):
            inverse = 1.0 / jnp.where(length > 0.0, length, 1.0)
            ahead = [(qx - px) * ey - (qy - py) * ex for qx, qy in other]
            least = functools.reduce(jnp.minimum, ahead) * inverse
            gap = jnp.maximum(gap, jnp.where(length > 0.0, least, -_FAR))
    return gap


_APART = {
    (True, True): _discs,
    (False, True): _polygon_and_disc,
    (False, False): _polygons,
}


def _edges(corners: list) -> list:
    """Of each edge its begin, its vector, and its length; zero of repeated corners."""
    out = []
    for i, (px, py) in enumerate(corners):
        qx, qy = corners[(i + 1) % len(corners)]
        ex, ey = qx - px, qy - py
        square = ex**2 + ey**2
        is_edge = square > 1e-18
        length = jnp.where(is_edge, jnp.sqrt(jnp.where(is_edge, square, 1.0)), 0.0)
        out.append(((px, py), (ex, ey), length))
    return out
