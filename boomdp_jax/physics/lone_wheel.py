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
Everything before s is one chain of arithmetic without branches, which a compiler fuses
into one loop; that is what this form is for.

The brake (a pin's friction) slips at a constant torque, so it only has to be known
whether, and which way; the signs of the balance at the two spins where it starts to
slip tell. It may act only where the pin holds.
"""

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold
from boomdp_jax.physics.lone_contacts import Pair, Track, Triple, blend

# Halley steps for s, from an upper bound that is exact where the two vectors are
# parallel. Of 200,000 random wheels (viscous coefficients and limits over four decades
# each, half of the bodies pinned) 99 % are then right to 3e-13 of the impulse and
# 99.9 % to 3e-6, as after three steps of Newton's method.
_NUM_HALLEY = 2
# Below this a squared speed counts as zero.
_TINY = 1e-30


def slipping_wheel(problem, one: FloatScalar) -> Triple:
    """Velocity of the anchor and spin at the end of a step.

    Args:
        problem: of `lone_friction`, with at most one contact and one brake (zero unless
            the body is pinned).
        one: from `runtime_one`.

    Returns:
        Anchor velocity [m/s], in the frame at mid-step, and spin [rad/s].
    """
    light, inertia = problem.ease
    x, y, turning = problem.push
    track = problem.tracks[0] if problem.tracks else None
    if track is None:
        if problem.joint is not None:
            inertia, turning = _held(problem, None, None, one)
        return light * x, light * y, turning / inertia
    slide_x, slide_y, spin = problem.start
    begin = (slide_x + track.reach[0] * spin, slide_y + track.lead * spin)
    if problem.joint is not None:
        inertia, turning = _held(problem, track, begin, one)
    first, second = _forces(problem, track, begin, (1.0 / inertia, turning), one)
    turning = turning - track.reach[0] * first - track.lead * second
    return light * (x - first), light * (y - second), turning / inertia


def _held(
    problem, track: Track | None, begin: Pair | None, one: FloatScalar
) -> tuple[FloatScalar, FloatScalar]:
    """Take the brake into inertia and push, in whichever of its regimes it is."""
    brake, inertia, turning = problem.joint, problem.ease[1], problem.push[2]
    spin = problem.start[2]
    is_limited = brake.knee > 0
    edge = 1.0 / jnp.where(is_limited, brake.knee, 1.0)
    limit = brake.viscous * edge
    # The spin at the end for which the brake sees its edge, either way.
    coasting, turned = (1.0 - brake.share) / brake.share, edge / brake.share

    def excess(way: float):
        """Sign of the balance at that spin, with the brake at its limit."""
        ending = way * turned - coasting * spin
        missing = ending * inertia - turning + way * limit
        if track is None or begin is None:
            return missing
        # Where the pin holds its anchor does not slide.
        u, v = _speeds(track, (track.reach[0] * ending, track.lead * ending), begin)
        (c, d), (k, m) = track.viscous, track.knee
        square = jnp.maximum((k * u) ** 2 + (m * v) ** 2, 1.0)
        lever = track.reach[0] * (c * u) + track.lead * (d * v)
        return missing * jnp.sqrt(square) + lever

    is_ahead = is_limited & (excess(1.0) < 0)
    is_behind = is_limited & (excess(-1.0) > 0)
    way = hold(jnp.where(is_ahead, 1.0, jnp.where(is_behind, -1.0, 0.0)), one)
    viscous = (1.0 - way * way) * brake.viscous
    turning = turning - way * limit - viscous * (1.0 - brake.share) * spin
    return inertia + viscous * brake.share, hold(turning, one)


def _speeds(track: Track, end: Pair, begin: Pair) -> Pair:
    """Velocity that the contact sees, from its own at the end and at the start."""
    (w, z) = track.share
    return blend(w, end[0], begin[0]), blend(z, end[1], begin[1])


def _forces(problem, track: Track, begin: Pair, rotor: Pair, one: FloatScalar):
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
    b = tuple(hold(v, one) for v in _speeds(track, end, begin))
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
    s = hold(s, one)
    quadratic = s * (s + trace) + determinant
    return tuple(
        v * (s * x + y) * small / quadratic
        for v, x, y in zip(track.viscous, b, slow, strict=True)
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
