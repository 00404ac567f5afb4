r"""The one friction law, and where wheels, floors and joints apply it.

A contact moves with velocity $u = T w$, where $w$ is the twist of its body in the body
frame and the rows of $T$ are its rolling and its lateral direction. The force on the
body along these directions is

$$f(u) = -C u \min(1, 1/s), \qquad s = |D^{-1} C u|,$$

with $C$ the viscous coefficients and $D$ the dry limits, both diagonal: viscous, and
scaled back along its own direction onto the ellipse of dry limits where it lies
outside. Its derivative is $-K$ with $K = C$ inside the ellipse and
$K = (C - C u\,(D^{-2}C^2 u)^T / s^2)/s$ outside. A joint's friction is the same law in
one dimension, and that of a foot with a size in three: the last is the speed of its
edge, its size times the spin. (MuJoCo's torsional friction under elliptic cones is that
law; a foot that shrinks to a point loses it.)

Everything here is constant in the body frame, so it is prepared once per rollout.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.physics.params import Ground, Params, Wheel
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.trigonometry import sincos

# Newton steps after the solution in which everything sticks. Of 20,000 random bodies
# with pin, wheels and feet (active or not) 99.9 % are then right to 1e-9 m/s, after
# four to 2e-4; after three, one in a thousand is wrong by 0.3 m/s.
NUM_NEWTON = 5

LATE_SHARES = (1.0, 1.0, 0.5)
"""Shares of the iterations after these, over and over, from where the others ended.
Tracks go round between kinks, where one wheel starts to slip and another holds; a step
a little shorter leads out of that. (Lengths of steps chosen by what is left to solve
serve such less well. Limits that are ellipses make the force no gradient of anything,
and what is left has minima of its own: a third of these tracks were held up there.)"""

NUM_LATE = (15, 12, 12)
"""How many of them: going on, then from the solution without friction, then from the
velocities at the start. Of 100,000 random tracks 538 are never solved by whole
iterations, 26 are left after fifteen of these, and of those with feet 308 and 31;
either new start solves three in four of such within twelve."""

KNEE_SPEED = 0.02
"""Speed [m/s, rad/s for a joint] at which friction that is given by its dry limit alone
reaches it: below, it is viscous. Larger: bodies creep on slopes and under small pushes;
smaller: stiffer, with nothing to see for it at the resolution of a camera."""

PerContact = Float[Array, "*contact"]


class Contact(NamedTuple):
    """Points where friction acts, in two directions; fields `[contact, *body]`."""

    rolling: tuple[PerContact, PerContact, PerContact]
    """Row of T: velocity along the heading per twist in the body frame."""
    lateral: tuple[PerContact, PerContact, PerContact]
    viscous: tuple[PerContact, PerContact]
    """C: force per speed, rolling and lateral [N s/m]."""
    knee: tuple[PerContact, PerContact]
    """C over D: one over the speed at which the limit is reached [s/m]."""
    weight: tuple[PerContact, PerContact]
    """Share of the end velocity in the velocity that friction sees."""
    size: PerContact | None = None
    """Third row of T: velocity per spin at which it rubs where it stands [m]. Its
    coefficients and weight are the lateral ones. A `Prepared` world has it of feet
    alone, which are the last contacts."""


class Spin(NamedTuple):
    """Friction against spin; fields `[spin, *body]`."""

    viscous: PerContact
    knee: PerContact
    weight: PerContact


def _over(numerator, denominator):
    """A ratio that is zero where the denominator is infinite or not positive."""
    is_limited = (denominator > 0) & jnp.isfinite(denominator)
    return jnp.where(is_limited, numerator / jnp.where(is_limited, denominator, 1), 0.0)


class _Points(NamedTuple):
    """Contacts as authored: place, heading, coefficients; fields `[contact, body]`."""

    x: PerContact
    y: PerContact
    heading: PerContact
    viscous: tuple[PerContact, PerContact]
    dry: tuple[PerContact, PerContact]
    active: Bool[Array, "*contact"]
    size: PerContact


def wheel_headings(wheel: Wheel) -> PerContact:
    """Heading of every wheel `[wheel, body]`, zero where it is not active [rad]."""
    return jnp.where(wheel.active, wheel.heading, 0.0).T


def _wheel_points(wheel: Wheel) -> _Points:
    """One contact, or two with half the coefficients where there is a track."""
    points = _Points(
        x=wheel.position[..., 0].T,
        y=wheel.position[..., 1].T,
        heading=wheel_headings(wheel),
        viscous=(wheel.viscous[..., 0].T, wheel.viscous[..., 1].T),
        dry=(wheel.dry[..., 0].T, wheel.dry[..., 1].T),
        active=wheel.active.T,
        size=jnp.zeros_like(wheel.position[..., 0].T),
    )
    if wheel.half_track is None:
        return points
    sin, cos = sincos(points.heading)
    dx, dy = -sin * wheel.half_track.T, cos * wheel.half_track.T

    def side(sign: float) -> _Points:
        return points._replace(
            x=points.x + sign * dx,
            y=points.y + sign * dy,
            viscous=(0.5 * points.viscous[0], 0.5 * points.viscous[1]),
            dry=(0.5 * points.dry[0], 0.5 * points.dry[1]),
        )

    return _join(side(-1.0), side(1.0))


def _join(*parts: _Points) -> _Points:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _foot_points(
    scene: Scene, ground: Ground, mass: Float[Array, " body"]
) -> tuple[_Points, Spin]:
    """Feet that share load and viscosity, and what of their torque is decoupled."""
    load = mass * scene.normal_gravity
    viscous, active = ground.viscous.T, ground.active.T
    is_dry = jnp.isfinite(ground.dry.T)
    limit = jnp.where(is_dry, ground.dry.T, 0.0) * load[None]
    limit = jnp.where(is_dry, limit, jnp.inf)
    num, num_feet = active.shape[0], scene.feet.shape[-2]
    share = jnp.zeros_like(viscous)
    shift = (jnp.zeros_like(viscous), jnp.zeros_like(viscous))
    if ground.torque_share is not None:
        share = ground.torque_share.T
    if ground.load_shift is not None:
        shift = (ground.load_shift[..., 0].T, ground.load_shift[..., 1].T)

    def each(value: Array) -> Array:
        """Of a slot, for each of its feet: `[slot * foot, body]`."""
        return jnp.repeat(value, num_feet, axis=0)

    def tile(value: Array) -> Array:
        """Of a foot, for each slot."""
        return jnp.tile(value.T, (num, 1))

    feet, part, size = _stance(scene, ground, each, tile)
    c, d = each(viscous) * part, each(limit) * part
    points = _Points(
        x=(1.0 - each(share)) * feet[0] + each(shift[0]),
        y=(1.0 - each(share)) * feet[1] + each(shift[1]),
        heading=jnp.zeros_like(c),
        viscous=(c, c),
        dry=(d, d),
        active=each(active),
        size=(1.0 - each(share)) * size,
    )
    square = part * (feet[0] ** 2 + feet[1] ** 2 + size**2)
    square = jnp.sum(square.reshape(num, num_feet, -1), axis=1)
    arm = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    arm = share * jnp.where(square > 0, arm, 0.0)
    has_arm = arm > 0
    dry = jnp.where(has_arm, limit * jnp.where(has_arm, arm, 1.0), 0.0)
    return points, joint_spin(viscous * arm**2, dry, active)


def _stance(scene: Scene, ground: Ground, each, tile) -> tuple[tuple, Array, Array]:
    """Place of every foot, its share of the load, and its size."""
    feet, part = (tile(scene.feet[..., 0]), tile(scene.feet[..., 1])), scene.foot_load
    size = jnp.zeros_like(part) if scene.foot_size is None else scene.foot_size
    corner = part if scene.corner_load is None else scene.corner_load
    part, size, corner = tile(part), tile(size), tile(corner)
    if ground.corner_share is not None:
        gone = each(ground.corner_share.T)
        part, size = part + gone * (corner - part), (1.0 - gone) * size
    if ground.diagonal_share is not None and scene.diagonal is not None:
        more = 2.0 * each(ground.diagonal_share.T) - 1.0
        part = part * (1.0 + more * tile(scene.diagonal))
    if ground.stance_scale is not None:
        along, across = (each(ground.stance_scale[..., i].T) for i in range(2))
        size = jnp.sqrt(along * across) * size
        axis = scene.stance_axis
        sin, cos = (0.0, 1.0) if axis is None else sincos(axis[None])
        u = along * (cos * feet[0] + sin * feet[1])
        v = across * (cos * feet[1] - sin * feet[0])
        feet = (cos * u - sin * v, sin * u + cos * v)
    return feet, part, size


def friction_points(
    scene: Scene, params: Params, mass: Float[Array, " body"]
) -> tuple[Contact | None, Spin | None]:
    """Every point where friction acts, and every friction against spin.

    Args:
        scene: where the feet stand.
        params: wheels and ground friction.
        mass: mass of every body [kg].

    Returns:
        Contacts and spins `[contact, body]`, without the implicit weights (all one);
        None where there are none.
    """
    parts, spins, has_size = [], None, False
    if params.wheel.active.shape[-1]:
        parts.append(_wheel_points(params.wheel))
    if params.ground.active.shape[-1]:
        feet, torque = _foot_points(scene, params.ground, mass)
        parts.append(feet)
        has_size = scene.foot_size is not None
        spins = None if params.ground.torque_share is None else torque
    if not parts:
        return None, spins
    points = _join(*parts)
    sin, cos = sincos(points.heading)
    # A limit of zero means no friction in that direction.
    c = tuple(
        jnp.where(points.active & (limit > 0), coefficient, 0.0)
        for coefficient, limit in zip(points.viscous, points.dry, strict=True)
    )
    knee = tuple(_over(v, limit) for v, limit in zip(c, points.dry, strict=True))
    one = jnp.ones_like(points.x)
    contact = Contact(
        rolling=(cos, sin, points.x * sin - points.y * cos),
        lateral=(-sin, cos, points.x * cos + points.y * sin),
        viscous=(c[0], c[1]),
        knee=(knee[0], knee[1]),
        weight=(one, one),
        size=points.size if has_size else None,
    )
    return contact, spins


def joint_spin(viscous: Array, dry: Array, active: Array) -> Spin:
    """Friction of a joint against relative spin [N m s/rad], limit [N m]."""
    c = jnp.where(active & (dry > 0), viscous, 0.0)
    return Spin(viscous=c, knee=_over(c, dry), weight=jnp.ones_like(c))


def is_reversed(ratio: tuple, before: tuple) -> Bool[Array, "..."]:
    """Whether Newton's method took a slipping contact beyond rest.

    Beyond, the law bends the other way, and the next step would lead back: where two
    kinks face each other that repeats for ever. Such a contact is taken as sticking for
    one iteration, whose solution then tells on which side it belongs. Of 20,000 random
    hypotheses with decoupled ground torque one in 160 else never converged.

    Args:
        ratio: speeds over those at which the limits are reached, now.
        before: the same in the iteration before.

    Returns:
        Whether it slipped before and moves against its own direction now.
    """
    along = sum(r * b for r, b in zip(ratio, before, strict=True))
    return (along < 0.0) & (sum(b * b for b in before) > 1.0)


def limited(u: tuple, viscous: tuple, knee: tuple, before: tuple | None = None):
    """Scale of the viscous force, and the derivative K of the force.

    Args:
        u: contact velocity, one to three components [m/s].
        viscous: C, as many.
        knee: C over D, as many.
        before: u in the iteration before, if there is one (see `is_reversed`).

    Returns:
        The scale min(1, 1/s), K as rows of entries, and one where the contact is taken
        as sticking for this iteration, else zero: a solution of that is none of the
        problem's.
    """
    ratio = [g * x for g, x in zip(knee, u, strict=True)]
    square = sum(r * r for r in ratio)
    back = jnp.zeros_like(square)
    if before is not None:
        old = [g * x for g, x in zip(knee, before, strict=True)]
        is_back = is_reversed(tuple(ratio), tuple(old))
        square = jnp.where(is_back, 1.0, square)
        back = jnp.where(is_back, 1.0, back)
    is_slip = square > 1.0
    scale = jnp.where(is_slip, 1.0 / jnp.sqrt(jnp.where(is_slip, square, 1.0)), 1.0)
    inverse_square = jnp.where(is_slip, scale * scale, 0.0)
    rows = []
    for i in range(len(u)):
        pull = scale * viscous[i]
        row = [
            -pull * u[i] * knee[j] * ratio[j] * inverse_square for j in range(len(u))
        ]
        row[i] = row[i] + pull
        rows.append(tuple(row))
    return scale, tuple(rows), back
