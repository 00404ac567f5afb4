r"""What the friction of wheels and floor does to every body, linearised at a twist.

A body feels $-T^T f(\bar u)$; with the slope $K$ of $f$ at the iterate $\bar w$ its
momentum balance is

$$A (w - \bar w) = p - M \bar w - T_m^T f(\bar u), \qquad A = M + T_m^T K \vartheta
  T_e,$$

written as a correction since a stiff $K$ drowns $M$ in rounding: what is wrong with
$A^{-1}$ then vanishes with what is left to correct. $T_m$ is taken at mid-step, where
the force acts on average, and $T_e$ at the end of the substep, where a stiff contact
must not slip. All arrays of public functions are in lanes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.friction import Contact, Spin, limited
from boomdp_jax.physics.lone_contacts import Feet, Motions, feet_sums
from boomdp_jax.physics.many_bodies import is_many
from boomdp_jax.physics.small_linear import dot3, inverse3, matvec3

PerBody = Float[Array, "body lane"]

# Points of friction in two directions that one loop takes, or three times as many feet:
# more make it slow to compile.
_MOST_AT_ONCE = 6


class Felt(NamedTuple):
    """What friction depends on, of every body."""

    frame: tuple
    """Cosine and sine at mid-step."""
    turn: tuple
    """Cosine and sine of half the turn of the substep."""
    start: tuple
    """Twist at the start of the substep, world axes."""
    twist: tuple
    """The iterate."""
    before: tuple
    """In the iteration before."""


class BodyAnswer(NamedTuple):
    """A^-1: twist per impulse of every body, world axes."""

    xx: Any
    yy: Any
    spin: Any
    mixed: tuple = ()
    """xy, yx, xs, sx, ys, sy; empty where they are zero."""

    def __call__(self, x, y, moment) -> tuple:
        """Answer to an impulse and its moment."""
        if not self.mixed:
            return self.xx * x, self.yy * y, self.spin * moment
        xy, yx, xs, sx, ys, sy = self.mixed
        return (
            self.xx * x + xy * y + xs * moment,
            yx * x + self.yy * y + ys * moment,
            sx * x + sy * y + self.spin * moment,
        )


def friction_of_bodies(
    contacts: Contact | None, spins: Spin | None, felt: Felt, is_limited: Any
) -> tuple | None:
    """A - M and - T^T f of every body, each in its own frame at mid-step.

    Args:
        contacts: `[contact, body, lane]`.
        spins: `[spin, body, lane]`.
        felt: twists.
        is_limited: one, or zero to leave out the dry limits.

    Returns:
        Nine entries, three, and how many contacts of each body are taken as sticking
        (`friction.limited`); None where there is no friction.
    """
    wheels, feet = _told_apart(contacts)
    brakes = [] if spins is None else _parts(spins)
    if is_many(felt.turn[0].shape[0]):
        total = None
        for part, given in ((wheels, ([wheels], [])), (feet, ([], [feet]))):
            if part is not None:
                each = elementwise(_friction, felt, *given, [], is_limited)
                each = jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), each)
                total = _added(total, each)
        if not brakes:
            return total
        return _added(total, elementwise(_friction, felt, [], [], brakes, is_limited))
    points = [] if wheels is None else _parts(wheels)
    stands = [] if feet is None else _parts(feet)
    total, is_first = None, True
    while points or stands or (brakes and is_first):
        some, points = points[:_MOST_AT_ONCE], points[_MOST_AT_ONCE:]
        room = 0 if points else 3 * (_MOST_AT_ONCE - len(some))
        few, stands = stands[:room], stands[room:]
        given = some, few, brakes if is_first else []
        total = _added(total, elementwise(_friction, felt, *given, is_limited))
        is_first = False
    return total


def with_sizes_of_feet(contacts: Contact, num_feet: int) -> Contact:
    """Tell feet, which are the last contacts, by their sizes alone (`Contact.size`).

    Args:
        contacts: `[contact, body, lane]`.
        num_feet: how many of them are feet.
    """
    first = contacts.viscous[0].shape[0] - num_feet
    size = contacts.size
    size = jnp.zeros_like(contacts.viscous[0]) if size is None else size
    return contacts._replace(size=size[first:] if num_feet else None)


def _told_apart(contacts: Contact | None) -> tuple[Contact | None, Contact | None]:
    """Wheels, and feet, which have sizes; None for none."""
    if contacts is None:
        return None, None
    size, bare = contacts.size, contacts._replace(size=None)
    num = contacts.viscous[0].shape[0] - (0 if size is None else size.shape[0])
    wheels = jax.tree.map(lambda leaf: leaf[:num], bare) if num else None
    if size is None:
        return wheels, None
    return wheels, jax.tree.map(lambda leaf: leaf[num:], bare)._replace(size=size)


def _added(total: tuple | None, part: tuple) -> tuple:
    return part if total is None else jax.tree.map(jnp.add, total, part)


def answer_of_bodies(
    problem: Any, friction: tuple | None, twist: tuple, push: tuple
) -> tuple[BodyAnswer, tuple]:
    """A^-1, and the twists under impulses that are known.

    Args:
        problem: `velocity_solve.VelocityProblem`.
        friction: from `friction_of_bodies`.
        twist: the iterate.
        push: impulse on every body beside its momentum.

    Returns:
        Both, world axes.
    """
    if friction is None:
        light = problem.mobile / problem.mass
        answer = BodyAnswer(light, light, problem.mobile / problem.inertia)
        total = (p + q for p, q in zip(problem.momentum, push, strict=True))
        return answer, answer(*total)
    return elementwise(
        _answer,
        problem.mobile,
        problem.mass,
        problem.inertia,
        tuple(p + q for p, q in zip(problem.momentum, push, strict=True)),
        problem.frame,
        friction,
        twist,
    )


def _parts(stacked: Any) -> list:
    num = jax.tree.leaves(stacked)[0].shape[0]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(num)]


def into_frame(frame: tuple, twist: tuple) -> tuple:
    """A twist in a frame's axes, of one in the world's."""
    (cos, sin), (x, y, spin) = frame, twist
    return cos * x + sin * y, cos * y - sin * x, spin


def _friction(
    felt: Felt,
    points: list[Contact],
    feet: list[Contact],
    brakes: list[Spin],
    is_limited,
):
    """Of one body in scalars."""
    start, now, before = (
        into_frame(felt.frame, v) for v in (felt.start, felt.twist, felt.before)
    )
    cos, sin = felt.turn
    # A twist at the start, half a turn before mid-step.
    start = (cos * start[0] - sin * start[1], sin * start[0] + cos * start[1], start[2])
    zero = jnp.zeros_like(cos)
    a, b, num_back = [[zero] * 3 for _ in range(3)], [zero] * 3, zero
    for point in points:
        rows = (point.rolling, point.lateral)
        ends = [
            (cos * row[0] - sin * row[1], sin * row[0] + cos * row[1], row[2])
            for row in rows
        ]
        viscous, weight = point.viscous, point.weight

        def seen(twist, ends=ends, rows=rows, weight=weight):
            return tuple(
                w * dot3(end, twist) + (1.0 - w) * dot3(row, start)
                for w, end, row in zip(weight, ends, rows, strict=True)
            )

        u = seen(now)
        knee = tuple(k * is_limited for k in point.knee)
        scale, slope, back = limited(u, viscous, knee, seen(before))
        num_back = num_back + back
        for i, row in enumerate(rows):
            k = [slope[i][j] * weight[j] for j in range(len(rows))]
            force = scale * viscous[i] * u[i]
            for m in range(3):
                b[m] = b[m] - row[m] * force
                for n in range(3):
                    pull = sum(k[j] * ends[j][n] for j in range(len(rows)))
                    a[m][n] = a[m][n] + row[m] * pull
    if feet:
        # Feet have no heading: each sees the twist in the axes of the end, whatever it
        # is at mid-step, and what it adds turns back with the twist.
        turned, turned_before = (into_frame(felt.turn, v) for v in (now, before))
        motions, slope = Motions(turned, start, turned_before), [zero] * 9
        for foot in feet:
            patch = Feet(
                arms=[(foot.rolling[2], foot.lateral[2])],
                sizes=[zero if foot.size is None else foot.size],
                viscous=[foot.viscous[0]],
                knee=foot.knee[0] * is_limited,
                share=foot.weight[0],
            )
            *entries, x, y, moment, back = feet_sums(patch, motions)
            slope = [s + entry for s, entry in zip(slope, entries, strict=True)]
            b = [p - q for p, q in zip(b, (x, y, moment), strict=True)]
            num_back = num_back + back
        for m in range(3):
            x, y, spin = slope[3 * m : 3 * m + 3]
            own = (cos * x - sin * y, sin * x + cos * y, spin)
            a[m] = [p + q for p, q in zip(a[m], own, strict=True)]
    for brake in brakes:
        knee = brake.knee * is_limited
        u, old = (
            brake.weight * v[2] + (1.0 - brake.weight) * start[2] for v in (now, before)
        )
        scale, ((k,),), back = limited((u,), (brake.viscous,), (knee,), (old,))
        k, num_back = k * brake.weight, num_back + back
        b[2] = b[2] - scale * brake.viscous * u
        a[2][2] = a[2][2] + k
    return a, b, num_back


def _answer(mobile, mass, inertia, momentum, frame, friction, twist) -> tuple:
    """Of one body in scalars."""
    a, b, _ = friction
    a = [list(row) for row in a]
    for i, own in enumerate((mass, mass, inertia)):
        a[i][i] = a[i][i] + own
    inverse = [[mobile * entry for entry in row] for row in inverse3(a)]
    lacking = tuple(
        p - m * v
        for p, m, v in zip(momentum, (mass, mass, inertia), twist, strict=True)
    )
    rhs = [p + q for p, q in zip(into_frame(frame, lacking), b, strict=True)]
    change = matvec3(inverse, rhs)
    c, s = frame
    (xx, xy, xs), (yx, yy, ys), (sx, sy, spin) = inverse
    # R A^-1 R^T, column after column and then row after row.
    xx, xy, yx, yy = c * xx - s * xy, s * xx + c * xy, c * yx - s * yy, s * yx + c * yy
    sx, sy = c * sx - s * sy, s * sx + c * sy
    xx, yx = c * xx - s * yx, s * xx + c * yx
    xy, yy = c * xy - s * yy, s * xy + c * yy
    xs, ys = c * xs - s * ys, s * xs + c * ys
    answer = BodyAnswer(xx, yy, spin, (xy, yx, xs, sx, ys, sy))
    x, y, turn = change
    free = (twist[0] + c * x - s * y, twist[1] + s * x + c * y, twist[2] + turn)
    return answer, free
