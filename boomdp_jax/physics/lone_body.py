r"""One body with at most one pin and no rod: coordinates in which its mass is diagonal.

The most frequent scene by far, and the one whose speed decides how long inference
takes. With r the anchor in the body frame at mid-step and r' the anchor at the end of
the step (half a turn of the step further), describe a twist by the velocity s of the
anchor at the end and by the spin $\omega$, and balance momentum about the anchor at
mid-step:

$$w = (s_x + r'_y\omega,\; s_y - r'_x\omega,\; \omega), \qquad
  P = (p_x,\; p_y,\; p_\omega + r_y p_x - r_x p_y).$$

The pin's impulse drops out of the third balance and its constraint is $s = 0$, so
$s = l\,(P_x, P_y)$ with l = 0 and $\omega = g\,P_\omega$ with
$g = 1/(m\,r \cdot r' + I)$. Without a pin r = 0, l = 1/m and g = 1/I say the same of a
free body: one code for both, no elimination of joint rows, and no softness to keep
redundant rows solvable.

Bringing poses and twists back onto the pin is closed as well: the smallest change in
kinetic energy moves the anchor where it belongs and has no momentum about it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.friction import Contact, Spin
from boomdp_jax.physics.joints import Slot
from boomdp_jax.physics.lone_friction import Brake, Drag, SlidingProblem, solve_sliding
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.trigonometry import sincos

Pair = tuple[FloatScalar, ...]


class Pivot(NamedTuple):
    """The pin, with zeros (except where it is in the world) if it is inactive."""

    active: FloatScalar
    anchor: Pair
    """r: anchor in the body frame [m]."""
    world: Pair
    """Where it is to be [m]."""
    mobile: FloatScalar
    """One if it is active and its body can move."""
    levelling: FloatScalar
    """Turn that puts right an anchor off by one metre at a lever of one [rad/m²]."""


class LoneContact(NamedTuple):
    """A contact in scalars; see `friction.Contact`."""

    rolling: Pair
    lateral: Pair
    lever: Pair
    """Rolling and lateral velocity per spin about the centre of mass [m]."""
    arm: Pair
    """The same about the anchor [m]."""
    viscous: Pair
    knee: Pair
    weight: Pair


class LoneBody(NamedTuple):
    """What depends on scene, params and step length alone, out of the time loop."""

    length: FloatScalar
    mobile: FloatScalar
    mass: FloatScalar
    inertia: FloatScalar
    weight: Pair
    """Impulse of gravity over a step [N s]."""
    ease: FloatScalar
    """l: velocity of the anchor per impulse [1/kg]."""
    contacts: list[LoneContact]
    torques: list[Spin]
    """Friction against spin, from the floor."""
    joint: Spin | None
    """Friction of the pin."""
    pivot: Pivot | None


def lone_body(
    length: FloatScalar,
    mobile: FloatScalar,
    mass: FloatScalar,
    inertia: FloatScalar,
    weight: Pair,
    contacts: Contact | None,
    spins: Spin | None,
    pins: list[Slot],
) -> LoneBody:
    """Prepare a body for its time loop.

    Args:
        length: of the step [s].
        mobile: one, or zero if the body is static.
        mass: of the body [kg].
        inertia: about the centre of mass [kg m²].
        weight: impulse of gravity over a step [N s].
        contacts: points of friction, fitted (`friction.fit_weights`).
        spins: frictions against spin, fitted; the pin's last.
        pins: none or one.

    Returns:
        All that the time loop needs, each number computed once.
    """
    zero, pivot, ease = jnp.zeros_like(mass), None, mobile / mass
    anchor = (zero, zero)
    if pins:
        (pin,) = pins
        anchor = (pin.active * pin.anchor_a[0], pin.active * pin.anchor_a[1])
        square = anchor[0] ** 2 + anchor[1] ** 2
        levelling = pin.active * mobile * mass / (mass * square + inertia)
        pivot = Pivot(pin.active, anchor, pin.anchor_b, pin.active * mobile, levelling)
        ease = (1.0 - pin.active) * ease
    torques = [] if spins is None else _parts(spins)
    body = LoneBody(
        length=length,
        mobile=mobile,
        mass=mass,
        inertia=inertia,
        weight=weight,
        ease=ease,
        contacts=[
            _lone_contact(part, anchor)
            for part in ([] if contacts is None else _parts(contacts))
        ],
        torques=torques[: len(torques) - len(pins)],
        joint=torques[-1] if pins else None,
        pivot=pivot,
    )
    one = runtime_one(mass)
    return jax.tree.map(lambda leaf: leaf if leaf is length else hold(leaf, one), body)


def _parts(stacked):
    num = jax.tree.leaves(stacked)[0].shape[0]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(num)]


def _lone_contact(contact: Contact, anchor: Pair) -> LoneContact:
    rows = (contact.rolling, contact.lateral)
    return LoneContact(
        rolling=contact.rolling[:2],
        lateral=contact.lateral[:2],
        lever=tuple(row[2] for row in rows),
        arm=tuple(row[2] + anchor[1] * row[0] - anchor[0] * row[1] for row in rows),
        viscous=contact.viscous,
        knee=contact.knee,
        weight=contact.weight,
    )


def lone_substep(body: LoneBody, motion: Motion, force: tuple) -> Motion:
    """Advance by one substep; the stages are those of `step`.

    Args:
        body: what is prepared.
        motion: before.
        force: world frame, at the centre of mass [N, N, N m].

    Returns:
        The motion after the substep.
    """
    h, mobile, one = body.length, body.mobile, runtime_one(body.mass)
    vx, vy, spin = (mobile * v for v in motion[3:])
    half_turn = 0.5 * h * spin
    sin, cos = (hold(v, one) for v in sincos(motion.theta + half_turn))
    turn = tuple(hold(v, one) for v in sincos(half_turn))
    impulse_x = body.mass * vx + mobile * (h * force[0] + body.weight[0])
    impulse_y = body.mass * vy + mobile * (h * force[1] + body.weight[1])
    momentum = (
        hold(cos * impulse_x + sin * impulse_y, one),
        hold(cos * impulse_y - sin * impulse_x, one),
        body.inertia * spin + mobile * h * force[2],
    )
    start = (hold(cos * vx + sin * vy, one), hold(cos * vy - sin * vx, one), spin)
    problem = _sliding_problem(body, momentum, start, turn, one)
    wx, wy, new_spin = solve_sliding(problem, one)
    if body.pivot is not None:
        (x, y), (sin_half, cos_half) = body.pivot.anchor, turn
        wx, wy = (
            wx + (sin_half * x + cos_half * y) * new_spin,
            wy - (cos_half * x - sin_half * y) * new_spin,
        )
    new_vx, new_vy = cos * wx - sin * wy, sin * wx + cos * wy
    moved = Motion(
        hold(motion.x + 0.5 * h * (vx + new_vx), one),
        hold(motion.y + 0.5 * h * (vy + new_vy), one),
        hold(motion.theta + 0.5 * h * (spin + new_spin), one),
        hold(new_vx, one),
        hold(new_vy, one),
        new_spin,
    )
    return moved if body.pivot is None else _project(body.pivot, moved, one)


def _sliding_problem(
    body: LoneBody, momentum: tuple, start: tuple, turn: Pair, one: FloatScalar
) -> SlidingProblem:
    """Friction and momentum in terms of the anchor's velocity and the spin."""
    sin, cos = turn
    # The velocity at the start in the frame half a turn earlier, where wheels were.
    early = (cos * start[0] - sin * start[1], sin * start[0] + cos * start[1])
    drags = []
    for contact in body.contacts:
        rows = (contact.rolling, contact.lateral)
        drags.append(
            Drag(
                force=tuple(
                    (*row, arm) for row, arm in zip(rows, contact.arm, strict=True)
                ),
                # The contact's directions at the end, half a turn later.
                speed=tuple(
                    (
                        share * (cos * row[0] - sin * row[1]),
                        share * (sin * row[0] + cos * row[1]),
                        share * arm,
                    )
                    for row, arm, share in zip(
                        rows, contact.arm, contact.weight, strict=True
                    )
                ),
                drift=tuple(
                    (1.0 - share)
                    * (row[0] * early[0] + row[1] * early[1] + lever * start[2])
                    for row, lever, share in zip(
                        rows, contact.lever, contact.weight, strict=True
                    )
                ),
                viscous=contact.viscous,
                knee=contact.knee,
            )
        )
    drags = jax.tree.map(lambda v: hold(v, one), drags) if len(drags) > 1 else drags
    push, inertia = momentum, body.inertia
    if body.pivot is not None:
        x, y = body.pivot.anchor
        lever = momentum[2] + y * momentum[0] - x * momentum[1]
        push = (momentum[0], momentum[1], lever)
        inertia = inertia + body.mass * cos * (x * x + y * y)
    return SlidingProblem(
        push=push,
        ease=(body.ease, 1.0 / inertia),
        drags=drags,
        brakes=[_brake(torque, start[2]) for torque in body.torques],
        joint=None if body.joint is None else _brake(body.joint, start[2]),
    )


