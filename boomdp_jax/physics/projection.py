"""Putting joint drift right, in position and in velocity, weighted by mass.

All arrays are in lanes (`core.lanes`).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.core.searched import searched
from boomdp_jax.physics.body_friction import BodyAnswer
from boomdp_jax.physics.joints import (
    Frames,
    Rows,
    bilateral_rows,
    join,
    moved_end,
    on_bodies,
    slide_rows,
    turn_rows,
)
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Drive, Prepared
from boomdp_jax.physics.row_algebra import (
    PerBody,
    PerRow,
    columns_of,
    compliance_of,
    coupled,
    ease_of,
    moved_by,
    on_diagonal,
    speed,
    tied,
)
from boomdp_jax.physics.small_linear import solve_in_lanes
from boomdp_jax.physics.trigonometry import sincos

# Errors larger than this share of their levers are far: one that turns by half a radian
# in a substep leaves a hundredth.
_FAR = 0.02
_LEAST_LEVER = 1e-3
# How often poses are put nearer before.
_MOST_PROJECTIONS = 6
# Turn [rad] in one correction beyond which it is cut short.
_MOST_TURN = 0.5


def mobility(prepared: Prepared) -> tuple[PerBody, PerBody]:
    """Speed per impulse and spin per angular impulse of every body, were it free."""
    mobile = prepared.mobile
    return mobile / prepared.mass, mobile / prepared.inertia


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


def project(
    prepared: Prepared, motion: Motion
) -> tuple[Motion, Bool[Array, "body lane"]]:
    """Bring poses, then twists, back onto the joints and into their ranges.

    Args:
        prepared: what does not depend on the state.
        motion: close to what joints allow.

    Returns:
        The closest motion, in kinetic energy, to first order; and bodies with a joint
        that was far, one of its two.
    """
    one = runtime_one(prepared.mass)
    if not has_rows(prepared):
        return motion, jnp.zeros(motion.x.shape, bool)
    place, (_, is_far) = searched(_put_nearer, _put_again, (prepared, motion[:3]), ())
    motion = jax.tree.map(lambda v: hold(v, one), Motion(*place, *motion[3:]))
    rows, counts = _rows(prepared, frames_of(prepared, motion), tuple(motion[3:]))
    assert rows is not None
    lacking = speed(tied(rows, one.shape[0]), motion[3:])
    twist = _corrected(prepared, rows, counts, lacking, motion[3:])
    final = jax.tree.map(lambda v: hold(v, one), Motion(*motion[:3], *twist))
    return final, is_far


def _put_nearer(problem: tuple, given: tuple) -> tuple:
    """Poses on their joints; and what the last correction moved, and if it was far.

    One linear correction will do, but where bodies turned far in a substep.
    """
    del given
    prepared, first = problem

    def goes_on(carry):
        turn, *_, is_open = carry
        return jnp.any(is_open) & (turn <= _MOST_PROJECTIONS)

    def advance(carry):
        turn, place, shift, was_far, is_open = carry
        new, is_far = _nearer(prepared, place)
        # Lanes that need none stay as they are, whatever the others do.
        new, shift = (
            tuple(jnp.where(is_open[None], p, q) for p, q in zip(*pair, strict=True))
            for pair in (
                (new, place),
                (tuple(p - q for p, q in zip(place, first, strict=True)), shift),
            )
        )
        was_far = jnp.where(turn == 0, is_far, was_far)
        is_open = is_open & jnp.any(is_far, axis=0)
        return turn + 1, new, shift, was_far, is_open

    zero, every = jnp.zeros_like(first[0]), jnp.ones(first[0].shape[-1], bool)
    none = jnp.zeros(first[0].shape, bool)
    start = (jnp.zeros((), jnp.int32), first, (zero, zero, zero), none, every)
    _, place, shift, is_far, _ = jax.lax.while_loop(goes_on, advance, start)
    return place, (shift, is_far)


def _put_again(problem: tuple, place: tuple, rest: tuple) -> tuple:
    """The last of the corrections.

    Where there were several, what those before it moved is taken as given: derivatives
    are then those of one correction from there.
    """
    del place
    (prepared, first), (shift, _) = problem, rest
    return _nearer(prepared, tuple(p + q for p, q in zip(first, shift, strict=True)))[0]


def _nearer(prepared: Prepared, place: tuple) -> tuple[tuple, Bool[Array, "body lane"]]:
    """One linear correction of poses, in which no body turns too far.

    And a body of each row that was far.
    """
    zero = jnp.zeros_like(place[0])
    motion = Motion(*place, zero, zero, zero)
    rows, counts = _rows(prepared, frames_of(prepared, motion), None)
    assert rows is not None
    assert counts is not None
    lever = jnp.abs(rows.ja[2]) + jnp.abs(rows.jb[2]) + _LEAST_LEVER
    is_far_row = jnp.abs(counts * rows.error) > _FAR * lever
    index = moved_end(rows, prepared.mobile)
    is_far = on_bodies(index, is_far_row, zero.shape[0]) > 0.0
    change = _corrected(prepared, rows, counts, rows.error, (zero, zero, zero))
    turn = jnp.max(jnp.abs(change[2]), axis=0)
    is_wide = turn > _MOST_TURN
    share = jnp.where(is_wide, _MOST_TURN / jnp.where(is_wide, turn, 1.0), 1.0)
    share = share[None]
    moved = tuple(p + share * dp for p, dp in zip(place, change, strict=True))
    return moved, is_far


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


def _corrected(prepared: Prepared, rows: Rows, counts, errors, values) -> tuple:
    """Values after the smallest change, in kinetic energy, that zeroes errors."""
    light, spinning = mobility(prepared)
    one = runtime_one(prepared.mass)

    def counting(arms):
        return tuple(hold(counts * j, jnp.ones_like(j) * one[:1]) for j in arms)

    rows = rows._replace(ja=counting(rows.ja), jb=counting(rows.jb))
    arms = tied(rows, one.shape[0])
    columns = columns_of(arms, BodyAnswer(light, light, spinning), one)
    ease = ease_of(arms, light, spinning)
    matrix = coupled(arms, arms, columns) + on_diagonal(compliance_of(ease))
    impulse = solve_in_lanes(matrix, -counts * errors, ease > 0.0)
    return moved_by(tuple(values), arms, columns, impulse)
