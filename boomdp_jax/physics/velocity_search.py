r"""Newton's method for the implicit velocity update, until it comes to rest.

It starts from the solution in which everything sticks: from there a contact that slips
is left on its own side, and one that sticks is already solved. After `NUM_NEWTON`
iterations few are left, which are taken out of the batch. In further ones each step
ends where nothing is left to gain along it, which solves what has a potential, joints
with friction and motors among it. What is left then goes on by `LATE_SHARES` of steps,
`NUM_LATE` times.

Derivatives are those of one more iteration with what it starts from held constant
(`core.searched`).

All arrays are in lanes (`core.lanes`).
"""

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.few_at_a_time import few_at_a_time
from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.core.searched import searched
from boomdp_jax.physics.body_friction import Felt, friction_of_bodies, into_frame
from boomdp_jax.physics.friction import LATE_SHARES, NUM_LATE, NUM_NEWTON
from boomdp_jax.physics.row_algebra import speed
from boomdp_jax.physics.velocity_solve import (
    Solution,
    Solved,
    VelocityProblem,
    first_guess,
    law_line,
    newton_step,
)

# Iterations, after `NUM_NEWTON`, that end where nothing is left to gain along them, and
# evaluations with which that end is found.
_NUM_LINES, _NUM_NARROWED = 12, 5
# Relative change in the last iteration from which a lane counts as not settled.
_UNSETTLED = 1e-3
# Lanes from which none are taken out (of 64 it gains a tenth, and takes longer to
# compile); else, when one in so many is left.
_FEW, _ONE_IN, _AT_LEAST = 128, 8, 16


class _Known(NamedTuple):
    """What iterations do not change."""

    problem: VelocityProblem
    is_wanted: Bool[Array, " lane"]
    """Where more than one iteration is."""
    has_any: Bool[Array, " lane"]
    """Where there is friction, a motor or a limit at all."""


class _Search(NamedTuple):
    """Newton's method under way."""

    found: Solution
    is_open: Bool[Array, " lane"]
    """Where the solution still changes."""
    is_settled: Bool[Array, " lane"]


def solve_velocity(problem: VelocityProblem) -> Solved:
    """Solve one velocity update.

    Args:
        problem: momenta, frictions and joint rows.

    Returns:
        Twists and impulses.
    """
    unknown = jnp.ones(problem.mass.shape[-1], bool)
    return solve_from(problem, first_guess(problem), unknown, 0)


def solve_from(
    problem: VelocityProblem,
    guess: Solution,
    is_open: Bool[Array, " lane"],
    turn: Any,
) -> Solved:
    """Solve a velocity update of which something is known.

    Args:
        problem: momenta, frictions and joint rows.
        guess: `first_guess`, or the solution with other momenta.
        is_open: where anything is to be found; elsewhere the guess is the solution.
        turn: zero for a first guess, else one.

    Returns:
        Twists and impulses.
    """
    # In the first turn of all, everything sticks.
    x, y, spin = (
        jnp.where(turn > 0, now, old)
        for now, old in zip(guess.twist, guess.before, strict=True)
    )
    guess = guess._replace(before=(x, y, spin))
    has_friction = problem.contacts is not None or problem.spins is not None
    if not has_friction and problem.laws is None and problem.limits is None:
        return newton_step(problem, guess)
    start = guess, is_open, jnp.asarray(turn, jnp.int32)
    (twist, impulse), (before, is_settled) = searched(_search, _step, problem, start)
    return Solved(Solution(twist, before, impulse), is_settled)


def _step(problem: VelocityProblem, found: tuple, rest: tuple) -> tuple:
    """The solution once more, by a further iteration, for the sake of derivatives."""
    (twist, impulse), (before, _) = found, rest
    solution = newton_step(problem, Solution(twist, before, impulse)).solution
    return solution.twist, solution.impulse


def _search(problem: VelocityProblem, start: tuple) -> tuple:
    """Twists and impulses; and the twists before, and whether these are settled."""
    guess, is_wanted, turn = start
    num = is_wanted.shape[-1]
    every = jnp.ones_like(is_wanted)
    search = _Search(guess, every, every)
    known = _Known(problem, is_wanted, _has_any(problem))
    most_left = num // _ONE_IN if num > _FEW else 0

    def goes_on(carry):
        turn, search = carry
        is_early = turn < NUM_NEWTON
        return is_early & (jnp.sum(search.is_open.astype(jnp.int32)) > most_left)

    def go_on(carry):
        turn, search = carry
        return turn + 1, _advanced(known, turn, search, is_early=True)

    if num > _FEW:
        turn, search = jax.lax.while_loop(goes_on, go_on, (turn, search))
        search = few_at_a_time(
            lambda known, search: _to_the_end(known, turn, search),
            search.is_open,
            known,
            search,
            max(most_left, _AT_LEAST),
        )
    else:
        search = _to_the_end(known, turn, search)
    found = search.found
    return (found.twist, found.impulse), (found.before, search.is_settled)