def _brake(spin: Spin, start: FloatScalar) -> Brake:
    drift = (1.0 - spin.weight) * start
    return Brake(spin.weight, drift, spin.viscous, spin.knee)


def _project(pivot: Pivot, motion: Motion, one: FloatScalar) -> Motion:
    """Bring the pose, then the twist, back onto the pin."""
    x, y = pivot.anchor
    sin, cos = (hold(v, one) for v in sincos(motion.theta))
    dx, dy, dtheta = _level(pivot, *_offset(pivot, motion, sin, cos), one)
    theta = hold(motion.theta + dtheta, one)
    position = (motion.x + cos * dx - sin * dy, motion.y + sin * dx + cos * dy)
    sin, cos = (hold(v, one) for v in sincos(theta))
    slide_x = cos * motion.vx + sin * motion.vy - y * motion.spin
    slide_y = cos * motion.vy - sin * motion.vx + x * motion.spin
    dx, dy, dspin = _level(pivot, slide_x, slide_y, one)
    return Motion(
        hold(position[0], one),
        hold(position[1], one),
        theta,
        hold(motion.vx + cos * dx - sin * dy, one),
        hold(motion.vy + sin * dx + cos * dy, one),
        hold(motion.spin + dspin, one),
    )


def _offset(pivot: Pivot, motion: Motion, sin, cos) -> Pair:
    """How far off the anchor is, body frame [m]; zero if inactive."""
    dx, dy = motion.x - pivot.world[0], motion.y - pivot.world[1]
    on, (x, y) = pivot.active, pivot.anchor
    return on * (cos * dx + sin * dy) + x, on * (cos * dy - sin * dx) + y


def _level(pivot: Pivot, off_x, off_y, one: FloatScalar) -> tuple:
    """Change of pose or twist that moves the anchor by minus an offset."""
    x, y = pivot.anchor
    off_x, off_y = (hold(pivot.mobile * off, one) for off in (off_x, off_y))
    turn = hold(pivot.levelling * (y * off_x - x * off_y), one)
    return y * turn - off_x, -x * turn - off_y, turn


def lone_error(pivot: Pivot, motion: Motion) -> FloatScalar:
    """Squared distance by which the pin fails to hold [m²]."""
    sin, cos = sincos(motion.theta)
    x, y = _offset(pivot, motion, sin, cos)
    return x * x + y * y
