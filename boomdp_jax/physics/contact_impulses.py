r"""How the impulses of one contact are put right, given those of all others.

Projected Gauss-Seidel: $\lambda \leftarrow \Pi(\lambda - (\dot C + b)/K)$ with its
projection on what is allowed, rows of a pair one after another, pairs without a common
body at once. The two normal rows of a pair are solved together and exactly.

Compared on a tower of five boxes at 60 Hz, ten seconds (deepest overlap, that in the
last second, and how far a box strayed, in mm; `benchmarks/contact_settings.py`): four
substeps of one sweep, as it is, 0.55, 0.55 and 0.57; the same without the impulses of
the step before 3.9, 3.9 and 11; without softness, as Baumgarte (1972) has it, 0.38,
0.00 and 1.4, but with a box of a hundred times the mass on top it collapses, while the
soft one stands 14 mm deep; two substeps 2.2, 2.2 and 5.5; two substeps of two sweeps
2.2, 2.2 and 5.4, and one of four 8.8, 8.8 and 25, so that a substep is worth more than
a sweep (Macklin et al. 2019, Small steps in physics simulation). Tried and not kept:
normal rows one after another (a fifth deeper), second sweeps in opposite order, and
leaving the impulses of an impact out of the next start (heaps got worse).

Where contact is smoothed (`Scene.smoothing`, s) impulse and residual speed are on the
central path $\lambda w = s^2/K$ in place of $\lambda w = 0$, and the bounds of friction
are rounded off likewise (Pang et al. 2023, Global planning for contact-rich
manipulation via local smoothing of quasi-dynamic contact models).
"""

from typing import NamedTuple

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.contact_geometry import Pair
from boomdp_jax.physics.contact_rows import (
    Ease,
    Impulse,
    Row,
    Rows,
    Twist,
    gain_of,
    pushes,
)

PUSH_SPEED = 1.0
"""Greatest speed at which overlapping bodies are moved apart [m/s]. It moves them and
is not left in their twists."""

# Impacts slower than this do not bounce [m/s]; a bouncing ball comes to rest at it.
# What forces do to a speed within a substep may be more (`_put_off`).
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


# Rounds in which the two smoothed normal impulses of a pair find each other.
_NUM_SMOOTHED = 4


class Pace(NamedTuple):
    """What is the same for all contacts of a world."""

    rate: FloatScalar
    """One over the length of the substep [1/s]."""
    smoothing: FloatScalar | None = None
    """Speed by which contact is smoothed [m/s]; None: not at all."""


def part(
    rows: Rows,
    eases: tuple[Ease, Ease],
    pace: Pace,
    given: tuple[tuple[Twist, Twist], tuple[Twist, Twist]],
    twists: tuple[tuple, tuple],
    impulses: list[Impulse],
) -> tuple[tuple[tuple, tuple], list[Impulse], list[FloatScalar]]:
    """Put a contact right so that nothing overlaps at the end of the substep.

    Args:
        rows: the contact.
        eases: of both bodies.
        pace: length of the substep and smoothing.
        given: of both, displacement since the contact was found [m, m, rad], and twists
            when the substep began.
        twists: of both; numbers after the third are sums of impulses.
        impulses: so far.

    Returns:
        Twists, impulses, and the speeds at which surfaces parted at both points when
        the substep began.
    """
    (moved_a, before_a), (moved_b, before_b) = given
    moved, before = (moved_a, moved_b), (before_a, before_b)
    meeting = [_approach(rows, row, before) for row in rows.points]

    def demand(i: int, normal, speed) -> _Demand:
        row, shift = rows.points[i], jnp.zeros_like(normal)
        for side, sign in ((0, -1.0), (1, 1.0)):
            x, y, angle = moved[side]
            turned = row.normal_arms[side] * angle
            turned = turned - row.tangent_arms[side] * (0.5 * angle * angle)
            shift = shift + sign * (rows.normal[0] * x + rows.normal[1] * y + turned)
        slack = pace.rate * (row.separation + shift)
        bias, kept = _softened(slack, pace.smoothing)
        speeds = meeting[i], speed
        waits, parts = _put_off(rows, row, speeds, slack, pace.rate)
        counts = (1.0 - waits) * (1.0 - parts)
        return _Demand(-bias, jnp.where(counts > 0.0, kept, 1.0 - parts), counts)

    twists, impulses = _swept(
        rows, eases, pace, twists, impulses, demand, is_rubbing_last=False
    )
    return twists, impulses, meeting


def _softened(slack: FloatScalar, smoothing: FloatScalar | None) -> tuple:
    """Speed at which a point may approach, and the part of its impulse that is kept."""
    if smoothing is None:
        is_apart = slack > 0.0
        bias = jnp.where(is_apart, slack, jnp.maximum(_SHARE * slack, -PUSH_SPEED))
        return bias, jnp.where(is_apart, 1.0, 1.0 - _SOFTNESS)
    bias = jnp.maximum(_SHARE * slack, -PUSH_SPEED)
    bias = bias + (1.0 - _SHARE) * _smooth_plus(slack, smoothing)
    touches = 0.5 - 0.5 * slack / jnp.sqrt(slack**2 + smoothing**2)
    return bias, 1.0 - _SOFTNESS * touches


def _smooth_plus(value: FloatScalar, size: FloatScalar) -> FloatScalar:
    """The larger of a value and zero, rounded off: x (x - value) = size squared."""
    square = value * value + 4.0 * size * size
    is_some = square > 0.0
    root = jnp.where(is_some, jnp.sqrt(jnp.where(is_some, square, 1.0)), 0.0)
    # The form that does not cancel.
    other = jnp.where(
        is_some, 2.0 * size * size / jnp.where(root > 0, root - value, 1), 0.0
    )
    return jnp.where(value > 0.0, 0.5 * (value + root), other)


