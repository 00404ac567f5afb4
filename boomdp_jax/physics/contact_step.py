r"""The contacts of a step, and how a substep moves under them.

Once a step contacts are found (`find_contacts`). A substep then

1. has twists as they would be without contact, with the impulses of the substep before
   applied;
2. sweeps over all contacts until nothing overlaps at its end; where friction or joints
   act, each sweep is followed by an iteration of theirs under the impulses found;
3. moves bodies with the twists that result; those that touch nothing move with the mean
   of old and new twist, which is of second order;
4. sweeps once more without what was added to part overlapping bodies: surfaces that
   touched do not approach, and bounce where they met fast;
5. takes so much of what contacts did that no energy comes of it (`contact_energy`);
   not so if they are smoothed, since they then push before bodies touch.

All arrays are in lanes (`core.lanes`).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.one_loop import one_loop
from boomdp_jax.physics.contact_energy import without_gain
from boomdp_jax.physics.contact_impulses import Pace, part, settle
from boomdp_jax.physics.contact_rows import (
    Ease,
    Side,
    Start,
    add_pushes,
    begin,
)
from boomdp_jax.physics.contact_world import ContactWorld, Fixed
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.tournament import (
    Halves,
    Rounds,
    least,
    moved_on,
    num_seats,
    play,
    seated,
    unseated,
)
from boomdp_jax.physics.trigonometry import heading_turn

NUM_POINTS = 2
"""Points of a contact."""

Impulses = Rounds
"""Of each round's pairs: normal and tangential, of both points; `[pair, lane]`."""
Meetings = Rounds
"""Of each round's pairs: speed at which surfaces part, at both points."""


class Contacts(NamedTuple):
    """All contacts of a step."""

    rows: Rounds
    """`Rows`, round by round, `[pair, lane]`."""
    overlap: Float[Array, " lane"]
    """Deepest, when they were found [m]."""
    smoothing: Float[Array, " lane"] | None


class Touch(NamedTuple):
    """What contacts carry from substep to substep."""

    impulses: Impulses
    sums: tuple
    """Impulse and moment of them on every body, world frame; `[body, lane]`."""


class _Pose(NamedTuple):
    """What a contact depends on and changes, of one body."""

    x: Any
    y: Any
    corner_x: list
    corner_y: list
    forced: tuple


def over_pairs(function, *arguments, num_passed: int = 0):
    """Apply a function of scalars along pairs and lanes (`one_loop`)."""

    def apply(*scalars):
        return one_loop(function, *scalars, num_passed=num_passed)

    return jax.vmap(jax.vmap(apply))(*arguments)


def find_contacts(
    world: ContactWorld, motion: Motion, forced: tuple, impulses: Impulses
) -> tuple[Contacts, Touch]:
    """Find the contacts of a step.

    Args:
        world: outlines, filters and surfaces.
        motion: at the start of the step.
        forced: twist that forces give every body in a substep.
        impulses: at the end of the step before; zeros if that is not known.

    Returns:
        The contacts, and what the first substep starts with.
    """
    num_bodies = motion.x.shape[0]
    cos, sin = heading_turn(motion.theta)
    outlines = world.outlines
    corners = list(zip(outlines.corner_x, outlines.corner_y, strict=True))
    pose = _Pose(
        x=motion.x,
        y=motion.y,
        corner_x=[cos * x - sin * y for x, y in corners],
        corner_y=[sin * x + cos * y for x, y in corners],
        forced=forced,
    )
    zero = jnp.zeros_like(motion.x)
    carry = seated(pose, num_bodies), seated((zero, zero, zero), num_bodies)

    def turn(carry, own):
        halves, sums = carry
        *handed_on, (start, sums) = over_pairs(_begin, halves, *own, sums, num_passed=1)
        nearest = jnp.min(start.separation, axis=0)
        carry = moved_on(handed_on[0]), moved_on(sums)
        return carry, (start.rows, start.impulses, nearest)

    (_, sums), (rows, kept, nearest) = play(
        turn, carry, world.fixed, world.allowed, world.eases, impulses
    )
    overlap = jnp.maximum(-least(nearest), 0.0)
    contacts = Contacts(rows, overlap, world.smoothing)
    return contacts, Touch(kept, unseated(sums, num_bodies))


def _begin(
    pose: Halves,
    fixed: tuple[Fixed, Fixed],
    allowed,
    eases: tuple[Ease, Ease],
    impulses,
    sums: tuple,
) -> tuple[Start, tuple]:
    a, b = (
        Side(*p[:-1], *f, p.forced, e)
        for p, f, e in zip(pose, fixed, eases, strict=True)
    )
    start = begin(a, b, allowed, impulses)
    return start, add_pushes(start.rows, start.impulses, sums)


class Sweeping(NamedTuple):
    """What sweeps over contacts are given, and hand on (`one_loop`)."""

    rows: Rounds
    eases: Rounds
    """Of both bodies of each pair, round by round."""
    pace: Pace
    """`[pair, lane]`."""


def sweeping(
    contacts: Contacts, eases: Rounds, length: Float[Array, " lane"], num_bodies: int
) -> Sweeping:
    """Gather what sweeps of a substep are given.

    Args:
        contacts: of this step.
        eases: of both bodies of each pair, round by round.
        length: of the substep [s].
        num_bodies: how many.

    Returns:
        All of it.
    """
    num_pairs = num_seats(num_bodies) // 2
    pace = jax.tree.map(
        lambda one: jnp.broadcast_to(one[None], (num_pairs, *one.shape)),
        Pace(1.0 / length, contacts.smoothing),
    )
    return Sweeping(contacts.rows, eases, pace)


