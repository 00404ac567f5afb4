r"""Newton's method for the friction of a lone body, until it comes to rest.

Most of a batch come to rest within a few iterations from where all contacts stick, and
all of them are iterated together. What is left then, of random tracks one in seventy,
is taken out of the batch and iterated by itself (`friction.LATE_SHARES`).
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.core.any_in_batch import any_in_batch
from boomdp_jax.core.arrays import BoolScalar, FloatScalar
from boomdp_jax.core.few_at_a_time import few_at_a_time
from boomdp_jax.core.lanes import in_lanes
from boomdp_jax.core.one_loop import one_loop
from boomdp_jax.physics.friction import LATE_SHARES, NUM_LATE, NUM_NEWTON
from boomdp_jax.physics.lone_contacts import Triple
from boomdp_jax.physics.lone_friction import (
    SlidingProblem,
    Stuck,
    all_stuck,
    newton_step,
    none_rubs,
)

# An iteration that changes a motion by less than this power of the rounding unit (of
# what it is) was the last: Newton's method squares what is left to correct.
_SETTLED = 0.7
# Taken out of a batch at once: at least so many, and one in so many.
_AT_A_TIME, _ONE_IN = 16, 64
# From a batch of no more than so many nothing is taken out.
_FEW = 128


class Rubbing(NamedTuple):
    """A problem, and what helps to solve it."""

    problem: SlidingProblem
    stuck: Stuck
    mass: FloatScalar
    """Of the body [kg]."""


class Search(NamedTuple):
    """Newton's method under way."""

    found: Triple
    """The iterate, frame at the end of the step."""
    before: Triple
    """In the iteration before."""
    is_open: FloatScalar
    """One while the iterate still changes, else zero: it then stays what it is."""


def search_friction(problem_of: Callable[..., Rubbing], *given: Any) -> Triple:
    """Solve for the motion at the end of a step.

    How long one of a batch is iterated does not depend on the others.

    Args:
        problem_of: the problem of what is given, in scalars; at module level.
        given: trees of scalars, not differentiated.

    Returns:
        Velocity of the anchor [m/s] and spin [rad/s], frame at the end of the step.
    """
    static = (problem_of,)
    search = one_loop(_begun, *given, static=static, is_marked=False)

    def goes_on(carry: tuple) -> BoolScalar:
        turn, is_any_open, _ = carry
        return is_any_open & (turn < NUM_NEWTON)

    def go_on(carry: tuple) -> tuple:
        turn, _, search = carry
        search = one_loop(_on, *given, search, static=static)
        return turn + 1, any_in_batch(search.is_open > 0), search

    start = jnp.ones((), jnp.int32), any_in_batch(search.is_open > 0), search
    _, is_any_open, search = jax.lax.while_loop(goes_on, go_on, start)

    def rest(search: Search) -> Search:
        whole = given, search
        # One block: whatever its size, most of the time few of it are left.
        return in_lanes(_rest, *whole, static=static, block=2**30)

    search = jax.lax.cond(is_any_open, rest, lambda search: search, search)
    return search.found


def _begun(problem_of: Callable[..., Rubbing], *given: Any) -> Search:
    rubbing = problem_of(*given)
    e = all_stuck(rubbing.problem, rubbing.stuck)
    return _iterated(rubbing, e, e, 1.0)


def _on(problem_of: Callable[..., Rubbing], *given: Any) -> Search:
    """One iteration more for what is open."""
    *known, search = given
    now = _iterated(problem_of(*known), search.found, search.before, 1.0)
    return _where_open(search, now)


def _late(problem_of: Callable[..., Rubbing], *given: Any) -> Search:
    """The same by a share of it, perhaps from a new start."""
    *known, search, share, is_free, is_start = given
    rubbing = problem_of(*known)
    free, start = none_rubs(rubbing.problem), rubbing.problem.start
    x, y, spin = (
        jnp.where(is_free > 0, a, jnp.where(is_start > 0, b, c))
        for a, b, c in zip(free, start, search.found, strict=True)
    )
    return _where_open(search, _iterated(rubbing, (x, y, spin), None, share))


def _where_open(search: Search, now: Search) -> Search:
    """What is done stays as it is, whatever the others of its batch do."""
    new, old = (jax.tree.leaves(v) for v in (now, search))
    kept = [jnp.where(search.is_open > 0, a, b) for a, b in zip(new, old, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(search), kept)


def _iterated(rubbing: Rubbing, e: Triple, before: Triple | None, share) -> Search:
    problem, stuck, mass = rubbing
    del stuck
    end, num_back = newton_step(problem, e, before)
    x, y, spin = (b - a for a, b in zip(e, end, strict=True))

    def energy(motion: Triple) -> FloatScalar:
        x, y, spin = motion
        return mass * (x * x + y * y) + problem.ease[1] * spin * spin

    least = float(jnp.finfo(mass.dtype).eps) ** _SETTLED
    least = least**2 * (energy(end) + energy(problem.start))
    # What is not finite does not hold up the others.
    has_moved = (energy((x, y, spin)) > least) | (num_back > 0)
    is_open = jnp.where(has_moved, 1.0, 0.0).astype(mass.dtype)
    found = (e[0] + share * x, e[1] + share * y, e[2] + share * spin)
    return Search(found, e, is_open)


def _rest(problem_of: Callable[..., Rubbing], given: tuple, search: Search) -> Search:
    """What is left of a batch `[lane]`, a few lanes at a time."""
    num = search.is_open.shape[-1]
    if num <= _FEW:
        return _to_the_end(problem_of, given, search)
    return few_at_a_time(
        functools.partial(_to_the_end, problem_of),
        search.is_open > 0,
        given,
        search,
        max(_AT_A_TIME, num // _ONE_IN),
    )


def _to_the_end(
    problem_of: Callable[..., Rubbing], given: tuple, search: Search
) -> Search:
    """All late iterations `[lane]`; nothing is open after them."""
    dtype = search.is_open.dtype
    shares = jnp.asarray(LATE_SHARES, dtype)
    going_on, from_free, total = itertools.accumulate(NUM_LATE)

    def goes_on(carry: tuple) -> BoolScalar:
        turn, search = carry
        return (turn < total) & _is_any_open(search)

    def go_on(carry: tuple) -> tuple:
        turn, search = carry
        share = shares[turn % len(LATE_SHARES)]
        is_free, is_start = (
            jnp.where(turn == begin, 1.0, 0.0).astype(dtype)
            for begin in (going_on, from_free)
        )

        def late(*lane: Any) -> Search:
            rest = (share, is_free, is_start)
            return one_loop(_late, *lane, *rest, static=(problem_of,))

        return turn + 1, jax.vmap(late)(*given, search)

    start = jnp.zeros((), jnp.int32), search
    _, search = jax.lax.while_loop(goes_on, go_on, start)
    return search._replace(is_open=jnp.zeros_like(search.is_open))


def _is_any_open(search: Search) -> BoolScalar:
    return jnp.any(search.is_open > 0)