def _to_the_end(known: _Known, turn: Array, search: _Search) -> _Search:
    """All iterations that are left."""

    def goes_on(carry):
        turn, search = carry
        total = NUM_NEWTON + _NUM_LINES + sum(NUM_LATE)
        return jnp.any(search.is_open) & (turn < total)

    def go_on(carry):
        turn, search = carry
        return turn + 1, _advanced(known, turn, search, is_early=False)

    return jax.lax.while_loop(goes_on, go_on, (turn, search))[1]


def _advanced(
    known: _Known, turn: Array, search: _Search, *, is_early: bool
) -> _Search:
    """One iteration.

    Args:
        known: all that does not change.
        turn: how many came before.
        search: after those.
        is_early: whether it is known to be one of the first `NUM_NEWTON`.

    Returns:
        The search after it. Lanes that are done stay as they are, whatever the others
        do.
    """
    problem, is_wanted, has_any = known
    last = guess = search.found
    dtype = problem.mass.dtype
    is_limited = jnp.where(turn > 0, 1.0, 0.0).astype(dtype)
    if not is_early:
        guess = _late_guess(problem, turn, last)
    found, is_whole = newton_step(problem, guess, is_limited)
    is_near = ~_has_moved(guess.twist, found.twist, _UNSETTLED) & is_whole
    has_moved = (turn == 0) | ~is_whole | _has_moved(guess.twist, found.twist)
    if not is_early:
        share = _share(problem, turn, guess, found)
        # The whole of it to the bit, as where it is known to be early.
        twist, impulse = jax.tree.map(
            lambda old, new: jnp.where(share == 1.0, new, old + share * (new - old)),
            (guess.twist, guess.impulse),
            (found.twist, found.impulse),
        )
        found = Solution(twist, found.before, impulse)
    # The first has none before it that slipped.
    x, y, spin = (
        jnp.where(turn == 0, new, old)
        for new, old in zip(found.twist, found.before, strict=True)
    )
    found = found._replace(before=(x, y, spin))
    is_open = search.is_open
    found = jax.tree.map(
        lambda new, old: jnp.where(is_open[None], new, old), found, last
    )
    is_settled = jnp.where(is_open, is_near | ~has_any, search.is_settled)
    return _Search(found, is_open & is_wanted & has_any & has_moved, is_settled)


def _late_guess(problem: VelocityProblem, turn: Array, last: Solution) -> Solution:
    """Where an iteration begins, which may be a later one."""
    x, y, spin = problem.momentum
    light = problem.mobile / problem.mass
    free = (light * x, light * y, problem.mobile / problem.inertia * spin)
    late = turn - NUM_NEWTON - _NUM_LINES
    going_on, from_free, _ = itertools.accumulate(NUM_LATE)
    # What slips beyond rest may do so, so that nothing is taken to stick.
    guess = last._replace(
        before=jax.tree.map(
            lambda now, old: jnp.where(turn < NUM_NEWTON, old, now),
            last.twist,
            last.before,
        )
    )
    for begin, twist in ((going_on, free), (from_free, problem.start)):
        guess = _from_elsewhere(guess, late == begin, twist)
    return guess


def _share(
    problem: VelocityProblem, turn: Array, guess: Solution, found: Solution
) -> Float[Array, "1 lane"]:
    """Share that is taken of an iteration."""
    late = turn - NUM_NEWTON - _NUM_LINES
    is_line = (turn >= NUM_NEWTON) & (late < 0)
    share = jax.lax.cond(is_line, _good_share, _whole, problem, guess, found)
    late_share = jnp.asarray(LATE_SHARES, share.dtype)[late % len(LATE_SHARES)]
    return jnp.where(late >= 0, late_share, share)[None]


def _whole(problem: VelocityProblem, guess: Solution, found: Solution) -> Array:
    del problem, found
    return jnp.ones_like(guess.twist[0][0])


