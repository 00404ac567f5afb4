r"""One contact and one brake on a lone body: a scalar equation for how fast it slips.

With $\sigma = 1/s$ the scale of the viscous force and $H = S L F^T C$ (2 x 2), the
velocity that friction sees is $\bar u = (1 + \sigma H)^{-1} b$, where b is that
velocity without friction. As
$(1 + \sigma H)^{-1} = (1 + \sigma\,adj H)/\det(1 + \sigma H)$,

$$\bar u = s\,\frac{s\,b + c}{Q(s)}, \qquad c = adj(H)\,b, \qquad
  Q(s) = s^2 + s\,tr H + \det H,$$

and a contact slips at the s > 1, if there is one, at which $|D^{-1} C \bar u| = s$,
that is $|D^{-1} C (s\,b + c)| = Q(s)$: the secular equation of trust-region methods
(Moré and Sorensen 1983, SIAM J. Sci. Stat. Comput. 4, 553), a norm against a parabola.
All of it is one chain of arithmetic without branches, as `core.one_loop` takes it.

The brake (a pin's friction) slips at a constant torque, so it only has to be known
whether, and which way; the signs of the balance at the two spins where it starts to
slip tell. It may act only where the pin holds.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.lone_contacts import Pair, Track, Triple, blend

# Halley steps for s, from an upper bound that is exact where the two vectors are
# parallel. Of 200,000 random wheels (viscous coefficients and limits over four decades
# each, half of the bodies pinned) 99 % are then right to 3e-13 of the impulse and
# 99.9 % to 3e-6, as after three steps of Newton's method.
_NUM_HALLEY = 2
# Below this a squared speed counts as zero.
_TINY = 1e-30
# Limit of what has none.
_ENDLESS = 1e30


class Grip(NamedTuple):
    """A brake that holds or slips, in numbers that do not change from step to step."""

    limit: FloatScalar
    """Impulse at which it slips [N m s]."""
    turned: FloatScalar
    """Spin at the end at which it does, of a body at rest [rad/s]."""
    coasting: FloatScalar
    """How much less of that there is for each unit of spin at the start."""
    held: Pair
    """Impulse per spin at the end and at the start while it holds [N m s²]."""


def grip(brake: Any) -> Grip:
    """Those numbers of a `lone_friction.Brake`."""
    is_limited = brake.knee > 0
    edge = 1.0 / jnp.where(is_limited, brake.knee, 1.0)
    return Grip(
        limit=jnp.where(is_limited, brake.viscous * edge, _ENDLESS),
        turned=edge / brake.share,
        coasting=(1.0 - brake.share) / brake.share,
        held=(brake.viscous * brake.share, brake.viscous * (1.0 - brake.share)),
    )


def slipping_wheel(problem: Any, brake: Grip | None) -> Triple:
    """Velocity of the anchor and spin at the end of a step.

    Args:
        problem: of `lone_friction`, with at most one contact.
        brake: of its pin (zero unless the body is pinned), if it has one.

    Returns:
        Anchor velocity [m/s], in the frame at mid-step, and spin [rad/s].
    """
    light, inertia = problem.ease
    x, y, turning = problem.push
    slide_x, slide_y, spin = problem.start
    track = problem.tracks[0] if problem.tracks else None
    begin = None
    if track is not None:
        begin = (slide_x + track.reach[0] * spin, slide_y + track.lead * spin)
    if brake is not None:
        inertia, turning = _held(brake, (inertia, turning), spin, track, begin)
    swing = 1.0 / inertia
    if track is None or begin is None:
        return light * x, light * y, turning * swing
    first, second = _forces(problem, track, begin, (swing, turning))
    turning = turning - track.reach[0] * first - track.lead * second
    return light * (x - first), light * (y - second), turning * swing


def _held(
    brake: Grip, rotor: Pair, spin: FloatScalar, track: Track | None, begin: Pair | None
) -> tuple[FloatScalar, FloatScalar]:
    """Take the brake into inertia and push, in whichever of its regimes it is."""
    inertia, turning = rotor
    # The balance at the two spins at the end at which the brake slips, with the brake
    # at its limit: the mean of both, and what one has more than it.
    coasted = brake.coasting * spin
    more, mean = brake.turned * inertia + brake.limit, -coasted * inertia - turning
    ahead, behind = mean + more, mean - more
    if track is not None and begin is not None:
        # Where the pin holds its anchor does not slide.
        (p, q), (w, z) = (track.reach[0], track.lead), track.share
        (c, d), (k, m) = track.viscous, track.knee
        mores = (w * p * brake.turned, z * q * brake.turned)
        means = _speeds(track, (-p * coasted, -q * coasted), begin)

        def balance(missing, speeds):
            u, v = speeds
            square = jnp.maximum((k * u) ** 2 + (m * v) ** 2, 1.0)
            return missing * jnp.sqrt(square) + p * c * u + q * d * v

        ahead = balance(ahead, (means[0] + mores[0], means[1] + mores[1]))
        behind = balance(behind, (means[0] - mores[0], means[1] - mores[1]))
    way = jnp.where(ahead < 0, 1.0, jnp.where(behind > 0, -1.0, 0.0))
    holds = 1.0 - way * way
    turning = turning - way * brake.limit - holds * brake.held[1] * spin
    return inertia + holds * brake.held[0], turning


def _speeds(track: Track, end: Pair, begin: Pair) -> Pair:
    """Velocity that the contact sees, from its own at the end and at the start."""
    (w, z) = track.share
    return blend(w, end[0], begin[0]), blend(z, end[1], begin[1])


def _forces(problem, track: Track, begin: Pair, rotor: Pair):
    """Impulses of the contact along its two directions."""
    light, (swing, turning), (cos, sin) = problem.ease[0], rotor, problem.turn
    (c, d), knee, (w, z) = track.viscous, track.knee, track.share
    p, q = track.reach[0], track.lead
    x, y, _ = problem.push
    free = swing * turning
    end = (
        light * (cos * x + sin * y) + p * free,
        light * (cos * y - sin * x) + q * free,
    )
    b = _speeds(track, end, begin)
    # H = Theta (l R^T + g a a^T) C, with a the arms.
    straight, twist, cross = light * cos, light * sin, swing * p * q
    h = [
        [w * c * (straight + swing * p * p), w * d * (cross + twist)],
        [z * c * (cross - twist), z * d * (straight + swing * q * q)],
    ]
    trace = h[0][0] + h[1][1]
    # Both rows lie in one line where l = 0; written so that nothing cancels there.
    determinant = light * (light + swing * cos * (p * p + q * q)) * (w * c) * (z * d)
    turned = (h[1][1] * b[0] - h[0][1] * b[1], h[0][0] * b[1] - h[1][0] * b[0])
    # Everything is divided by the speed in units of the limits, so that nothing
    # overflows however small the limits are.
    fast = (knee[0] * b[0], knee[1] * b[1])
    small = 1.0 / jnp.maximum(jnp.sqrt(fast[0] * fast[0] + fast[1] * fast[1]), 1.0)
    slow = tuple(v * small for v in turned)
    trace, determinant = trace * small, determinant * small * small
    s = _slip(
        (fast[0] * small, fast[1] * small),
        (knee[0] * slow[0] * small, knee[1] * slow[1] * small),
        trace,
        determinant,
        small,
    )
    scale = small / (s * (s + trace) + determinant)
    return tuple(
        v * (s * x + y) * scale for v, x, y in zip(track.viscous, b, slow, strict=True)
    )


def _slip(x: Pair, y: Pair, trace, determinant, least):
    """The root s of |s x + y| = Q(s) above `least`; `least` where there is none."""
    n0 = x[0] * x[0] + x[1] * x[1]
    n1 = x[0] * y[0] + x[1] * y[1]
    n2 = y[0] * y[0] + y[1] * y[1]
    area = x[0] * y[1] - x[1] * y[0]
    # From |s x + y| <= s |x| + |y|: a root is at most this.
    half = 0.5 * (jnp.sqrt(n0) - trace)
    rest = jnp.maximum(jnp.sqrt(n2) - determinant, 0.0)
    s = jnp.maximum(half + jnp.sqrt(half * half + rest), least)
    most = 2.0 * s
    for _ in range(_NUM_HALLEY):
        half_slope = n0 * s + n1
        square = jnp.maximum((half_slope + n1) * s + n2, _TINY)
        inverse = 1.0 / jnp.sqrt(square)
        gap = s * (s + trace) + determinant - square * inverse
        slope = s + s + trace - half_slope * inverse
        # Half of the second derivative; that of the norm is (area / norm^3)^2 norm.
        bend = 1.0 - 0.5 * (area * inverse) ** 2 * inverse
        s = s - gap * slope / (slope * slope - gap * bend)
        s = jnp.clip(s, least, most)
    return s
