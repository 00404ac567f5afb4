"""A substep of a world of any number of bodies and joints, without contact.

The stages are those of `step`. All arrays are in lanes (`core.lanes`).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.energy_limit import Doubts, limited_energy
from boomdp_jax.physics.friction import Spin
from boomdp_jax.physics.joints import (
    Frames,
    bilateral_rows,
    join,
    moved_end,
    of_body,
    on_bodies,
)
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Drive, Prepared
from boomdp_jax.physics.projection import drive_rows, mobility, project
from boomdp_jax.physics.row_algebra import (
    PerBody,
    PerRow,
    Tied,
    ease_of,
    per_row,
    speed,
    tied,
    with_arms,
)
from boomdp_jax.physics.trigonometry import rotated, sincos
from boomdp_jax.physics.velocity_search import solve_velocity
from boomdp_jax.physics.velocity_solve import Laws, Limits, VelocityProblem

# Most that a row may change from mid-step to the end of a substep, squared and relative
# in the metric of the masses: as much as a lever that turns by a quarter of a radian.
_MOST_CHANGE = 0.06
# Turn [rad] of a body in a substep from which its joints and wheels are not right.
_MOST_TURN = 0.4


def velocity_problem(
    prepared: Prepared, motion: Motion, force: tuple
) -> VelocityProblem:
    """Set up the search for the twists at the end of a substep.

    Args:
        prepared: what does not depend on the state.
        motion: at the start.
        force: world frame, at the centres of mass [N, N, N m].

    Returns:
        The problem.
    """
    h, mobile = prepared.length[None], prepared.mobile
    mass, inertia = prepared.mass, prepared.inertia
    vx, vy, spin = (mobile * v for v in motion[3:])
    one = runtime_one(mass)

    def held(values):
        return jax.tree.map(lambda v: hold(v, one), values)

    momentum = held(
        (
            mass * vx + mobile * (h * force[0] + prepared.weight[0]),
            mass * vy + mobile * (h * force[1] + prepared.weight[1]),
            inertia * spin + mobile * h * force[2],
        )
    )
    half_turn = 0.5 * h * spin
    sin, cos = sincos(motion.theta + half_turn)
    turn = rotated(None, half_turn)
    cos, sin, turn = held((cos, sin, turn))
    push = arms_end = ease = is_steady = None
    x, y, theta = motion[:3]
    middle = Frames(x + 0.5 * h * vx, y + 0.5 * h * vy, theta + half_turn, cos, sin)
    middle = held(middle)
    rows_mid = bilateral_rows(prepared.joints, middle)
    if rows_mid is not None:
        (tc, ts) = turn
        end = Frames(
            x + h * vx,
            y + h * vy,
            theta + h * spin,
            tc * cos - ts * sin,
            tc * sin + ts * cos,
        )
        rows_end = bilateral_rows(prepared.joints, held(end))
        assert rows_end is not None
        push, arms_end = (tied(rows, mass.shape[0]) for rows in (rows_mid, rows_end))
        ease = ease_of(push, *mobility(prepared))
        arms_end, is_steady = _steadied(prepared, push, ease, arms_end)
    laws, limits = _drives(prepared, middle, (vx, vy, spin))
    further = [part.rows for part in (laws, limits) if part is not None]
    return VelocityProblem(
        mobile=mobile,
        mass=mass,
        inertia=inertia,
        momentum=momentum,
        start=held((vx, vy, spin)),
        frame=(cos, sin),
        turn=turn,
        contacts=prepared.contacts,
        spins=prepared.spins,
        push=join(push, *further),
        end=join(arms_end, *further),
        rows_mid=rows_mid,
        ease=ease,
        is_steady=is_steady,
        laws=laws,
        limits=limits,
    )


def _steadied(
    prepared: Prepared, mid: Tied, ease: PerRow, end: Tied
) -> tuple[Tied, Bool[Array, "row lane"]]:
    """The rows at the end of the substep, or at mid-step where they turn too far.

    And which do not.

    Impulses act along one and joints hold along the other. As long as both are alike
    that is of second order; when they are not (a fast spin, a short rod) the system may
    be anything but positive, and give energy.
    """
    change = ease_of(with_arms(jnp.subtract, end, mid), *mobility(prepared))
    is_steady = change <= _MOST_CHANGE * ease
    chosen = per_row(is_steady, mid)
    steadied = with_arms(lambda new, old: jnp.where(chosen, new, old), end, mid)
    return steadied, is_steady


def _drives(
    prepared: Prepared, middle: Frames, start: tuple
) -> tuple[Laws | None, Limits | None]:
    """What acts along the coordinates that joints leave free."""
    laws, limits = [], []
    for drive, row in drive_rows(prepared, middle):
        rows = tied(row, prepared.mass.shape[0])
        moving = speed(rows, start)
        end = moved_end(row, prepared.mobile)
        for spin, target in ((drive.friction, None), (drive.motor, drive.target)):
            if spin is not None:
                aim = jnp.zeros_like(moving) if target is None else target
                laws.append(Laws(rows, Spin(*spin), moving, aim, end))
        if drive.lower is not None:
            limits.append(_range(prepared, drive, rows, row.error, moving))
    return join(*laws), join(*limits)


def _range(
    prepared: Prepared, drive: Drive, rows: Tied, middle: PerRow, moving: PerRow
) -> Limits:
    """Speeds at which the ends of a range are met as the substep ends.

    Where the range is left already (a projection puts that right) it is not left
    further.
    """
    length = prepared.length[None]
    # From the coordinate at mid-step.
    place = middle - 0.5 * length * moving
    lower: Any = drive.lower
    upper: Any = drive.upper
    return Limits(
        rows,
        jnp.minimum((lower - place) / length, 0.0),
        jnp.maximum((upper - place) / length, 0.0),
        ease_of(rows, *mobility(prepared)),
    )


def general_substep(prepared: Prepared, motion: Motion, force: tuple) -> Motion:
    """Advance by one substep.

    Args:
        prepared: what does not depend on the state.
        motion: at the start.
        force: world frame, at the centres of mass [N, N, N m].

    Returns:
        The motion at the end.
    """
    problem = velocity_problem(prepared, motion, force)
    solved = solve_velocity(problem)
    moved = moved_by(prepared, motion, solved.solution.twist)
    return projected(prepared, problem, solved.is_settled, force, motion, moved)


def projected(
    prepared: Prepared,
    problem: VelocityProblem,
    is_settled: Bool[Array, " lane"],
    force: tuple,
    start: Motion,
    end: Motion,
    *,
    touches: PerBody | None = None,
    is_closed: bool = True,
) -> Motion:
    """The end of a substep on the joints, without energy that nothing brought.

    Args:
        prepared: what does not depend on the state.
        problem: of this substep.
        is_settled: whether that was solved.
        force: world frame, at the centres of mass [N, N, N m].
        start: of the substep.
        end: of the substep, close to what joints allow.
        touches: share of contact in each body's motion; None: nothing touches.
        is_closed: whether nothing but forces and motors brings energy.

    Returns:
        The end.
    """
    end, is_far = project(prepared, end)
    is_wrong = is_far | _is_fast(prepared, problem, end)
    if problem.is_steady is not None:
        is_wrong = is_wrong | _of_rows(problem, ~problem.is_steady)
    doubts = Doubts(is_settled, is_wrong, is_closed)
    motors = _motor_work(prepared, problem, end)
    return limited_energy(prepared, start, end, force, motors, touches, doubts)


def _of_rows(
    problem: VelocityProblem, is_so: Bool[Array, "row lane"]
) -> Bool[Array, "body lane"]:
    """Bodies with a joint row of which something holds, one of each row's two."""
    index = moved_end(problem.rows_mid, problem.mobile)
    return on_bodies(index, is_so, problem.mass.shape[0]) > 0.0