def _good_share(problem: VelocityProblem, guess: Solution, found: Solution) -> Array:
    """Share of a Newton step after which nothing is left to gain along it.

    Friction resists the more the faster it is sheared, so that what is lacking of the
    momentum balance, taken along the step, changes sign once: at a minimum, where all
    friction has a potential. Steps that end there cannot go round in circles.
    """
    step = tuple(v - u for u, v in zip(guess.twist, found.twist, strict=True))

    def narrow(turn, ends):
        low, high, at_low, at_high, _ = ends
        share = jnp.clip(_secant(at_low, at_high), 0.05, 0.95)
        share = low + (high - low) * share
        # Both ends come first.
        share = jnp.where(turn == 0, 0.0, jnp.where(turn == 1, 1.0, share))
        value = _lacking_along(problem, guess.twist, step, share[None])
        is_low = (turn == 0) | ((turn != 1) & (value < 0.0))
        return (
            jnp.where(is_low, share, low),
            jnp.where(is_low, high, share),
            jnp.where(is_low, value, at_low),
            jnp.where(is_low, at_high, value),
            jnp.where(turn == 0, value, ends[-1]),
        )

    zero = jnp.zeros_like(step[0][0])
    ends = (zero, zero + 1.0, zero, zero, zero)
    ends = jax.lax.fori_loop(0, _NUM_NARROWED, narrow, ends)
    low, high, at_low, at_high, at_start = ends
    share = low + (high - low) * jnp.clip(_secant(at_low, at_high), 0.0, 1.0)
    # Where there was nothing to gain to begin with (joints turn in a substep, and what
    # they do then does a little work; near the end there is nothing but rounding) the
    # line tells nothing.
    return jnp.where((at_high <= 0.0) | (at_start >= 0.0), 1.0, share)


def _secant(at_low, at_high) -> Array:
    """Where between two ends a line through their values is zero; else half-way."""
    gap = at_high - at_low
    return jnp.where(gap > 0.0, -at_low / jnp.where(gap > 0.0, gap, 1.0), 0.5)


def _lacking_along(problem: VelocityProblem, start: tuple, step: tuple, share) -> Array:
    """What is lacking of the momentum balance after a part of a step, along the step.

    What joints do does no work along it and is left out.
    """
    twist = tuple(u + share * d for u, d in zip(start, step, strict=True))
    felt = Felt(problem.frame, problem.turn, problem.start, twist, twist)
    friction = friction_of_bodies(problem.contacts, problem.spins, felt, 1.0)
    inertia = (problem.mass, problem.mass, problem.inertia)
    parts = [
        d * (m * v - p)
        for d, m, v, p in zip(step, inertia, twist, problem.momentum, strict=True)
    ]
    if friction is not None:
        along = into_frame(problem.frame, step)
        parts += [-d * f for d, f in zip(along, friction[1], strict=True)]
    if problem.laws is not None:
        laws = problem.laws
        moving = speed(laws.rows, twist)
        slope, offset, _ = elementwise(
            law_line, laws.friction, laws.start, laws.target, moving, moving, 1.0
        )
        parts.append(speed(laws.rows, step) * (slope * moving - offset))
    return functools.reduce(jnp.add, [jnp.sum(part, axis=0) for part in parts])


def _from_elsewhere(guess: Solution, is_now: Any, twist: tuple) -> Solution:
    """A new start, with nothing known of impulses, where the time has come."""
    impulse = None if guess.impulse is None else jnp.zeros_like(guess.impulse)
    x, y, spin = twist
    begun = Solution((x, y, spin), (x, y, spin), impulse)
    return jax.tree.map(lambda new, old: jnp.where(is_now, new, old), begun, guess)


def _has_any(problem: VelocityProblem) -> Bool[Array, " lane"]:
    """Which lanes have friction, a motor or a limit at all."""
    if problem.limits is not None:
        return jnp.ones(problem.mass.shape[-1], bool)
    frictions = [problem.contacts, problem.spins]
    frictions += [None if problem.laws is None else problem.laws.friction]
    viscous = jax.tree.leaves([f.viscous for f in frictions if f is not None])
    found = [jnp.any(c > 0.0, axis=tuple(range(c.ndim - 1))) for c in viscous]
    return functools.reduce(jnp.logical_or, found)


def _has_moved(old: tuple, new: tuple, share: float | None = None) -> Array:
    """Whether a lane's iterate changed by more than a share of it; else rounding."""
    if share is None:
        share = 64.0 * float(jnp.finfo(new[0].dtype).eps)
    size = sum(jnp.max(jnp.abs(v), axis=0) for v in new)
    change = functools.reduce(
        jnp.maximum,
        [jnp.max(jnp.abs(v - u), axis=0) for u, v in zip(old, new, strict=True)],
    )
    # A lane that is not finite does not hold up the others.
    return change > share * size
