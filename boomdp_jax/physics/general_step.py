"""A substep of a world of any number of bodies and joints, without contact.

The stages are those of `step`. Numbers are arrays over bodies; every one that several
others read is held, lest the compiler work it out again in each of them.
"""

import jax
import jax.numpy as jnp

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.joints import Frames, Row, joint_rows
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.projection import compliance_of, ease_between, project
from boomdp_jax.physics.trigonometry import sincos
from boomdp_jax.physics.velocity_solve import Twist, VelocityProblem, solve_velocity

# Most that a row may change from mid-step to the end of a substep, squared and relative
# in the metric of the masses: as much as a lever that turns by a quarter of a radian.
_MOST_CHANGE = 0.06


def velocity_problem(
    prepared: Prepared, motion: Motion, force: tuple
) -> tuple[VelocityProblem, tuple]:
    """Set up the search for the twists at the end of a substep.

    Args:
        prepared: what does not depend on the state.
        motion: at the start.
        force: world frame, at the centres of mass [N, N, N m].

    Returns:
        The problem, and cosine and sine of the frames at mid-step.
    """
    h, mobile = prepared.length, prepared.mobile
    mass, inertia = prepared.mass, prepared.inertia
    vx, vy, spin = (mobile * v for v in motion[3:])
    one = runtime_one(mass)

    def held(values):
        return jax.tree.map(lambda v: hold(v, one), values)

    half_turn = 0.5 * h * spin
    sin, cos = held(sincos(motion.theta + half_turn))
    start = held((cos * vx + sin * vy, cos * vy - sin * vx, spin))
    push_x = mobile * (h * force[0] + prepared.weight[0])
    push_y = mobile * (h * force[1] + prepared.weight[1])
    momentum = held(
        (
            mass * start[0] + cos * push_x + sin * push_y,
            mass * start[1] + cos * push_y - sin * push_x,
            inertia * spin + mobile * h * force[2],
        )
    )
    sin_half, cos_half = held(sincos(half_turn))
    rows_mid, rows_end, compliance = [], [], []
    if prepared.slots:
        middle = Frames(motion.x + 0.5 * h * vx, motion.y + 0.5 * h * vy, cos, sin)
        end = Frames(
            motion.x + h * vx, motion.y + h * vy, cos, sin, (cos_half, sin_half)
        )
        rows_mid = joint_rows(prepared.slots, middle)
        rows_end = [
            _steadied(prepared, *rows)
            for rows in zip(rows_mid, joint_rows(prepared.slots, end), strict=True)
        ]
        compliance = compliance_of(prepared, rows_mid)
    problem = VelocityProblem(
        mobile=mobile,
        mass=mass,
        inertia=inertia,
        momentum=momentum,
        start=start,
        turn=(cos_half, sin_half),
        contacts=prepared.contacts,
        spins=prepared.spins,
        rows_mid=rows_mid,
        rows_end=rows_end,
        compliance=compliance,
        joint_spins=prepared.joint_spins,
    )
    return problem, (cos, sin)


def _steadied(prepared: Prepared, mid: Row, end: Row) -> Row:
    """The row at the end of the substep, or at mid-step if it turns too far.

    Impulses act along one and joints hold along the other. As long as both are alike
    that is of second order; when they are not (a fast spin, a short rod) the system may
    be anything but positive, and give energy.
    """
    at_mid, at_end = (ease_between(prepared, row, row) for row in (mid, end))
    change = at_mid + at_end - 2.0 * ease_between(prepared, mid, end)
    is_steady = change <= _MOST_CHANGE * at_mid

    def choose(yes, no):
        return jnp.where(is_steady, yes, no)

    jb = None
    if mid.jb is not None and end.jb is not None:
        jb = tuple(choose(e, m) for e, m in zip(end.jb, mid.jb, strict=True))
    ja = tuple(choose(e, m) for e, m in zip(end.ja, mid.ja, strict=True))
    return end._replace(ja=ja, jb=jb)


def general_substep(prepared: Prepared, motion: Motion, force: tuple) -> Motion:
    """Advance by one substep.

    Args:
        prepared: what does not depend on the state.
        motion: at the start.
        force: world frame, at the centres of mass [N, N, N m].

    Returns:
        The motion at the end.
    """
    problem, (cos, sin) = velocity_problem(prepared, motion, force)
    twist = held_twist(prepared, solve_velocity(problem).twist)
    moved = moved_by(prepared, motion, to_world(twist, cos, sin))
    return project(prepared, moved) if prepared.slots else moved


def held_twist(prepared: Prepared, twist: Twist) -> Twist:
    """A twist that is worked out once."""
    one = runtime_one(prepared.mass)
    x, y, spin = (hold(v, one) for v in twist)
    return x, y, spin


def to_world(twist: Twist, cos, sin) -> Twist:
    """From frames given by cosine and sine to the world's."""
    x, y, spin = twist
    return cos * x - sin * y, sin * x + cos * y, spin


def moved_by(prepared: Prepared, motion: Motion, twist: Twist) -> Motion:
    """Move with the mean of old and new twist."""
    half, mobile = 0.5 * prepared.length, prepared.mobile
    vx, vy, spin = (mobile * v for v in motion[3:])
    one = runtime_one(prepared.mass)
    moved = Motion(
        motion.x + half * (vx + twist[0]),
        motion.y + half * (vy + twist[1]),
        motion.theta + half * (spin + twist[2]),
        *twist,
    )
    return jax.tree.map(lambda v: hold(v, one), moved)
