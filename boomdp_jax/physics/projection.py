"""Putting joint drift right, in position and in velocity, weighted by mass.

All arrays are in lanes (`core.lanes`).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.body_friction import BodyAnswer
from boomdp_jax.physics.joints import (
    Frames,
    Rows,
    bilateral_rows,
    join,
    of_body,
    slide_rows,
    speed,
    turn_rows,
)
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Drive, Prepared
from boomdp_jax.physics.small_linear import solve_in_lanes
from boomdp_jax.physics.trigonometry import sincos
from boomdp_jax.physics.velocity_solve import (
    compliance_of,
    coupled,
    moved_by_rows,
    on_diagonal,
)

PerRow = Float[Array, "row lane"]

# Errors larger than this share of their levers are far: one that turns by half a radian
# in a substep leaves a hundredth.
_FAR = 0.02
_LEAST_LEVER = 1e-3
# How often poses are put nearer before.
_MOST_PROJECTIONS = 6
# Turn [rad] in one correction beyond which it is cut short.
_MOST_TURN = 0.5


def ease_of(prepared: Prepared, rows: Rows) -> PerRow:
    """J M^-1 J^T of every row."""
    columns = _columns(prepared, rows)
    return sum(
        j * c
        for row, column in zip((rows.ja, rows.jb), columns, strict=True)
        for j, c in zip(row, column, strict=True)
    )


def frames_of(prepared: Prepared, motion: Motion) -> Frames:
    """Where bodies are."""
    sin, cos = sincos(motion.theta)
    one = runtime_one(prepared.mass)
    return Frames(*motion[:3], hold(cos, one), hold(sin, one))


def has_rows(prepared: Prepared) -> bool:
    """Whether there is any joint."""
    joints = prepared.joints
    return any(e is not None for e in (joints.points, joints.rods, joints.angles))


def drive_rows(prepared: Prepared, frames: Frames) -> list[tuple[Drive, Rows]]:
    """What acts along coordinates that joints leave free, and rows of these.

    Args:
        prepared: what does not depend on the state.
        frames: where the bodies are.

    Returns:
        Of each kind; the error of its rows is the coordinate itself.
    """
    kinds = ((prepared.turning, turn_rows), (prepared.sliding, slide_rows))
    pairs: list[Any] = [
        (drive, rows_of(prepared.joints, frames))
        for drive, rows_of in kinds
        if drive is not None
    ]
    return pairs


def project(prepared: Prepared, motion: Motion) -> tuple[Motion, Bool[Array, " lane"]]:
    """Bring poses, then twists, back onto the joints and into their ranges.

    Args:
        prepared: what does not depend on the state.
        motion: close to what joints allow.

    Returns:
        The closest motion, in kinetic energy, to first order; and whether it was far.
    """
    one = runtime_one(prepared.mass)
    if not has_rows(prepared):
        return motion, jnp.zeros(motion.x.shape[-1], bool)
    is_far = _is_far(*jax.lax.stop_gradient((prepared, tuple(motion[:3]))))
    shift = jax.lax.stop_gradient(_first_shift(prepared, motion, is_far))
    place = tuple(p + q for p, q in zip(motion[:3], shift, strict=True))
    place = _nearer(prepared, place)
    motion = jax.tree.map(lambda v: hold(v, one), Motion(*place, *motion[3:]))
    rows, counts = _rows(prepared, frames_of(prepared, motion), tuple(motion[3:]))
    assert rows is not None
    lacking = speed(rows, tuple(motion[3:]))
    twist = _corrected(prepared, rows, counts, lacking, motion[3:])
    final = jax.tree.map(lambda v: hold(v, one), Motion(*motion[:3], *twist))
    return final, is_far


def _first_shift(
    prepared: Prepared, motion: Motion, is_far: Bool[Array, " lane"]
) -> tuple:
    """What brings poses near enough to their joints for a last linear correction.

    Nothing, but where bodies turned far in a substep.
    """
    constant, place = jax.lax.stop_gradient((prepared, tuple(motion[:3])))

    def goes_on(carry):
        turn, _, is_far = carry
        return jnp.any(is_far) & (turn < _MOST_PROJECTIONS)

    def advance(carry):
        turn, now, is_far = carry
        new = _nearer(constant, now)
        # Lanes that need none stay as they are, whatever the others do.
        new = tuple(
            jnp.where(is_far[None], p, q) for p, q in zip(new, now, strict=True)
        )
        return turn + 1, new, _is_far(constant, new)

    first = (jnp.zeros((), jnp.int32), place, is_far)
    near = jax.lax.while_loop(goes_on, advance, first)[1]
    return tuple(p - q for p, q in zip(near, place, strict=True))


def _is_far(prepared: Prepared, place: tuple) -> Bool[Array, " lane"]:
    zero = jnp.zeros_like(place[0])
    motion = Motion(*place, zero, zero, zero)
    rows, counts = _rows(prepared, frames_of(prepared, motion), None)
    assert rows is not None
    assert counts is not None
    lever = jnp.abs(rows.ja[2]) + jnp.abs(rows.jb[2]) + _LEAST_LEVER
    return jnp.any(jnp.abs(counts * rows.error) > _FAR * lever, axis=0)


def _nearer(prepared: Prepared, place: tuple) -> tuple:
    """One linear correction of poses, in which no body turns too far."""
    zero = jnp.zeros_like(place[0])
    motion = Motion(*place, zero, zero, zero)
    rows, counts = _rows(prepared, frames_of(prepared, motion), None)
    assert rows is not None
    change = _corrected(prepared, rows, counts, rows.error, (zero, zero, zero))
    turn = jnp.max(jnp.abs(change[2]), axis=0)
    is_wide = turn > _MOST_TURN
    share = jnp.where(is_wide, _MOST_TURN / jnp.where(is_wide, turn, 1.0), 1.0)
    return tuple(p + share[None] * dp for p, dp in zip(place, change, strict=True))


def _rows(
    prepared: Prepared, frames: Frames, twist: tuple | None
) -> tuple[Rows | None, PerRow | None]:
    """Rows that hold, with ranges that are left, and which of them count.

    Given twists, of ranges those that are being left.
    """
    rows = bilateral_rows(prepared.joints, frames)
    parts, counts = [rows], [None if rows is None else jnp.ones_like(rows.error)]
    for drive, row in drive_rows(prepared, frames):
        if drive.lower is None:
            continue
        lower: Any = drive.lower
        upper: Any = drive.upper
        below, above = row.error - lower, row.error - upper
        # An end that is met to within rounding is met.
        slack = 1e-5
        is_below, is_above = below < 0.0, above > 0.0
        if twist is not None:
            moving = speed(row, twist)
            is_below = (below < slack) & (moving < 0.0)
            is_above = (above > -slack) & (moving > 0.0)
        counts.append((is_below | is_above).astype(row.error.dtype))
        parts.append(row._replace(error=jnp.where(is_below, below, above)))
    counts = [count for count in counts if count is not None]
    return join(*parts), join(*counts)


def _columns(prepared: Prepared, rows: Rows) -> tuple:
    """What a push along each row does to its two bodies."""
    ease = (prepared.mobile / prepared.mass, prepared.mobile / prepared.inertia)
    at_both = (of_body(index, ease) for index in (rows.a, rows.b))
    return elementwise(_column, (rows.ja, rows.jb), *at_both)


def _column(pushes: tuple, *eases: tuple) -> tuple:
    return tuple(
        BodyAnswer(light, light, spinning)(*push)
        for push, (light, spinning) in zip(pushes, eases, strict=True)
    )


def _corrected(prepared: Prepared, rows: Rows, counts, errors, values) -> tuple:
    """Values after the smallest change, in kinetic energy, that zeroes errors."""

    def counting(push):
        return tuple(counts * j for j in push)

    one = jnp.ones_like(counts) * runtime_one(prepared.mass)[:1]
    rows = rows._replace(ja=counting(rows.ja), jb=counting(rows.jb))
    rows = jax.tree.map(lambda v: hold(v, one), rows)
    columns = _columns(prepared, rows)
    matrix = coupled(rows, rows, columns)
    ease = ease_of(prepared, rows)
    matrix = matrix + on_diagonal(compliance_of(ease))
    impulse = solve_in_lanes(matrix, -counts * errors, ease > 0.0)
    return moved_by_rows(tuple(values), rows, columns, impulse)
