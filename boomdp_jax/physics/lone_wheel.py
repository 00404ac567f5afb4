r"""One contact and one brake on a lone body: a scalar equation for how fast it slips.

With $\sigma = 1/s$ the scale of the viscous force and $H = S L F^T C$ (2 x 2), the
velocity that friction sees is $\bar u = (1 + \sigma H)^{-1} b$, where b is that
velocity without friction. As
$(1 + \sigma H)^{-1} = (1 + \sigma\,adj H)/\det(1 + \sigma H)$,

$$\bar u = s\,\frac{s\,b + c}{Q(s)}, \qquad c = adj(H)\,b, \qquad
  Q(s) = s^2 + s\,tr H + \det H,$$

and a contact slips at the s > 1, if there is one, at which $|D^{-1} C \bar u| = s$,
that is $|D^{-1} C (s\,b + c)| = Q(s)$. Q over that norm is close to a straight line in
s (the secular equation of trust-region methods: Moré and Sorensen 1983, SIAM J. Sci.
Stat. Comput. 4, 553), so Newton's method on it converges from below in a few steps.
Everything before s is one chain of arithmetic without branches, which a compiler fuses
into one loop; that is what this form is for.

The brake (a pin's friction) slips at a constant torque, so it only has to be known
whether, and which way; the signs of the balance at the two spins where it starts to
slip tell. It may act only where the pin holds.
"""

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold
from boomdp_jax.physics.lone_contacts import track_speeds

# Newton steps for s. Of 200,000 random wheels (viscous coefficients and limits over
# four decades each, half of the bodies pinned) 99 % are then right to 5e-11 of the
# impulse, after three to 6e-6; Newton's method on the twist takes six steps for 1e-8.
_NUM_NEWTON = 4
# Below this a squared speed counts as zero.
_TINY = 1e-30


def slipping_wheel(problem, one: FloatScalar):
    """Velocity of the anchor and spin at the end of a step.

    Args:
        problem: of `lone_friction`, with at most one contact and one brake (zero unless
            the body is pinned).
        one: from `runtime_one`.

    Returns:
        Anchor velocity [m/s] and spin [rad/s].
    """
    (light, swing), (cos, sin), brake = problem.ease, problem.turn, problem.joint
    x, y, turning = problem.push
    track = problem.tracks[0] if problem.tracks else None
    if brake is not None:
        swing, turning = _held(turning, swing, track, brake, problem.start, one)
    if track is not None:
        e = (light * (cos * x + sin * y), light * (cos * y - sin * x), swing * turning)
        ease = (light, swing, cos, sin)
        first, second = _forces(e, problem.start, ease, track, one)
        x, y = x - first, y - second
        turning = turning - track.reach[0] * first - track.lead * second
    return (
        light * (cos * x + sin * y),
        light * (cos * y - sin * x),
        hold(swing * turning, one),
    )


def _held(turning, swing, track, brake, start, one):
    """Take the brake into ease and push, in whichever of its three regimes it is."""
    is_limited = brake.knee > 0
    edge = 1.0 / jnp.where(is_limited, brake.knee, 1.0)
    limit = brake.viscous * edge

    def balance(speed):
        """What is missing for the spin at which the brake sees this speed [N m s]."""
        spin = (speed - (1.0 - brake.share) * start[2]) / brake.share
        total = spin / swing - turning
        if track is None:
            return total
        # Where the pin holds its anchor does not slide.
        none = jnp.zeros_like(spin)
        (u,), v = track_speeds(track, (none, none, spin), start)
        (c, d), (k, m) = track.viscous, track.knee
        square = (k * u) ** 2 + (m * v) ** 2
        lever = track.reach[0] * c * u + track.lead * d * v
        return total + lever / jnp.sqrt(jnp.maximum(square, 1.0))

    is_ahead = is_limited & (balance(edge) + limit < 0)
    is_behind = is_limited & (balance(-edge) - limit > 0)
    way = jnp.where(is_ahead, 1.0, jnp.where(is_behind, -1.0, 0.0))
    way = hold(way, one)
    viscous = (1.0 - way * way) * brake.viscous
    turning = hold(
        turning - way * limit - viscous * (1.0 - brake.share) * start[2], one
    )
    return swing / (1.0 + swing * viscous * brake.share), turning


def _forces(e, start, ease, track, one):
    """Impulses of the contact along its two directions."""
    light, swing, cos, sin = ease
    c, knee, share = track.viscous, track.knee, track.share
    p, q = track.reach[0], track.lead
    (u,), v = track_speeds(track, e, start)
    b = (hold(u, one), hold(v, one))
    # H = Theta (l R^T + g a a^T) C, with a the arms.
    twist, cross = light * sin, swing * p * q
    h = [
        [
            share[0] * c[0] * (light * cos + swing * p * p),
            share[0] * c[1] * (cross + twist),
        ],
        [
            share[1] * c[0] * (cross - twist),
            share[1] * c[1] * (light * cos + swing * q * q),
        ],
    ]
    trace = h[0][0] + h[1][1]
    # Both rows lie in one line where l = 0; written so that nothing cancels there.
    determinant = light * (light + swing * cos * (p * p + q * q))
    determinant = determinant * (share[0] * c[0]) * (share[1] * c[1])
    turned = (h[1][1] * b[0] - h[0][1] * b[1], h[0][0] * b[1] - h[1][0] * b[0])
    # Everything is divided by the speed in units of the limits, so that nothing
    # overflows however small the limits are.
    fast = tuple(g * v for g, v in zip(knee, b, strict=True))
    unit = jnp.maximum(jnp.sqrt(fast[0] ** 2 + fast[1] ** 2), 1.0)
    small = 1.0 / unit
    slow = tuple(v * small for v in turned)
    trace, determinant = trace * small, determinant * small * small
    s = _slip(
        tuple(v * small for v in fast),
        tuple(g * v * small for g, v in zip(knee, slow, strict=True)),
        trace,
        determinant,
        small,
    )
    s = hold(s, one)
    quadratic = unit * (s * (s + trace) + determinant)
    return tuple(
        v * (s * x + y) / quadratic for v, x, y in zip(c, b, slow, strict=True)
    )


def _slip(x, y, trace, determinant, least):
    """The root s of |s x + y| = Q(s) above `least`; `least` where there is none."""
    n0 = x[0] * x[0] + x[1] * x[1]
    n1 = x[0] * y[0] + x[1] * y[1]
    n2 = y[0] * y[0] + y[1] * y[1]
    # From |s x + y| <= s |x| + |y|: a root is at most this.
    half = 0.5 * (jnp.sqrt(n0) - trace)
    rest = jnp.maximum(jnp.sqrt(n2) - determinant, 0.0)
    s = jnp.maximum(half + jnp.sqrt(half * half + rest), least)
    most = 2.0 * s
    for _ in range(_NUM_NEWTON):
        half_slope = n0 * s + n1
        square = (half_slope + n1) * s + n2
        norm = jnp.sqrt(jnp.maximum(square, _TINY))
        gap = s * (s + trace) + determinant - norm
        slope = s + s + trace - half_slope / norm
        s = jnp.clip(s - gap / slope, least, most)
    return s
