r"""One step of a lone body; the stages are those of `step`.

Before its substeps a step brings an inconsistent pose onto the pin. After that a
pinned body only turns: where it is follows from its heading, and how it moves from its
spin, so nothing drifts and nothing has to be put right. Both are written for every
body, with zeros where there is no pin.

Frames are those of the body, turned to its first wheel: at the start of a substep, at
mid-step, where impulses act, and at the end, where the pin holds and friction looks.
Each is carried as cosine and sine and follows from the one before by a small rotation;
sine and cosine proper are taken once a step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.lone_body import LoneBody, Pivot
from boomdp_jax.physics.lone_contacts import Pair, into, out_of
from boomdp_jax.physics.lone_friction import SlidingProblem, solve_sliding
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.trigonometry import heading_turn, rotated


class _Turned(NamedTuple):
    """A motion, and cosine and sine of its (turned) frame."""

    motion: Motion
    turn: Pair


def lone_step(
    body: LoneBody, motion: Motion, force: tuple, num_substeps: int
) -> Motion:
    """Advance by one step.

    Args:
        body: what is prepared.
        motion: before.
        force: world frame, at the centre of mass [N, N, N m].
        num_substeps: how many the step is made of.

    Returns:
        The motion after the step.
    """
    h, mobile, one = body.length, body.mobile, runtime_one(body.mass)
    impulse = (
        hold(mobile * (h * force[0] + body.weight[0]), one),
        hold(mobile * (h * force[1] + body.weight[1]), one),
        hold(mobile * h * force[2], one),
    )
    motion = motion._replace(
        vx=mobile * motion.vx, vy=mobile * motion.vy, spin=mobile * motion.spin
    )
    turned = _Turned(motion, heading_turn(motion.theta + body.facing))
    if body.pivot is not None:
        turned = _levelled(body.pivot, turned, one)
    if num_substeps == 1:
        return _substep(body, turned, impulse).motion
    turned, _ = jax.lax.scan(
        lambda now, _: (_substep(body, now, impulse), None),
        turned,
        None,
        length=num_substeps,
        # Two at a time: a fifth less for a gradient, the same for a motion.
        unroll=2,
    )
    return turned.motion


def _levelled(pivot: Pivot, turned: _Turned, one: FloatScalar) -> _Turned:
    """Bring a pose onto the pin by the smallest change in the sense of its mass."""
    motion, turn = turned
    x, y = pivot.anchor
    off_x, off_y = _offset(pivot, motion, turn)
    angle = hold(pivot.levelling * (y * off_x - x * off_y), one)
    # Where it is follows from the heading.
    return _Turned(motion._replace(theta=motion.theta + angle), rotated(turn, angle))


def _offset(pivot: Pivot, motion: Motion, turn: Pair) -> Pair:
    """How far off the anchor is, body's frame [m]; zero if inactive."""
    x, y = into(turn, motion.x - pivot.world[0], motion.y - pivot.world[1])
    return pivot.active * x + pivot.anchor[0], pivot.active * y + pivot.anchor[1]


def _substep(body: LoneBody, turned: _Turned, impulse: tuple) -> _Turned:
    h, one = body.length, runtime_one(body.mass)
    motion, start = turned
    vx, vy, spin = motion[3:]
    half = rotated(None, 0.5 * h * spin)
    middle = out_of(start, *half)
    px, py = body.mass * vx + impulse[0], body.mass * vy + impulse[1]
    push_x, push_y = (hold(v, one) for v in into(middle, px, py))
    moment = body.inertia * spin + impulse[2]
    slide_x, slide_y = into(start, vx, vy)
    inertia = body.inertia
    if body.pivot is not None:
        x, y = body.pivot.anchor
        slide_x, slide_y = slide_x - y * spin, slide_y + x * spin
        moment = moment + y * push_x - x * push_y
        inertia = inertia + body.mass * half[0] * (x * x + y * y)
    problem = SlidingProblem(
        push=(push_x, push_y, moment),
        start=(slide_x, slide_y, spin),
        ease=(body.ease, inertia),
        turn=half,
        tracks=body.tracks,
        feet=body.feet,
        brakes=body.brakes,
        joint=body.joint,
    )
    slide_x, slide_y, new_spin = solve_sliding(problem, body.stuck, one)
    new_vx, new_vy = out_of(middle, slide_x, slide_y)
    angle = 0.5 * h * (spin + new_spin)
    end = rotated(start, angle)
    new_x = motion.x + 0.5 * h * (vx + new_vx)
    new_y = motion.y + 0.5 * h * (vy + new_vy)
    if body.pivot is not None:
        pivot = body.pivot
        arm_x, arm_y = out_of(end, *pivot.anchor)
        new_vx, new_vy = new_vx + new_spin * arm_y, new_vy - new_spin * arm_x
        new_x = pivot.free * new_x + pivot.place[0] - arm_x
        new_y = pivot.free * new_y + pivot.place[1] - arm_y
    moved = Motion(new_x, new_y, motion.theta + angle, new_vx, new_vy, new_spin)
    return _Turned(moved, end)


def lone_error(body: LoneBody, motion: Motion) -> FloatScalar:
    """Squared distance by which the pin fails to hold [m²]; zero without one."""
    if body.pivot is None:
        return jnp.zeros_like(motion.x)
    one = runtime_one(body.mass)
    turn = heading_turn(motion.theta + body.facing)
    x, y = (hold(v, one) for v in _offset(body.pivot, motion, turn))
    return x * x + y * y