def settle(
    pace: Pace,
    rows: Rows,
    eases: tuple[Ease, Ease],
    meeting: list[FloatScalar],
    twists: tuple[tuple, tuple],
    impulses: list[Impulse],
) -> tuple[tuple[tuple, tuple], list[Impulse]]:
    """Put a contact right once positions are done with.

    Surfaces that touched do not approach, and bounce if they met fast; others are left
    alone.

    Args:
        pace: length of the substep and smoothing.
        rows: the contact.
        eases: of both bodies.
        meeting: speeds at which surfaces parted when the substep began.
        twists: of both; numbers after the third are sums of impulses.
        impulses: so far.

    Returns:
        Twists and impulses.
    """

    def demand(i: int, normal, speed) -> _Demand:
        row, met = rows.points[i], meeting[i]
        bounce = jnp.where(met < -_REST_SPEED, -rows.restitution * met, 0.0)
        slack = jnp.zeros_like(normal)
        waits, _ = _put_off(rows, row, (met, speed), slack, pace.rate)
        if pace.smoothing is None:
            touches = (normal > 0.0).astype(normal.dtype)
        else:
            # An impulse that is only due to smoothing is none to put right.
            most = (normal / jnp.where(row.gains[0] > 0.0, row.gains[0], 1.0)) ** 2
            touches = most / (most + pace.smoothing**2)
        return _Demand(bounce, jnp.ones_like(normal), touches * (1.0 - waits))

    # An impact is found here as a rule: friction has to know of it.
    return _swept(rows, eases, pace, twists, impulses, demand, is_rubbing_last=True)


def _approach(rows: Rows, row: Row, twists: tuple[Twist, Twist]) -> FloatScalar:
    """Speed at which the surfaces part at a point; negative when they approach."""
    (ax, ay, a_spin), (bx, by, b_spin) = twists
    along = rows.normal[0] * (bx - ax) + rows.normal[1] * (by - ay)
    return along + row.normal_arms[1] * b_spin - row.normal_arms[0] * a_spin


def _put_off(rows: Rows, row: Row, speeds: Pair, slack, rate) -> tuple:
    """Whether a point is left to the next substep, and whether it lets go, as numbers.

    Of the speeds the first is that at the start of the substep.

    Bodies that bounce and that meet only through what others do to them within this
    substep have an impact of their own, after the one that caused it: of a row of balls
    the last flies off. Those that part as they bounced before let go, whatever others
    do to them. Neither is so where one would sink into the other by more than a quarter
    of its thickness.

    What forces do within a substep is no impact. A body at rest that they drive on is
    held at once, and one that they bring back at once does not let go; else what falls
    faster in a substep than `_REST_SPEED` lies on a floor bouncing, inside it, for
    ever. Motors and joints are not among those forces.
    """
    before, now = speeds
    a, b = (jnp.abs(arm) for arm in row.tangent_arms)
    is_mild = -(now + slack) < 0.5 * rate * jnp.minimum(a, b)
    bounces = (rows.restitution > 0.0) & is_mild
    parts = before > _REST_SPEED + rows.forced
    is_hit = now < -(_REST_SPEED + rows.forced + jnp.maximum(slack, 0.0))
    waits = bounces & is_hit & (jnp.abs(before) <= _REST_SPEED)
    dtype = slack.dtype
    return waits.astype(dtype), (bounces & parts).astype(dtype)


class _Demand(NamedTuple):
    """What is asked of a point's normal row."""

    speed: FloatScalar
    """At which surfaces part at least [m/s]."""
    kept: FloatScalar
    """Part of the impulse that is not given up."""
    counts: FloatScalar
    """One, or zero where nothing is asked and the impulse stays as it is."""


def _swept(
    rows: Rows,
    eases: tuple[Ease, Ease],
    pace: Pace,
    twists,
    impulses,
    demand,
    *,
    is_rubbing_last,
):
    """One pass over the four rows, both normals at once."""
    smoothing = pace.smoothing
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
            gain_of(a, b, direction[i], arms[i], rows.points[i % 2].gains[0] > 0.0)
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
            if smoothing is None:
                change(i, jnp.minimum(jnp.maximum(new, -limit), limit))
                continue
            size = gains[i] * smoothing
            above, below = (_smooth_plus(new + s * limit, size) for s in (1.0, -1.0))
            change(i, above - below - limit)

    def press() -> None:
        demands = [demand(i, totals[2 + i], speeds[2 + i]) for i in range(2)]
        new = _normals(
            [g * d.counts for g, d in zip(gains[2:], demands, strict=True)],
            _coupling(a, b, direction, arms, 2, 3),
            [v - d.speed for v, d in zip(speeds[2:], demands, strict=True)],
            totals[2:],
            [d.kept for d in demands],
            smoothing,
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


def _normals(
    gains: list, coupling, lacking: list, before: list, kept: list, smoothing
) -> list:
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
    if smoothing is not None:
        sizes = [gain * smoothing for gain in gains]
        new = [_smooth_plus(alone[i], sizes[i]) for i in range(2)]
        for _ in range(_NUM_SMOOTHED):
            for i in range(2):
                new[i] = _smooth_plus(alone[i] - ratio[i] * new[1 - i], sizes[i])
    return [kept[i] * jnp.where(counts[i], new[i], before[i]) for i in range(2)]


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