def _is_fast(
    prepared: Prepared, problem: VelocityProblem, end: Motion
) -> Bool[Array, "body lane"]:
    """Which bodies with a joint or friction end up turning too far in a substep."""
    turned = prepared.length[None] * jnp.abs(jax.lax.stop_gradient(end.spin))
    is_fast = jnp.zeros(turned.shape, bool)
    if problem.contacts is not None:
        rubs = jnp.any(problem.contacts.viscous[0] > 0.0, axis=0)
        rubs = rubs | jnp.any(problem.contacts.viscous[1] > 0.0, axis=0)
        is_fast = rubs & (turned > _MOST_TURN)
    rows: Any = problem.rows_mid
    if rows is not None:
        ease: Any = problem.ease
        most = jnp.maximum(of_body(rows.a, turned), of_body(rows.b, turned))
        is_fast = is_fast | _of_rows(problem, (most > _MOST_TURN) & (ease > 0.0))
    return is_fast


def _motor_work(
    prepared: Prepared, problem: VelocityProblem, end: Motion
) -> PerBody | float:
    """Most that motors can have done, by a body that each moves."""
    laws = problem.laws
    if laws is None:
        return 0.0
    drives = [d for d in (prepared.turning, prepared.sliding) if d is not None]
    if all(drive.motor is None for drive in drives):
        return 0.0
    fastest = jnp.maximum(
        jnp.abs(speed(laws.rows, tuple(end[3:]))), jnp.abs(laws.start)
    )
    # Viscous over knee is the largest impulse.
    spin, has_motor = laws.friction, laws.target != 0.0
    knee = jnp.where(spin.knee > 0.0, spin.knee, 1.0)
    strength = jnp.where(has_motor & (spin.knee > 0.0), spin.viscous / knee, 0.0)
    return on_bodies(laws.body, strength * fastest, prepared.mass.shape[0])


def moved_by(prepared: Prepared, motion: Motion, twist: tuple) -> Motion:
    """Move with the mean of old and new twist."""
    half, mobile = 0.5 * prepared.length[None], prepared.mobile
    one = runtime_one(prepared.mass)
    moved = [
        place + half * (mobile * old + new)
        for place, old, new in zip(motion[:3], motion[3:], twist, strict=True)
    ]
    return jax.tree.map(lambda v: hold(v, one), Motion(*moved, *twist))