def part_all(
    given: Sweeping, before: tuple[tuple, tuple], twists: tuple, impulses: Impulses
) -> tuple[Sweeping, tuple, Impulses, Meetings]:
    """Sweep once over all contacts before bodies are moved (`contact_impulses.part`).

    Args:
        given: contacts, and what bodies answer.
        before: displacement of every body in this step, and its twist when the substep
            began.
        twists: of every body; numbers after the third are sums of impulses.
        impulses: so far.

    Returns:
        What was given, twists, impulses, and the speeds at which surfaces met.
    """
    num_bodies = twists[0].shape[0]
    carry = given.pace, seated(before, num_bodies), seated(twists, num_bodies)

    def turn(carry, own):
        pace, known, halves = carry
        row, ease, old = own
        row, ease, pace, known, (halves, new, met) = over_pairs(
            part, row, ease, pace, known, halves, old, num_passed=4
        )
        carry = pace, moved_on(known), moved_on(halves)
        return carry, (row, ease, new, met)

    (pace, _, halves), (rows, eases, after, meetings) = play(
        turn, carry, given.rows, given.eases, impulses
    )
    return Sweeping(rows, eases, pace), unseated(halves, num_bodies), after, meetings


def settle_all(
    given: Sweeping, meetings: Meetings, twists: tuple, impulses: Impulses
) -> tuple[tuple, Impulses]:
    """Sweep over all contacts after bodies were moved (`contact_impulses.settle`).

    Args:
        given: contacts, and what bodies answer.
        meetings: speeds at which surfaces met as the substep began.
        twists: of every body; numbers after the third are sums of impulses.
        impulses: so far.

    Returns:
        Twists and impulses.
    """
    num_bodies = twists[0].shape[0]

    def turn(carry, own):
        pace, halves = carry
        row, ease, met, old = own
        pace, (halves, new) = over_pairs(
            settle, pace, row, ease, met, halves, old, num_passed=1
        )
        return (pace, moved_on(halves)), (new,)

    carry = given.pace, seated(twists, num_bodies)
    (_, halves), (after,) = play(
        turn, carry, given.rows, given.eases, meetings, impulses
    )
    return unseated(halves, num_bodies), after


def contact_substep(
    contacts: Contacts,
    eases: Rounds,
    ease: Ease,
    length: Float[Array, " lane"],
    motion: Motion,
    moved: tuple,
    free: tuple,
    touch: Touch,
    num_sweeps: int,
) -> tuple[Motion, Touch]:
    """Advance by one substep a world in which nothing but contact holds bodies.

    Args:
        contacts: of this step.
        eases: of both bodies of each pair, round by round.
        ease: of every body.
        length: of the substep [s].
        motion: at its start.
        moved: displacement of every body in this step.
        free: twists at the end if there were no contact, world frame.
        touch: from the substep before.
        num_sweeps: iterations before positions are moved.

    Returns:
        The motion at the end, and what the next substep starts with.
    """
    given = ease(touch.sums)
    start = tuple(v + dv for v, dv in zip(free, given, strict=True))
    before = moved, tuple(motion[3:])
    num_bodies = motion.x.shape[0]
    sweep, meetings = sweeping(contacts, eases, length, num_bodies), []
    twists, impulses = start, touch.impulses
    for _ in range(num_sweeps):
        sweep, twists, impulses, meetings = part_all(sweep, before, twists, impulses)
    changes = _changes(twists, free, given)
    place = moved_with(motion, touching(contacts, changes), twists, length)
    final, impulses = settle_all(sweep, meetings, twists, impulses)
    after = final
    if contacts.smoothing is None:
        after = without_gain(ease, tuple(motion[3:]), free, final)
    # What the impulses on a body sum up to follows from what they did to it.
    sums = tuple(
        jnp.where(e > 0.0, change / jnp.where(e > 0.0, e, 1.0), 0.0)
        for change, e in zip(_changes(final, free, given), ease[:3], strict=True)
    )
    return Motion(*place, *after), Touch(impulses, sums)


def _changes(twists: tuple, free: tuple, given: tuple) -> list:
    """What contacts did to twists, exactly zero where it is only rounding.

    An impulse given at first and taken back leaves some; a body in flight would then
    count as touching from time to time.
    """
    changes = []
    for new, old, first in zip(twists, free, given, strict=True):
        change = new - old
        rounding = 32.0 * jnp.finfo(new.dtype).eps * (jnp.abs(old) + jnp.abs(first))
        changes.append(jnp.where(jnp.abs(change) > rounding, change, 0.0))
    return changes


def touching(contacts: Contacts, changes: list) -> Float[Array, "body lane"]:
    """Which bodies contacts do anything to, as one or zero.

    Args:
        contacts: of this step.
        changes: of twists by contacts, or of momenta.

    Returns:
        In between where contact is smoothed and bodies are hardly pushed.
    """
    if contacts.smoothing is None:
        touches = functools.reduce(jnp.logical_or, [c != 0.0 for c in changes])
        return touches.astype(changes[0].dtype)
    square = changes[0] ** 2 + changes[1] ** 2
    return square / (square + contacts.smoothing[None] ** 2)


def moved_with(motion: Motion, touches, twists: tuple, length) -> list:
    """Poses at the end of a substep.

    Args:
        motion: at the start.
        touches: share of the new twists beside the mean of old and new.
        twists: before positions are moved.
        length: of the substep [s].

    Returns:
        x, y and theta.
    """
    return [
        place + 0.5 * length[None] * ((1.0 + touches) * new + (1.0 - touches) * old)
        for place, old, new in zip(motion[:3], motion[3:], twists, strict=True)
    ]
