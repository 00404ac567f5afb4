r"""A contact as four rows: two points, each with friction and then a normal row.

With the normal $n$ from body a to body b, the tangent $t = n^\perp$ and the arms
$r_a, r_b$ of a point,

- normal: $C$ is the separation, $\dot C = n\cdot(v_b + \omega_b r_b^\perp - v_a -
  \omega_a r_a^\perp) \ge 0$, $J = [-n,\, -r_a \times n \mid n,\, r_b \times n]$;
- friction: the same along $t$, with $\dot C = 0$ and an impulse of at most $\mu$ times
  the normal one;
- effective mass $K = J A^{-1} J^T$, with $A$ the inertia as the rest of the substep
  leaves it to feel (friction of wheels and floor and pins to the world included).

An impulse is put right by $\lambda \leftarrow \Pi(\lambda - (\dot C + b)/K)$ with its
projection on what is allowed (projected Gauss-Seidel): rows of a pair one after
another, pairs without a common body at once.

Contacts are found once a step. Within it a normal stays as it is and points turn with
their bodies, so that a separation follows from how bodies moved since.
"""

from typing import NamedTuple

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.contact_geometry import Outline, Pair, manifold

Twist = tuple[FloatScalar, FloatScalar, FloatScalar]

PUSH_SPEED = 1.0
"""Greatest speed at which overlapping bodies are moved apart [m/s]. It moves them and
is not left in their twists."""

# Impacts slower than this do not bounce [m/s]; a bouncing ball comes to rest at it.
_REST_SPEED = 0.05

# An overlap is undone like that of a damped spring with a quarter of the substep rate
# as its frequency and ten times critical damping: faster and stacks shake, slower and
# they sink (Catto 2024, Solver2D, "soft step").
_TURN = 0.5 * jnp.pi
_DAMPING = 10.0
_SHARE = float(_TURN / (2.0 * _DAMPING + _TURN))
"""Part of an overlap that one substep undoes."""
_SOFTNESS = float(1.0 / (1.0 + _TURN * (2.0 * _DAMPING + _TURN)))
"""Part of an overlapping point's impulse that is given up in an iteration."""


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
    points, kept = [], []
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
            _gain(a.ease, b.ease, (nx, ny), normal_arms, exists),
            _gain(a.ease, b.ease, (-ny, nx), tangent_arms, exists),
        )
        points.append(
            Row(
                normal_arms=normal_arms,
                tangent_arms=tangent_arms,
                gains=gains,
                separation=jnp.where(exists, separation, 0.0),
            )
        )
        is_kept = exists.astype(separation.dtype)
        kept.append((is_kept * impulse[0], is_kept * impulse[1]))
    product = a.friction * b.friction
    has_friction = product > 0.0
    friction = jnp.where(
        has_friction, jnp.sqrt(jnp.where(has_friction, product, 1.0)), 0.0
    )
    # A pair that may not collide is nowhere near.
    least = jnp.where(allowed > 0.0, jnp.minimum(*found.separation), 1e6)
    return Start(Rows((nx, ny), friction, restitution, points), kept, least)


def _gain(a: Ease, b: Ease, direction: Pair, arms: Pair, exists) -> FloatScalar:
    """One over J A^-1 J^T of a row, zero where nothing can move."""
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


def part(
    rows: Rows,
    eases: tuple[Ease, Ease],
    rate: FloatScalar,
    moved: tuple[Twist, Twist],
    twists: tuple[tuple, tuple],
    impulses: list[Impulse],
) -> tuple[tuple[tuple, tuple], list[Impulse]]:
    """Put a contact right so that nothing overlaps at the end of the substep.

    Args:
        rows: the contact.
        eases: of both bodies.
        rate: one over the length of the substep [1/s].
        moved: displacement of both bodies since the contact was found [m, m, rad].
        twists: of both; numbers after the third are sums of impulses.
        impulses: so far.

    Returns:
        Twists and impulses.
    """

    def demand(row: Row, normal) -> _Demand:
        shift = jnp.zeros_like(normal)
        for side, sign in ((0, -1.0), (1, 1.0)):
            x, y, angle = moved[side]
            turned = row.normal_arms[side] * angle
            turned = turned - row.tangent_arms[side] * (0.5 * angle * angle)
            shift = shift + sign * (rows.normal[0] * x + rows.normal[1] * y + turned)
        slack = rate * (row.separation + shift)
        is_apart = slack > 0.0
        bias = jnp.where(is_apart, slack, jnp.maximum(_SHARE * slack, -PUSH_SPEED))
        kept = jnp.where(is_apart, 1.0, 1.0 - _SOFTNESS)
        return _Demand(-bias, kept, jnp.ones_like(kept))

    return _swept(rows, eases, twists, impulses, demand, is_rubbing_last=False)


def settle(
    rows: Rows,
    eases: tuple[Ease, Ease],
    before: tuple[Twist, Twist],
    twists: tuple[tuple, tuple],
    impulses: list[Impulse],
) -> tuple[tuple[tuple, tuple], list[Impulse]]:
    """Put a contact right once positions are done with.

    Surfaces that touched do not approach, and bounce if they met fast; others are left
    alone.

    Args:
        rows: the contact.
        eases: of both bodies.
        before: twists of both when the substep began.
        twists: of both; numbers after the third are sums of impulses.
        impulses: so far.

    Returns:
        Twists and impulses.
    """
    (ax, ay, a_spin), (bx, by, b_spin) = before
    along = rows.normal[0] * (bx - ax) + rows.normal[1] * (by - ay)

    def demand(row: Row, normal) -> _Demand:
        speed = along + row.normal_arms[1] * b_spin - row.normal_arms[0] * a_spin
        bounce = jnp.where(speed < -_REST_SPEED, -rows.restitution * speed, 0.0)
        touches = (normal > 0.0).astype(normal.dtype)
        return _Demand(bounce, jnp.ones_like(normal), touches)

    # An impact is found here as a rule: friction has to know of it.
    return _swept(rows, eases, twists, impulses, demand, is_rubbing_last=True)


