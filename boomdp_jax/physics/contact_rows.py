r"""A contact as four rows: two points, each with friction and then a normal row.

With the normal $n$ from body a to body b, the tangent $t = n^\perp$ and the arms
$r_a, r_b$ of a point,

- normal: $C$ is the separation, $\dot C = n\cdot(v_b + \omega_b r_b^\perp - v_a -
  \omega_a r_a^\perp) \ge 0$, $J = [-n,\, -r_a \times n \mid n,\, r_b \times n]$;
- friction: the same along $t$, with $\dot C = 0$ and an impulse of at most $\mu$ times
  the normal one;
- effective mass $K = J A^{-1} J^T$, with $A$ the inertia as the rest of the substep
  leaves it to feel (friction of wheels and floor and pins to the world included).

Contacts are found once a step. Within it a normal stays as it is and corners turn with
their bodies, so that a separation follows from how bodies moved since. What a radius
adds to an outline does not turn: whichever point of a disc faces the other body, it is
as far from the centre. A lever of friction is that of the point that touches now.
"""

from typing import NamedTuple

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.contact_geometry import Outline, Pair, manifold

Twist = tuple[FloatScalar, FloatScalar, FloatScalar]


class Ease(NamedTuple):
    """Twist per impulse of a body, world frame: a symmetric matrix or its diagonal."""

    x: FloatScalar
    y: FloatScalar
    spin: FloatScalar
    mixed: Twist | None = None
    """x with y, x with spin and y with spin; None: zero, and x equals y."""

    def __call__(self, push: tuple) -> tuple:
        """Answer to an impulse and its moment, of one body or of many."""
        x, y, moment = push
        if self.mixed is None:
            return self.x * x, self.x * y, self.spin * moment
        xy, xs, ys = self.mixed
        return (
            self.x * x + xy * y + xs * moment,
            xy * x + self.y * y + ys * moment,
            xs * x + ys * y + self.spin * moment,
        )


class Side(NamedTuple):
    """One of the two bodies of a pair, at the start of a step."""

    x: FloatScalar
    y: FloatScalar
    corner_x: list[FloatScalar]
    """Corners relative to the centre of mass, world axes [m]."""
    corner_y: list[FloatScalar]
    inverse_length: list[FloatScalar]
    radius: FloatScalar
    friction: FloatScalar
    restitution: FloatScalar
    forced: Twist
    """Twist that forces give it in a substep, world frame."""
    ease: Ease


class Row(NamedTuple):
    """What the four rows of a contact have of one point."""

    normal_arms: Pair
    """Moments of the normal about the two centres of mass [m]."""
    tangent_arms: Pair
    """Of the tangent; also how far along the normal the point lies from them [m]."""
    gains: Pair
    """One over K of normal and tangent [kg]; zero where there is no such point."""
    separation: FloatScalar
    """At the start of the step [m]."""


class Rows(NamedTuple):
    """A contact of two points in scalars."""

    normal: Pair
    friction: FloatScalar
    restitution: FloatScalar
    forced: FloatScalar
    """Most that forces on both do within a substep to the speed at which they meet,
    were one of them held [m/s]."""
    points: list[Row]


Impulse = tuple[FloatScalar, FloatScalar]
"""Of a point: along the normal and the tangent [N s]."""


class Start(NamedTuple):
    """What a contact begins a step with."""

    rows: Rows
    impulses: list[Impulse]
    """Of the step before, as far as the points still exist."""
    separation: FloatScalar
    """Least of the points [m]."""


