r"""One body with at most one pin and no rod: coordinates in which its mass is diagonal.

The most frequent scene by far, and the one whose speed decides how long inference
takes. With r the anchor in the body frame at mid-step and r' the anchor at the end of
the step (half a turn of the step further), describe a twist by the velocity s of the
anchor at the end and by the spin $\omega$, and balance momentum about the anchor at
mid-step:

$$w = (s_x + r'_y\omega,\; s_y - r'_x\omega,\; \omega), \qquad
  P = (p_x,\; p_y,\; p_\omega + r_y p_x - r_x p_y).$$

The pin's impulse drops out of the third balance and its constraint is $s = 0$, so
$s = l\,(P_x, P_y)$ with l = 0 and $\omega = g\,P_\omega$. Momentum that turns with the
body has all of its moment about the pin in whatever frame, where this balance of two
frames has $g = 1/(m\,r \cdot r' + I)$: so $g = 1/(m\,r^2 + I)$, and in $P_\omega$
the body's own momentum counts as $\omega/g$ and an impulse as `lone_step` says. Without
a pin r = 0, l = 1/m and g = 1/I say the same of a free body: one code for both, no
elimination of joint rows, and no softness to keep redundant rows solvable.

The frame that is called the body's here is turned to the heading of its first wheel:
that wheel then needs no rotation, and feet, which rub alike in every direction, never
do. All that does not change from step to step is worked out here.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.friction import Contact, Spin
from boomdp_jax.physics.implicit_fit import Groups
from boomdp_jax.physics.lone_contacts import Feet, Pair, Track, into, turned
from boomdp_jax.physics.lone_friction import Brake, Stuck
from boomdp_jax.physics.lone_wheel import Grip, grip


class Pin(NamedTuple):
    """A revolute slot of a lone body, which pins it to the world."""

    active: FloatScalar
    """One or zero."""
    anchor_a: Pair
    anchor_b: Pair


class Pivot(NamedTuple):
    """The pin, with zeros (except where it is in the world) if it is inactive."""

    active: FloatScalar
    anchor: Pair
    """r: anchor in the body's (turned) frame [m]."""
    world: Pair
    """Where it is to be [m]."""
    place: Pair
    """The same; zero if inactive."""
    free: FloatScalar
    """One if it is inactive, else zero."""
    levelling: FloatScalar
    """Turn that puts right an anchor off by one metre at a lever of one [rad/m²]."""
    inertia: FloatScalar
    """1/g: about the pin, or about the centre of mass if it is inactive [kg m²]."""
    ease: FloatScalar
    """Its inverse."""


class LoneBody(NamedTuple):
    """What depends on scene, params and step length alone, out of the time loop."""

    length: FloatScalar
    mobile: FloatScalar
    mass: FloatScalar
    inertia: FloatScalar
    weight: Pair
    """Impulse of gravity over a step [N s]."""
    facing: FloatScalar
    """Heading of the first wheel [rad], of which "the body's frame" is turned."""
    ease: FloatScalar
    """l: velocity of the anchor per impulse [1/kg]."""
    tracks: list[Track]
    feet: list[Feet]
    brakes: list[Brake]
    """Friction against spin, from the floor."""
    joint: Brake | None
    """Friction of the pin."""
    aid: Stuck | Grip | None
    """What helps to solve for friction: the grip of the pin where at most one contact
    and no torque from the floor act."""
    pivot: Pivot | None


