r"""One step of a lone body; the stages are those of `step`.

Before its substeps a step brings an inconsistent motion onto the pin. After that a
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

from boomdp_jax.core.arrays import BoolScalar, FloatScalar
from boomdp_jax.core.one_loop import one_loop
from boomdp_jax.physics.lone_body import LoneBody, Pivot
from boomdp_jax.physics.lone_contacts import Pair, Triple, into, out_of
from boomdp_jax.physics.lone_friction import SlidingProblem, Stuck, solve_sliding
from boomdp_jax.physics.lone_search import Rubbing, search_friction
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.trigonometry import heading_turn, rotated

# Most of the turn from mid-step to the end that impulses know of [rad]. They act along
# one frame and friction looks in the other: that gives up to one over the cosine of the
# turn, and beyond a quarter of a revolution without end.
_MOST_HALF_TURN = 0.5
# Substeps that are written out in one loop; more are compiled as a loop of such loops.
# With so many the reverse pass is one loop too (`core.scalar_parts`).
_MOST_IN_A_LOOP = 2


class _Turned(NamedTuple):
    """A motion, and cosine and sine of its (turned) frame."""

    motion: Motion
    turn: Pair


def lone_step(
    body: LoneBody, motion: Motion, force: tuple, num_substeps: int
) -> tuple[Motion, FloatScalar, BoolScalar]:
    """Advance by one step.

    Args:
        body: what is prepared.
        motion: before.
        force: world frame, at the centre of mass [N, N, N m].
        num_substeps: how many the step is made of.

    Returns:
        The motion after the step, the distance by which the pin fails to hold then
        [m], and whether everything is finite.
    """
    if isinstance(body.aid, Stuck):
        return _step_of_several_contacts(body, motion, force, num_substeps)
    most = _MOST_IN_A_LOOP
    if num_substeps <= most:
        motion, error, count = one_loop(
            _whole_step, body, motion, force, static=(num_substeps,)
        )
        return motion, error, count > 0
    turned = one_loop(_begun, body, motion)
    blocks, rest = divmod(num_substeps, most)
    turned, _ = jax.lax.scan(
        lambda now, _: (one_loop(_advanced, body, now, force, static=(most,)), None),
        turned,
        None,
        length=blocks,
    )
    if rest:
        turned = one_loop(_advanced, body, turned, force, static=(rest,))
    error, count = one_loop(_reported, body, turned)
    return turned.motion, error, count > 0


def _step_of_several_contacts(
    body: LoneBody, motion: Motion, force: tuple, num_substeps: int
) -> tuple[Motion, FloatScalar, BoolScalar]:
    """The same where Newton's method is needed, one substep after the other."""
    if num_substeps == 1:
        found, body = _search(body, motion, force)
        motion, error, count = one_loop(
            _whole_step,
            *(body, motion, force, found),
            static=(1,),
            is_marked=found is None,
        )
        return motion, error, count > 0

    def advance(turned: _Turned, _: None) -> tuple[_Turned, None]:
        found, unaided = _search(body, turned, force)
        turned = one_loop(
            _advanced,
            *(unaided, turned, force, found),
            static=(1,),
            is_marked=found is None,
        )
        return turned, None

    turned = one_loop(_begun, body, motion)
    turned, _ = jax.lax.scan(advance, turned, None, length=num_substeps)
    error, count = one_loop(_reported, body, turned)
    return turned.motion, error, count > 0


def _search(
    body: LoneBody, now: Motion | _Turned, force: tuple
) -> tuple[Triple | None, LoneBody]:
    """The next solution for friction, and a body that needs no help to find it.

    What it finds is taken as given by the loop that makes the step: derivatives have
    nothing to iterate. On other backends than a CPU all iterations are made within that
    loop: a search would have to wait for every answer to whether it is to go on.
    """
    if jax.default_backend() != "cpu":
        return None, body
    given = jax.lax.stop_gradient((body, now, force))
    return search_friction(_rubbing, *given), body._replace(aid=None)


def _rubbing(body: LoneBody, now: Motion | _Turned, force: tuple) -> Rubbing:
    """What such a search solves."""
    problem, _ = _sliding(body, _turned_of(body, now), _impulse(body, force))
    assert isinstance(body.aid, Stuck)
    return Rubbing(problem, body.aid, body.mass)


def _turned_of(body: LoneBody, now: Motion | _Turned) -> _Turned:
    return _begun(body, now) if isinstance(now, Motion) else now


def _whole_step(
    num_substeps: int,
    body: LoneBody,
    motion: Motion,
    force: tuple,
    found: Triple | None = None,
):
    turned = _advanced(num_substeps, body, _begun(body, motion), force, found)
    return turned.motion, *_reported(body, turned)


def _begun(body: LoneBody, motion: Motion) -> _Turned:
    """Static bodies rest, and a pinned one hangs on its pin."""
    mobile = body.mobile
    motion = motion._replace(
        vx=mobile * motion.vx, vy=mobile * motion.vy, spin=mobile * motion.spin
    )
    turned = _Turned(motion, heading_turn(motion.theta + body.facing))
    return turned if body.pivot is None else _levelled(body.pivot, turned)


