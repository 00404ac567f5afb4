r"""Where two convex outlines touch or would touch: a normal and at most two points.

Outlines are convex polygons or discs; a disc is a polygon of one corner with a radius.
The pair is cut by the line that separates it best, an edge of one of them (separating
axis theorem); the edge of the other that faces it is clipped to it, which leaves two
points. Where the outlines are apart and their nearest features are two corners, or
there is no edge at all, the line between the corners is the normal and there is one
point.

Everything is written in scalars for one pair and no branch, so that it runs as one
loop over pairs and worlds. The order of the points follows the normal, so that an
impulse of the step before belongs to the same point in this one.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp

from boomdp_jax.core.arrays import BoolScalar, FloatScalar

Pair = tuple[FloatScalar, FloatScalar]

# How much better [m] an edge of the second outline has to separate before it is chosen
# over one of the first: without it rounding decides, and two boxes that lie on each
# other change their minds from step to step.
_PREFERENCE = 1e-4
# Separation of a point that does not exist [m]: beyond any motion.
_FAR = 1e6


class Outline(NamedTuple):
    """A convex outline in the world frame, in scalars."""

    x: list[FloatScalar]
    """Corners, counter-clockwise, the last repeated up to the capacity [m]."""
    y: list[FloatScalar]
    inverse_length: list[FloatScalar]
    """One over the length of the edge from each corner to the next; zero where there
    is no such edge [1/m]."""
    radius: FloatScalar
    """By which the outline is grown [m]; zero for a polygon."""


class Manifold(NamedTuple):
    """A contact in scalars; the normal points from the first outline to the second."""

    normal: Pair
    points: list[Pair]
    """Half-way between the surfaces, world frame [m]; two, in the order of the
    tangent, which is the normal turned left."""
    separation: list[FloatScalar]
    """Of the surfaces at each point, negative where they overlap [m]."""


class _Edge(NamedTuple):
    """An edge with its outward normal, and how far the other outline is beyond it."""

    separation: FloatScalar
    normal: Pair
    start: Pair
    end: Pair


def manifold(a: Outline, b: Outline) -> Manifold:
    """Find the contact of two outlines.

    Args:
        a: the first outline.
        b: the second outline, with room for as many corners.

    Returns:
        The contact; a point that does not exist is a million metres away.
    """
    of_a, of_b = _best_edge(a, b), _best_edge(b, a)
    has_edge = (of_a.separation > -_FAR) | (of_b.separation > -_FAR)
    is_b = of_b.separation > of_a.separation + _PREFERENCE
    edge = _choose(is_b, of_b, of_a)
    facing = _choose(is_b, _facing(a, of_b.normal), _facing(b, of_a.normal))
    grown = _choose(is_b, b.radius, a.radius), _choose(is_b, a.radius, b.radius)
    along = (-edge.normal[1], edge.normal[0])
    length = _dot(along, _minus(edge.end, edge.start))
    # The facing edge runs backwards along this one.
    near, far = facing[1], facing[0]
    t_near, t_far = (_dot(along, _minus(p, edge.start)) for p in (near, far))
    d_near, d_far = (_dot(edge.normal, _minus(p, edge.start)) for p in (near, far))
    is_ordered = t_near <= t_far
    low, high = _choose(is_ordered, (t_near, t_far), (t_far, t_near))
    d_low, d_high = _choose(is_ordered, (d_near, d_far), (d_far, d_near))
    at_low, at_high = _choose(is_ordered, (near, far), (far, near))
    is_before, is_beyond = high < 0.0, low > length
    is_apart = edge.separation > 0.0
    is_corner = ~has_edge | ((is_before | is_beyond) & is_apart)
    span = high - low
    has_span = span > 1e-6 * length
    slope = jnp.where(has_span, (d_high - d_low) / jnp.where(has_span, span, 1.0), 0.0)
    t1, t2 = jnp.clip(low, 0.0, length), jnp.clip(high, 0.0, length)
    d1 = d_low + slope * (jnp.clip(t1, low, high) - low)
    d2 = d_low + slope * (jnp.clip(t2, low, high) - low)
    is_two = has_span & (t2 - t1 > 1e-6 * length) & ~is_corner
    # Corner to corner: the line between them.
    corner = _choose(is_before | ~has_edge, edge.start, edge.end)
    other = _choose(is_before | ~has_edge, at_high, at_low)
    dx, dy = _minus(other, corner)
    square = dx * dx + dy * dy
    has_distance = square > 1e-18
    distance = jnp.sqrt(jnp.where(has_distance, square, 1.0))
    line = (
        jnp.where(has_distance, dx / distance, 1.0),
        jnp.where(has_distance, dy / distance, 0.0),
    )
    distance = jnp.where(has_distance, distance, 0.0)
    normal = _choose(is_corner, line, edge.normal)
    d1 = jnp.where(is_corner, distance, d1)
    base = _choose(
        is_corner,
        corner,
        (edge.start[0] + along[0] * t1, edge.start[1] + along[1] * t1),
    )
    base2 = (edge.start[0] + along[0] * t2, edge.start[1] + along[1] * t2)
    half = 0.5 * (grown[0] - grown[1])
    points = [
        (p[0] + normal[0] * (0.5 * d + half), p[1] + normal[1] * (0.5 * d + half))
        for p, d in ((base, d1), (base2, d2))
    ]
    total = a.radius + b.radius
    separation = [d1 - total, jnp.where(is_two, d2 - total, _FAR)]
    # Seen from the other side the order of two points is reversed.
    is_reversed = is_b & is_two
    points = _choose(is_reversed, points[::-1], points)
    separation = _choose(is_reversed, separation[::-1], separation)
    sign = jnp.where(is_b, -1.0, 1.0)
    return Manifold((sign * normal[0], sign * normal[1]), points, separation)


def _best_edge(outline: Outline, other: Outline) -> _Edge:
    """The edge beyond which the other outline is farthest."""
    num, best = len(outline.x), None
    for i in range(num):
        start = (outline.x[i], outline.y[i])
        end = (outline.x[(i + 1) % num], outline.y[(i + 1) % num])
        normal = _outward(start, end, outline.inverse_length[i])
        depths = [_dot(normal, p) for p in zip(other.x, other.y, strict=True)]
        least = functools.reduce(jnp.minimum, depths)
        separation = least - _dot(normal, start)
        separation = jnp.where(outline.inverse_length[i] > 0.0, separation, -_FAR)
        edge = _Edge(separation, normal, start, end)
        if best is None:
            best = edge
        else:
            best = _choose(edge.separation > best.separation, edge, best)
    assert best is not None
    return best


def _facing(outline: Outline, normal: Pair) -> tuple[Pair, Pair]:
    """Ends of the edge that looks against a normal most; the corner of a disc twice."""
    num = len(outline.x)
    best, ends = None, None
    for i in range(num):
        start = (outline.x[i], outline.y[i])
        end = (outline.x[(i + 1) % num], outline.y[(i + 1) % num])
        along = _dot(normal, _outward(start, end, outline.inverse_length[i]))
        along = jnp.where(outline.inverse_length[i] > 0.0, along, 2.0)
        if best is None:
            best, ends = along, (start, end)
        else:
            is_better = along < best
            best = jnp.where(is_better, along, best)
            ends = _choose(is_better, (start, end), ends)
    assert ends is not None
    return ends


def _outward(start: Pair, end: Pair, inverse_length: FloatScalar) -> Pair:
    dx, dy = _minus(end, start)
    return dy * inverse_length, -dx * inverse_length


def _dot(p: Pair, q: Pair) -> FloatScalar:
    return p[0] * q[0] + p[1] * q[1]


def _minus(p: Pair, q: Pair) -> Pair:
    return p[0] - q[0], p[1] - q[1]


def _choose(condition: BoolScalar, yes, no):
    """Select between two trees of scalars."""
    if isinstance(yes, tuple):
        chosen = [_choose(condition, y, n) for y, n in zip(yes, no, strict=True)]
        return type(yes)(*chosen) if hasattr(yes, "_fields") else tuple(chosen)
    if isinstance(yes, list):
        return [_choose(condition, y, n) for y, n in zip(yes, no, strict=True)]
    return jnp.where(condition, yes, no)
