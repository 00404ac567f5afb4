r"""Newton's method for the implicit velocity update, until it comes to rest.

It starts from the solution in which everything sticks: from there a contact that slips
is left on its own side, and one that sticks is already solved. After `NUM_NEWTON`
iterations few are left, which go on by `LATE_SHARES` of them, `NUM_LATE` times.

Derivatives are those of one more iteration with what it starts from held constant
(`core.searched`).

All arrays are in lanes (`core.lanes`).
"""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.core.searched import searched
from boomdp_jax.physics.friction import LATE_SHARES, NUM_LATE, NUM_NEWTON
from boomdp_jax.physics.velocity_solve import (
    Solution,
    Solved,
    VelocityProblem,
    first_guess,
    newton_step,
)

# Relative change in the last iteration from which it has not.
_UNSETTLED = 1e-3


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
    guess, is_open, turn = start
    has_any = _has_any(problem)

    shares = jnp.asarray(LATE_SHARES, problem.mass.dtype)
    going_on, from_free, total = itertools.accumulate(NUM_LATE)

    def goes_on(carry):
        turn, _, is_moving, _ = carry
        return jnp.any(is_moving) & (turn < NUM_NEWTON + total)

    def advance(carry):
        turn, last, is_moving, is_settled = carry
        is_limited = jnp.where(turn > 0, 1.0, 0.0).astype(problem.mass.dtype)
        late = turn - NUM_NEWTON
        guess = last._replace(
            # What slips beyond rest may do so, so that nothing is taken to stick.
            before=jax.tree.map(
                lambda now, old: jnp.where(late >= 0, now, old), last.twist, last.before
            )
        )
        free = tuple(
            problem.mobile * p / inertia
            for p, inertia in zip(
                problem.momentum,
                (problem.mass, problem.mass, problem.inertia),
                strict=True,
            )
        )
        for begin, twist in ((going_on, free), (from_free, problem.start)):
            guess = _from_elsewhere(guess, late == begin, twist)
        found, is_whole = newton_step(problem, guess, is_limited)
        is_near = ~_has_moved(guess.twist, found.twist, _UNSETTLED) & is_whole
        share = jnp.where(late >= 0, shares[late % len(LATE_SHARES)], 1.0)
        twist, impulse = jax.tree.map(
            lambda old, new: old + share * (new - old),
            (guess.twist, guess.impulse),
            (found.twist, found.impulse),
        )
        # The first has none before it that slipped.
        x, y, spin = (
            jnp.where(turn == 0, new, old)
            for new, old in zip(twist, found.before, strict=True)
        )
        found = Solution(twist, (x, y, spin), impulse)
        has_moved = (turn == 0) | ~is_whole | _has_moved(guess.twist, found.twist)
        # Lanes that are done stay as they are, whatever the others do.
        found = jax.tree.map(
            lambda new, old: jnp.where(is_moving[None], new, old), found, last
        )
        is_settled = jnp.where(is_moving, is_near | ~has_any, is_settled)
        # All have one iteration, which is all that lanes need that are not open.
        is_moving = is_moving & is_open & has_any & has_moved
        return turn + 1, found, is_moving, is_settled

    every = jnp.ones_like(is_open)
    _, found, _, is_settled = jax.lax.while_loop(
        goes_on, advance, (turn, guess, every, every)
    )
    return (found.twist, found.impulse), (found.before, is_settled)


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
