r"""One substep of a lone body; the stages are those of `step`.

Three frames follow each other by half a turn of the step: the body's at the start, at
mid-step, where impulses act, and at the end, where the pin holds and friction looks.

Bringing poses and twists back onto the pin is closed: the smallest change in kinetic
energy moves the anchor where it belongs and has no momentum about it.
"""

import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.lone_body import LoneBody, Pivot
from boomdp_jax.physics.lone_friction import SlidingProblem, solve_sliding
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.trigonometry import sincos


def lone_substep(body: LoneBody, motion: Motion, force: tuple) -> Motion:
    """Advance by one substep.

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
    middle = motion.theta + (body.facing + half_turn)
    sin, cos = (hold(v, one) for v in sincos(middle))
    sin_half, cos_half = (hold(v, one) for v in sincos(half_turn))
    impulse_x = body.mass * vx + mobile * (h * force[0] + body.weight[0])
    impulse_y = body.mass * vy + mobile * (h * force[1] + body.weight[1])
    push_x = hold(cos * impulse_x + sin * impulse_y, one)
    push_y = hold(cos * impulse_y - sin * impulse_x, one)
    moment = body.inertia * spin + mobile * h * force[2]
    slide_x, slide_y = cos * vx + sin * vy, cos * vy - sin * vx
    # In the body's frame at the start, half a turn before mid-step.
    start_x = cos_half * slide_x - sin_half * slide_y
    start_y = sin_half * slide_x + cos_half * slide_y
    inertia = body.inertia
    if body.pivot is not None:
        x, y = body.pivot.anchor
        start_x, start_y = start_x - y * spin, start_y + x * spin
        moment = moment + y * push_x - x * push_y
        inertia = inertia + body.mass * cos_half * (x * x + y * y)
    problem = SlidingProblem(
        push=(push_x, push_y, hold(moment, one)),
        start=(hold(start_x, one), hold(start_y, one), spin),
        ease=(body.ease, 1.0 / inertia),
        turn=(cos_half, sin_half),
        tracks=body.tracks,
        feet=body.feet,
        brakes=body.brakes,
        joint=body.joint,
    )
    wx, wy, new_spin = solve_sliding(problem, body.stuck, one)
    if body.pivot is not None:
        x, y = body.pivot.anchor
        wx, wy = wx + y * new_spin, wy - x * new_spin
    # From the body's frame at the end to the world's.
    wx, wy = cos_half * wx - sin_half * wy, sin_half * wx + cos_half * wy
    new_vx, new_vy = cos * wx - sin * wy, sin * wx + cos * wy
    moved = Motion(
        hold(motion.x + 0.5 * h * (vx + new_vx), one),
        hold(motion.y + 0.5 * h * (vy + new_vy), one),
        hold(motion.theta + 0.5 * h * (spin + new_spin), one),
        hold(new_vx, one),
        hold(new_vy, one),
        hold(new_spin, one),
    )
    if body.pivot is None:
        return moved
    return _project(body.pivot, body.facing, moved, one)


def _project(
    pivot: Pivot, facing: FloatScalar, motion: Motion, one: FloatScalar
) -> Motion:
    """Bring the pose, then the twist, back onto the pin."""
    x, y = pivot.anchor
    sin, cos = (hold(v, one) for v in sincos(motion.theta + facing))
    dx, dy, dtheta = _level(pivot, *_offset(pivot, motion, sin, cos), one)
    theta = hold(motion.theta + dtheta, one)
    position = (motion.x + cos * dx - sin * dy, motion.y + sin * dx + cos * dy)
    sin, cos = (hold(v, one) for v in sincos(theta + facing))
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


def _offset(pivot: Pivot, motion: Motion, sin, cos) -> tuple:
    """How far off the anchor is, body's frame [m]; zero if inactive."""
    dx, dy = motion.x - pivot.world[0], motion.y - pivot.world[1]
    on, (x, y) = pivot.active, pivot.anchor
    return on * (cos * dx + sin * dy) + x, on * (cos * dy - sin * dx) + y


def _level(pivot: Pivot, off_x, off_y, one: FloatScalar) -> tuple:
    """Change of pose or twist that moves the anchor by minus an offset."""
    x, y = pivot.anchor
    off_x, off_y = (hold(pivot.mobile * off, one) for off in (off_x, off_y))
    turn = hold(pivot.levelling * (y * off_x - x * off_y), one)
    return y * turn - off_x, -x * turn - off_y, turn


def lone_error(body: LoneBody, motion: Motion) -> FloatScalar:
    """Squared distance by which the pin fails to hold [m²]; zero without one."""
    if body.pivot is None:
        return jnp.zeros_like(motion.x)
    sin, cos = sincos(motion.theta + body.facing)
    x, y = _offset(body.pivot, motion, sin, cos)
    return x * x + y * y