def lone_body(
    length: FloatScalar,
    mobile: FloatScalar,
    mass: FloatScalar,
    inertia: FloatScalar,
    weight: Pair,
    contacts: Contact | None,
    groups: Groups,
    facing: FloatScalar,
    spins: Spin | None,
    pins: list[Pin],
) -> LoneBody:
    """Prepare a body for its time loop.

    Args:
        length: of the step [s].
        mobile: one, or zero if the body is static.
        mass: of the body [kg].
        inertia: about the centre of mass [kg m²].
        weight: impulse of gravity over a step [N s].
        contacts: points of friction, fitted (`implicit_fit.fit_weights`).
        groups: which of them belong together.
        facing: heading of the first wheel, zero where there is none [rad].
        spins: frictions against spin, fitted; the pin's last.
        pins: none or one.

    Returns:
        All that the time loop needs.
    """
    zero, pivot, ease = jnp.zeros_like(mass), None, mobile / mass
    axis = None
    if groups.num_wheels:
        assert contacts is not None
        axis = (contacts.rolling[0][0], contacts.rolling[1][0])
    anchor = turned_anchor = (zero, zero)
    if pins:
        (pin,) = pins
        on = pin.active * mobile
        anchor = (on * pin.anchor_a[0], on * pin.anchor_a[1])
        turned_anchor = into(axis, *anchor)
        whole = inertia + mass * (anchor[0] ** 2 + anchor[1] ** 2)
        ease_of_spin = 1.0 / whole
        pivot = Pivot(
            active=pin.active,
            anchor=turned_anchor,
            world=pin.anchor_b,
            place=(on * pin.anchor_b[0], on * pin.anchor_b[1]),
            free=1.0 - on,
            levelling=on * mass * ease_of_spin,
            inertia=whole,
            ease=ease_of_spin,
        )
        ease = (1.0 - on) * ease
    parts = [] if contacts is None else _parts(contacts)
    num_wheels = groups.num_wheels * groups.num_sides
    tracks = [
        _track(parts[slot : num_wheels : groups.num_wheels], anchor, axis, slot == 0)
        for slot in range(groups.num_wheels)
    ]
    feet = [
        _feet(parts[first : first + groups.num_feet], anchor, axis)
        for first in range(num_wheels, len(parts), groups.num_feet)
    ]
    brakes = [Brake(*spin) for spin in ([] if spins is None else _parts(spins))]
    floor = brakes[: len(brakes) - len(pins)]
    aid = grip(brakes[-1]) if pins else None
    if len(parts) > 1 or floor:
        aid = _stuck(tracks, feet, brakes, zero)
    return LoneBody(
        length=length,
        mobile=mobile,
        mass=mass,
        inertia=inertia,
        weight=weight,
        facing=facing,
        ease=ease,
        tracks=tracks,
        feet=feet,
        brakes=floor,
        joint=brakes[-1] if pins else None,
        aid=jax.lax.stop_gradient(aid),
        pivot=pivot,
    )


def _parts(stacked):
    num = jax.tree.leaves(stacked)[0].shape[0]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(num)]


def _track(
    wheels: list[Contact], anchor: Pair, axis: Pair | None, is_first: bool
) -> Track:
    """Contacts of one wheel slot."""

    def arm(row):
        return row[2] + anchor[1] * row[0] - anchor[0] * row[1]

    wheel = wheels[0]
    return Track(
        heading=None if is_first else into(axis, *wheel.rolling[:2]),
        reach=[arm(wheel.rolling) for wheel in wheels],
        lead=arm(wheel.lateral),
        viscous=wheel.viscous,
        knee=wheel.knee,
        share=wheel.weight,
    )


def _feet(feet: list[Contact], anchor: Pair, axis: Pair | None) -> Feet:
    """Contacts of one ground slot; feet without load have no limits to tell of."""
    knee = feet[0].knee[0]
    for foot in feet[1:]:
        knee = jnp.maximum(knee, foot.knee[0])
    return Feet(
        arms=[
            into(axis, foot.rolling[2] + anchor[1], foot.lateral[2] - anchor[0])
            for foot in feet
        ],
        sizes=[
            jnp.zeros_like(foot.viscous[0]) if foot.size is None else foot.size
            for foot in feet
        ],
        viscous=[foot.viscous[0] for foot in feet],
        knee=knee,
        share=feet[0].weight[0],
    )


def _stuck(
    tracks: list[Track], feet: list[Feet], brakes: list[Brake], zero: FloatScalar
) -> Stuck:
    """Sum over everything that rubs."""
    end, start = [zero] * 9, [zero] * 9

    def add(heading, c, d, p, q, shares):
        for total, (w, z) in ((end, shares), (start, [1.0 - s for s in shares])):
            f, g = c * w, d * z
            part = (f, zero, f * p, zero, g, g * q, f * p, g * q, f * p * p + g * q * q)
            part = turned(heading, part)
            total[:] = [a + b for a, b in zip(total, part, strict=True)]

    for track in tracks:
        for reach in track.reach:
            add(track.heading, *track.viscous, reach, track.lead, track.share)
    for patch in feet:
        share = patch.share
        for (p, q), g, c in zip(patch.arms, patch.sizes, patch.viscous, strict=True):
            add(None, c, c, p, q, (share, share))
            end[8] = end[8] + c * g * g * share
            start[8] = start[8] + c * g * g * (1.0 - share)
    for brake in brakes:
        end[8] = end[8] + brake.viscous * brake.share
        start[8] = start[8] + brake.viscous * (1.0 - brake.share)
    return Stuck(*(tuple(v[i] for i in (0, 1, 2, 4, 5, 8)) for v in (end, start)))
