r"""What rubs on the floor under a lone body: wheels on one axle, and feet.

Both share what they can, which is what makes them cheap. The wheels of an axle have one
heading and one set of coefficients and differ by their arm only; feet rub alike in
every direction, so in any frame, and where they have a size against their own spin.
Both see a blend of the motions at the end and at the start of a step with shares that
all of them have in common (`implicit_fit`), so what each sees follows from one blended
motion of the body.

With f the force law (`friction`), $s > 1$ where it slips, $\sigma = \min(1, 1/s)$ and
$b = [s > 1]\,\sigma^2 D^{-2} C^2 u$, its derivative is $K = \sigma C - f\,b^T$, and
what a patch adds to the Jacobian is the sum of $F^T K \Theta F$ over its contacts.
"""

from typing import NamedTuple

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.friction import is_reversed

Pair = tuple[FloatScalar, FloatScalar]
Triple = tuple[FloatScalar, FloatScalar, FloatScalar]
# Entries xx, xy, xt, yx, yy, yt, tx, ty, tt of a 3 x 3 matrix, then a force, then how
# many contacts were taken as sticking (`friction.is_reversed`).
Sums = tuple[FloatScalar, ...]


class Track(NamedTuple):
    """One wheel, or two equal ones on an axle."""

    heading: Pair | None
    """Cosine and sine of the rolling direction; None: along the first axis."""
    reach: list[FloatScalar]
    """Rolling velocity of each per spin about the anchor [m]."""
    lead: FloatScalar
    """Lateral velocity, likewise, of all [m]."""
    viscous: Pair
    """Impulse per speed of each, rolling and lateral [N s²/m]."""
    knee: Pair
    """One over the speed at which the limit is reached [s/m]."""
    share: Pair
    """Share of the end velocity in the velocity that friction sees."""


class Feet(NamedTuple):
    """Feet with one friction coefficient."""

    arms: list[Pair]
    """Velocity of each per spin about the anchor [m]."""
    sizes: list[FloatScalar]
    """Velocity of its edge per spin, which rubs where it stands [m]."""
    viscous: list[FloatScalar]
    knee: FloatScalar
    share: FloatScalar


class Motions(NamedTuple):
    """What friction is asked about: velocities of the anchor, and spins."""

    end: Triple
    start: Triple
    before: Triple | None = None
    """The end in the iteration before."""


def into(heading: Pair | None, x, y) -> Pair:
    """A vector of the body's frame in that of a heading."""
    if heading is None:
        return x, y
    cos, sin = heading
    return cos * x + sin * y, cos * y - sin * x


def out_of(heading: Pair | None, x, y) -> Pair:
    """A vector of the frame of a heading in the body's frame."""
    if heading is None:
        return x, y
    cos, sin = heading
    return cos * x - sin * y, sin * x + cos * y


def blend(share, end, start):
    """The velocity that friction sees."""
    return share * end + (1.0 - share) * start


def slip_scale(square: FloatScalar) -> FloatScalar:
    """What scales the viscous force back onto the limits, from s²: min(1, 1/s)."""
    return 1.0 / jnp.sqrt(jnp.maximum(square, 1.0))


def track_speeds(track: Track, end: Triple, start: Triple) -> tuple[list, FloatScalar]:
    """Rolling velocity of every wheel, and the lateral velocity of all."""
    end, start = ((*into(track.heading, v[0], v[1]), v[2]) for v in (end, start))
    rolling, lateral = track.share
    slide, spin = blend(rolling, end[0], start[0]), blend(rolling, end[2], start[2])
    side = blend(lateral, end[1], start[1])
    side = side + track.lead * blend(lateral, end[2], start[2])
    return [slide + reach * spin for reach in track.reach], side


def feet_motion(feet: Feet, end: Triple, start: Triple) -> Triple:
    """The motion of the body that its feet see."""
    return tuple(blend(feet.share, e, s) for e, s in zip(end, start, strict=True))


def track_force(track: Track, motions: Motions) -> Triple:
    """Generalised force that wheels oppose to a motion, body's frame."""
    speeds, side = track_speeds(track, motions.end, motions.start)
    (c, d), (k, m) = track.viscous, track.knee
    x = y = moment = jnp.zeros_like(side)
    for reach, speed in zip(track.reach, speeds, strict=True):
        scale = slip_scale((k * speed) ** 2 + (m * side) ** 2)
        f, g = scale * (c * speed), scale * (d * side)
        x, y, moment = x + f, y + g, moment + reach * f + track.lead * g
    return (*out_of(track.heading, x, y), moment)