def begin(a: Side, b: Side, allowed: FloatScalar, impulses: list[Impulse]) -> Start:
    """Find a contact and its rows.

    Args:
        a: the first body.
        b: the second body.
        allowed: one, or zero if the two do not collide.
        impulses: at the end of the step before, one of each point.

    Returns:
        The contact.
    """
    dx, dy = b.x - a.x, b.y - a.y
    found = manifold(
        Outline(a.corner_x, a.corner_y, a.inverse_length, a.radius),
        Outline(
            [dx + x for x in b.corner_x],
            [dy + y for y in b.corner_y],
            b.inverse_length,
            b.radius,
        ),
    )
    nx, ny = found.normal
    restitution = jnp.maximum(a.restitution, b.restitution)
    points, kept, forced = [], [], []
    for point, separation, impulse in zip(
        found.points, found.separation, impulses, strict=True
    ):
        ax, ay = point
        bx, by = ax - dx, ay - dy
        exists = (separation < 1e5) & (allowed > 0.0)
        normal_arms = ax * ny - ay * nx, bx * ny - by * nx
        # Surfaces that are apart will touch each at its own.
        gap = 0.5 * jnp.maximum(separation, 0.0)
        tangent_arms = ax * nx + ay * ny - gap, bx * nx + by * ny + gap
        gains = (
            gain_of(a.ease, b.ease, (nx, ny), normal_arms, exists),
            gain_of(a.ease, b.ease, (-ny, nx), tangent_arms, exists),
        )
        points.append(
            Row(
                normal_arms=normal_arms,
                tangent_arms=tangent_arms,
                gains=gains,
                separation=jnp.where(exists, separation, 0.0),
            )
        )
        speeds = (
            jnp.abs(side.forced[0] * nx + side.forced[1] * ny + side.forced[2] * arm)
            for side, arm in zip((a, b), normal_arms, strict=True)
        )
        forced.append(jnp.where(exists, sum(speeds), 0.0))
        is_kept = exists.astype(separation.dtype)
        kept.append((is_kept * impulse[0], is_kept * impulse[1]))
    product = a.friction * b.friction
    has_friction = product > 0.0
    friction = jnp.where(
        has_friction, jnp.sqrt(jnp.where(has_friction, product, 1.0)), 0.0
    )
    # A pair that may not collide is nowhere near.
    least = jnp.where(allowed > 0.0, jnp.minimum(*found.separation), 1e6)
    rows = Rows((nx, ny), friction, restitution, jnp.maximum(*forced), points)
    return Start(rows, kept, least)


def gain_of(a: Ease, b: Ease, direction: Pair, arms: Pair, exists) -> FloatScalar:
    """One over J A^-1 J^T of a row, zero where nothing can move.

    Args:
        a: ease of the first body.
        b: ease of the second body.
        direction: of the row.
        arms: its moments about both centres of mass [m].
        exists: whether there is such a row.

    Returns:
        Impulse per change of speed [kg].
    """
    total = jnp.zeros_like(arms[0])
    for ease, arm in ((a, arms[0]), (b, arms[1])):
        if ease.mixed is None:
            total = total + ease.x + ease.spin * (arm * arm)
        else:
            push = (*direction, arm)
            total = total + sum(p * q for p, q in zip(push, ease(push), strict=True))
    can_move = exists & (total > 0.0)
    return jnp.where(can_move, 1.0 / jnp.where(can_move, total, 1.0), 0.0)


def pushes(rows: Rows, impulses: list[Impulse]) -> tuple[tuple, tuple]:
    """Impulse and its moment on the two bodies.

    Args:
        rows: the contact.
        impulses: at its points [N s].

    Returns:
        On the first and on the second body, world frame [N s, N s, N m s].
    """
    nx, ny = rows.normal
    normal = sum(impulse[0] for impulse in impulses)
    tangent = sum(impulse[1] for impulse in impulses)
    x, y = nx * normal - ny * tangent, ny * normal + nx * tangent
    first, second = (
        sum(
            row.normal_arms[side] * impulse[0] + row.tangent_arms[side] * impulse[1]
            for row, impulse in zip(rows.points, impulses, strict=True)
        )
        for side in range(2)
    )
    return (-x, -y, -first), (x, y, second)


def add_pushes(rows: Rows, impulses: list[Impulse], sums: tuple) -> tuple:
    """Sums of what both bodies get, with this contact's."""
    return tuple(
        tuple(total + push for total, push in zip(old, new, strict=True))
        for old, new in zip(sums, pushes(rows, impulses), strict=True)
    )