def _advanced(
    num_substeps: int,
    body: LoneBody,
    turned: _Turned,
    force: tuple,
    found: Triple | None = None,
) -> _Turned:
    impulse = _impulse(body, force)
    for _ in range(num_substeps):
        turned = _substep(body, turned, impulse, found)
    return turned


def _impulse(body: LoneBody, force: tuple) -> Triple:
    """Of a force and of gravity over a substep, world frame."""
    h, mobile = body.length, body.mobile
    return (
        mobile * (h * force[0] + body.weight[0]),
        mobile * (h * force[1] + body.weight[1]),
        mobile * h * force[2],
    )


def _reported(body: LoneBody, turned: _Turned) -> tuple[FloatScalar, FloatScalar]:
    """Joint drift [m], and one if all is finite, else zero."""
    motion, turn = turned
    error = jnp.zeros_like(motion.x)
    if body.pivot is not None:
        x, y = _offset(body.pivot, motion, turn)
        square = x * x + y * y
        has_error = square > 0
        error = jnp.where(has_error, jnp.sqrt(jnp.where(has_error, square, 1.0)), 0.0)
    total = sum(motion[1:], start=motion[0])
    return error, jnp.isfinite(total).astype(total.dtype)


def _levelled(pivot: Pivot, turned: _Turned) -> _Turned:
    """Bring a motion onto the pin by the smallest change in the sense of its mass.

    The pose, then the twist: of a start that slips along the pin, such as a kick or a
    reading, the body would else turn for half a step by what the pin takes up at once.
    """
    motion, turn = turned
    arm_x, arm_y = out_of(turn, *pivot.anchor)
    off_x = motion.x - pivot.world[0] + arm_x
    off_y = motion.y - pivot.world[1] + arm_y
    angle = pivot.levelling * (arm_y * off_x - arm_x * off_y)
    turn = rotated(turn, angle)
    arm_x, arm_y = out_of(turn, *pivot.anchor)
    slip_x = motion.vx - arm_y * motion.spin
    slip_y = motion.vy + arm_x * motion.spin
    spin = motion.spin + pivot.levelling * (arm_y * slip_x - arm_x * slip_y)
    # Where it is follows from the heading.
    level = Motion(
        x=motion.x,
        y=motion.y,
        theta=motion.theta + angle,
        vx=pivot.free * motion.vx + spin * arm_y,
        vy=pivot.free * motion.vy - spin * arm_x,
        spin=spin,
    )
    return _Turned(level, turn)


def _offset(pivot: Pivot, motion: Motion, turn: Pair) -> Pair:
    """How far off the anchor is, body's frame [m]; zero if inactive."""
    x, y = into(turn, motion.x - pivot.world[0], motion.y - pivot.world[1])
    return pivot.active * x + pivot.anchor[0], pivot.active * y + pivot.anchor[1]


def _sliding(
    body: LoneBody, turned: _Turned, impulse: Triple
) -> tuple[SlidingProblem, Pair]:
    """What friction has to be solved for in a substep, and the frame at mid-step."""
    h = body.length
    motion, start = turned
    vx, vy, spin = motion[3:]
    angle = jnp.clip(0.5 * h * spin, -_MOST_HALF_TURN, _MOST_HALF_TURN)
    half = rotated(None, angle)
    middle = out_of(start, *half)
    px, py = body.mass * vx + impulse[0], body.mass * vy + impulse[1]
    push_x, push_y = into(middle, px, py)
    slide_x, slide_y = into(start, vx, vy)
    inertia, moment = body.inertia, impulse[2]
    if body.pivot is not None:
        x, y = body.pivot.anchor
        slide_x, slide_y = slide_x - y * spin, slide_y + x * spin
        # About the pin the whole inertia turns, whatever the frame. An impulse is
        # spread over the substep, while its lever turns: on the mean its moment is
        # sin(a) / a of that at mid-step, and a force does the work of its way. The half
        # turn a is that of the mean spin, or swings would grow; friction may take up
        # most of what the impulse gives, which so counts for half of the turn at most.
        inertia = body.pivot.inertia
        spread_x, spread_y = into(middle, impulse[0], impulse[1])
        lever = y * spread_x - x * spread_y
        kick = 0.25 * h * body.pivot.ease * (moment + lever)
        most = 0.5 * jnp.abs(angle)
        square = (angle + jnp.clip(kick, -most, most)) ** 2
        spread = 1.0 - square * (1.0 / 6.0) * (1.0 - square * (1.0 / 20.0))
        moment = moment + spread * lever
    problem = SlidingProblem(
        push=(push_x, push_y, inertia * spin + moment),
        start=(slide_x, slide_y, spin),
        ease=(body.ease, inertia),
        turn=half,
        tracks=body.tracks,
        feet=body.feet,
        brakes=body.brakes,
        joint=body.joint,
    )
    return problem, middle


def _substep(
    body: LoneBody, turned: _Turned, impulse: Triple, found: Triple | None
) -> _Turned:
    h = body.length
    motion, start = turned
    vx, vy, spin = motion[3:]
    problem, middle = _sliding(body, turned, impulse)
    slide_x, slide_y, new_spin = solve_sliding(problem, body.aid, found)
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