def feet_force(feet: Feet, motions: Motions) -> Triple:
    """Generalised force that feet oppose to a motion."""
    ux, uy, spin = feet_motion(feet, motions.end, motions.start)
    x = y = moment = jnp.zeros_like(spin)
    for (p, q), g, c in zip(feet.arms, feet.sizes, feet.viscous, strict=True):
        u, v, edge = ux + p * spin, uy + q * spin, g * spin
        c = c * slip_scale(feet.knee * feet.knee * (u * u + v * v + edge * edge))
        turn = p * u + q * v + g * edge
        x, y, moment = x + c * u, y + c * v, moment + c * turn
    return x, y, moment


def track_sums(track: Track, motions: Motions) -> Sums:
    """Derivative and force of wheels, in the body's frame."""
    speeds, side = track_speeds(track, motions.end, motions.start)
    (c, d), (k, m), (w, z) = track.viscous, track.knee, track.share
    old = None
    if motions.before is not None:
        old = track_speeds(track, motions.before, motions.start)
    parts, q = [], track.lead
    for i, (p, speed) in enumerate(zip(track.reach, speeds, strict=True)):
        ratio = (k * speed, m * side)
        square = ratio[0] ** 2 + ratio[1] ** 2
        back = jnp.zeros_like(square)
        if old is not None:
            past = (k * old[0][i], m * old[1])
            is_back = is_reversed(ratio, past)
            square = jnp.where(is_back, 1.0, square)
            back = jnp.where(is_back, 1.0, back)
        scale = slip_scale(square)
        loss = jnp.where(scale < 1.0, scale * scale, 0.0)
        cs, ds = scale * c, scale * d
        f, g = cs * speed, ds * side
        cs, ds = cs * w, ds * z
        b, e = loss * k * ratio[0] * w, loss * m * ratio[1] * z
        turn, pinch = p * f + q * g, p * b + q * e
        parts.append(
            (
                *(cs - f * b, -f * e, cs * p - f * pinch),
                *(-g * b, ds - g * e, ds * q - g * pinch),
                *(cs * p - turn * b, ds * q - turn * e),
                cs * p * p + ds * q * q - turn * pinch,
                *(f, g, turn, back),
            )
        )
    sums = [_total(column) for column in zip(*parts, strict=True)]
    if track.heading is None:
        return tuple(sums)
    force = out_of(track.heading, sums[9], sums[10])
    return (*turned(track.heading, sums[:9]), *force, *sums[11:])


def feet_sums(feet: Feet, motions: Motions) -> Sums:
    """Derivative and force of feet."""
    motion = feet_motion(feet, motions.end, motions.start)
    ux, uy, spin = motion
    knee, share, old, parts = feet.knee, feet.share, None, []
    if motions.before is not None:
        old = feet_motion(feet, motions.before, motions.start)
    for (p, q), g, c in zip(feet.arms, feet.sizes, feet.viscous, strict=True):
        u, v, edge = ux + p * spin, uy + q * spin, g * spin
        ratio = (knee * u, knee * v, knee * edge)
        square = ratio[0] ** 2 + ratio[1] ** 2 + ratio[2] ** 2
        back = jnp.zeros_like(square)
        if old is not None:
            past = (old[0] + p * old[2], old[1] + q * old[2], g * old[2])
            is_back = is_reversed(ratio, tuple(knee * v for v in past))
            square = jnp.where(is_back, 1.0, square)
            back = jnp.where(is_back, 1.0, back)
        scale = slip_scale(square)
        c, bend = scale * c, knee * scale
        loss = jnp.where(scale < 1.0, c * bend * bend, 0.0)
        turn = p * u + q * v + g * edge
        parts.append(
            (
                c - loss * u * u,
                -loss * u * v,
                c * p - loss * u * turn,
                c - loss * v * v,
                c * q - loss * v * turn,
                c * (p * p + q * q + g * g) - loss * turn * turn,
                *(c * u, c * v, c * turn, back),
            )
        )
    xx, xy, xt, yy, yt, tt, *rest = (
        _total(column) for column in zip(*parts, strict=True)
    )
    xx, xy, xt, yy, yt, tt = (share * v for v in (xx, xy, xt, yy, yt, tt))
    return (xx, xy, xt, xy, yy, yt, xt, yt, tt, *rest)


def _total(values):
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total


def turned(heading: Pair | None, entries) -> tuple:
    """Nine entries of a matrix of a heading's frame in the body's frame."""
    if heading is None:
        return tuple(entries)
    xx, xy, xt, yx, yy, yt, tx, ty, tt = entries
    (xx, xy), (yx, yy) = out_of(heading, xx, xy), out_of(heading, yx, yy)
    (xx, yx), (xy, yy) = out_of(heading, xx, yx), out_of(heading, xy, yy)
    xt, yt = out_of(heading, xt, yt)
    tx, ty = out_of(heading, tx, ty)
    return xx, xy, xt, yx, yy, yt, tx, ty, tt