class _Demand(NamedTuple):
    """What is asked of a point's normal row."""

    speed: FloatScalar
    """At which surfaces part at least [m/s]."""
    kept: FloatScalar
    """Part of the impulse that is not given up."""
    counts: FloatScalar
    """One, or zero where nothing is asked."""


def _swept(
    rows: Rows, eases: tuple[Ease, Ease], twists, impulses, demand, *, is_rubbing_last
):
    """One pass over the four rows, both normals at once."""
    nx, ny = rows.normal
    a, b = eases
    (ax, ay, a_spin), (bx, by, b_spin) = twists[0][:3], twists[1][:3]
    dx, dy = bx - ax, by - ay
    along, across = nx * dx + ny * dy, nx * dy - ny * dx
    arms = [row.tangent_arms for row in rows.points]
    arms += [row.normal_arms for row in rows.points]
    gains = [row.gains[1] for row in rows.points]
    gains += [row.gains[0] for row in rows.points]
    direction = [(-ny, nx), (-ny, nx), (nx, ny), (nx, ny)]
    if a.mixed is not None:
        gains = [
            _gain(a, b, direction[i], arms[i], rows.points[i % 2].gains[0] > 0.0)
            for i in range(4)
        ]
    speeds = [
        (across if i < 2 else along) + arm[1] * b_spin - arm[0] * a_spin
        for i, arm in enumerate(arms)
    ]
    totals = [impulse[1] for impulse in impulses] + [impulse[0] for impulse in impulses]
    changes = [jnp.zeros_like(nx)] * 4

    def change(i: int, new) -> None:
        delta = new - totals[i]
        totals[i], changes[i] = new, changes[i] + delta
        for k in range(4):
            speeds[k] = speeds[k] + _coupling(a, b, direction, arms, i, k) * delta

    def rub() -> None:
        for i in range(2):
            limit = rows.friction * totals[2 + i]
            new = totals[i] - gains[i] * speeds[i]
            change(i, jnp.minimum(jnp.maximum(new, -limit), limit))

    def press() -> None:
        demands = [demand(row, totals[2 + i]) for i, row in enumerate(rows.points)]
        new = _normals(
            [g * d.counts for g, d in zip(gains[2:], demands, strict=True)],
            _coupling(a, b, direction, arms, 2, 3),
            [v - d.speed for v, d in zip(speeds[2:], demands, strict=True)],
            totals[2:],
            [d.kept for d in demands],
        )
        change(2, new[0])
        change(3, new[1])

    for stage in (press, rub) if is_rubbing_last else (rub, press):
        stage()
    pairs = [(changes[2], changes[0]), (changes[3], changes[1])]
    out = []
    for ease, twist, push in zip(eases, twists, pushes(rows, pairs), strict=True):
        moved = [v + dv for v, dv in zip(twist, ease(push), strict=False)]
        # The sums of impulses, where they are kept.
        moved += [total + p for total, p in zip(twist[3:], push, strict=False)]
        out.append(tuple(moved))
    impulses = [
        (old[0] + change[0], old[1] + change[1])
        for old, change in zip(impulses, pairs, strict=True)
    ]
    return (out[0], out[1]), impulses


def _normals(gains: list, coupling, lacking: list, before: list, kept: list) -> list:
    """Both normal impulses, which meet their two demands exactly.

    The linear complementarity problem of two unknowns has four cases; one after another
    instead would turn a body that lands flat.
    """
    counts = [gain > 0.0 for gain in gains]
    both = counts[0] & counts[1]
    held = [jnp.where(on, v, 0.0) for on, v in zip(counts, before, strict=True)]
    # What each would have to be if the other were none.
    cross = jnp.where(both, coupling, 0.0)
    alone = [held[i] + gains[i] * (cross * held[1 - i] - lacking[i]) for i in range(2)]
    ratio = [gains[i] * cross for i in range(2)]
    rest = 1.0 - ratio[0] * ratio[1]
    can_share = both & (rest > 1e-4)
    share = jnp.where(can_share, 1.0 / jnp.where(can_share, rest, 1.0), 0.0)
    shared = [share * (alone[i] - ratio[i] * alone[1 - i]) for i in range(2)]
    is_shared = can_share & (shared[0] >= 0.0) & (shared[1] >= 0.0)
    single = [jnp.maximum(value, 0.0) for value in alone]
    # With the first alone the second has enough.
    is_first = (alone[1] <= ratio[1] * single[0]) | ~counts[1]
    new = [
        jnp.where(is_shared, shared[0], jnp.where(is_first, single[0], 0.0)),
        jnp.where(is_shared, shared[1], jnp.where(is_first, 0.0, single[1])),
    ]
    return [jnp.where(counts[i], kept[i] * new[i], before[i]) for i in range(2)]


def _coupling(a: Ease, b: Ease, direction, arms, j: int, i: int) -> FloatScalar:
    """J_i A^-1 J_j^T: speed of row i per impulse of row j."""
    if a.mixed is None:
        total = arms[i][0] * arms[j][0] * a.spin + arms[i][1] * arms[j][1] * b.spin
        # The normal and the tangent are orthogonal.
        return total + (a.x + b.x) if (i < 2) == (j < 2) else total
    total = jnp.zeros_like(arms[0][0])
    for side, ease in ((0, a), (1, b)):
        answer = ease((*direction[j], arms[j][side]))
        push = (*direction[i], arms[i][side])
        total = total + sum(p * q for p, q in zip(push, answer, strict=True))
    return total
