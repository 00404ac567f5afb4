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

# Newton steps for s. Of 200,000 random wheels (viscous coefficients and limits over
# four decades each, half of the bodies pinned) 99 % are then right to 5e-11 of the
# impulse, after three to 6e-6; Newton's method on the twist takes six steps for 1e-8.
_NUM_NEWTON = 4
# Below this a squared speed counts as zero.
_TINY = 1e-30


def slipping_wheel(push, ease, drag, brake, one: FloatScalar):
    """Velocity of the anchor and spin at the end of a step.

    Args:
        push: P, generalised momentum without friction, three numbers.
        ease: l and g.
        drag: the contact, or None.
        brake: friction against spin, zero unless l is zero; or None.
        one: from `runtime_one`.

    Returns:
        Anchor velocity [m/s] and spin [rad/s].
    """
    light, swing = ease
    turning = push[2]
    if brake is not None:
        swing, turning = _held(turning, swing, drag, brake, one)
    if drag is None:
        return light * push[0], light * push[1], swing * turning
    first, second = _forces((push[0], push[1], turning), (light, swing), drag, one)
    impulse = [
        p - f * first - g * second
        for p, f, g in zip((push[0], push[1], turning), *drag.force, strict=True)
    ]
    return light * impulse[0], light * impulse[1], hold(swing * impulse[2], one)


def _held(turning, swing, drag, brake, one):
    """Take the brake into ease and push, in whichever of its three regimes it is."""
    is_limited = brake.knee > 0
    edge = 1.0 / jnp.where(is_limited, brake.knee, 1.0)
    limit = brake.viscous * edge

    def balance(speed):
        """What is missing for the spin at which the brake sees this speed [N m s]."""
        spin = (speed - brake.drift) / brake.share
        total = spin / swing - turning
        if drag is None:
            return total
        u = tuple(
            row[2] * spin + drift
            for row, drift in zip(drag.speed, drag.drift, strict=True)
        )
        square = (drag.knee[0] * u[0]) ** 2 + (drag.knee[1] * u[1]) ** 2
        lever = (
            drag.force[0][2] * drag.viscous[0] * u[0]
            + drag.force[1][2] * drag.viscous[1] * u[1]
        )
        return total + lever / jnp.sqrt(jnp.maximum(square, 1.0))

    is_ahead = is_limited & (balance(edge) + limit < 0)
    is_behind = is_limited & (balance(-edge) - limit > 0)
    way = jnp.where(is_ahead, 1.0, jnp.where(is_behind, -1.0, 0.0))
    way = hold(way, one)
    viscous = (1.0 - way * way) * brake.viscous
    turning = hold(turning - way * limit - viscous * brake.drift, one)
    return swing / (1.0 + swing * viscous * brake.share), turning


def _forces(push, ease, drag, one):
    """Impulses of the contact along its two directions."""
    light, swing = ease
    c, knee = drag.viscous, drag.knee
    b = []
    for row, drift in zip(drag.speed, drag.drift, strict=True):
        sliding = light * (row[0] * push[0] + row[1] * push[1])
        b.append(hold(sliding + swing * row[2] * push[2] + drift, one))
    h = [
        [
            c[j]
            * (
                light * _inner(drag.speed[i], drag.force[j])
                + swing * drag.speed[i][2] * drag.force[j][2]
            )
            for j in range(2)
        ]
        for i in range(2)
    ]
    trace = h[0][0] + h[1][1]
    # Both rows lie in one line where l = 0; written so that nothing cancels there.
    determinant = c[0] * c[1] * _determinant(drag, light, swing)
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


def _inner(row, other):
    return row[0] * other[0] + row[1] * other[1]


def _determinant(drag, light, swing):
    """Determinant of S L F^T by the Cauchy-Binet formula."""
    (s0, s1, s2), (r0, r1, r2) = drag.speed
    (f0, f1, f2), (g0, g1, g2) = drag.force
    plane = (s0 * r1 - s1 * r0) * (f0 * g1 - f1 * g0)
    sides = (s0 * r2 - s2 * r0) * (f0 * g2 - f2 * g0)
    sides = sides + (s1 * r2 - s2 * r1) * (f1 * g2 - f2 * g1)
    return light * (light * plane + swing * sides)


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
