r"""One implicit velocity update: friction and joints solved together.

Unknown are the twists $w$ and the impulses of joints $\lambda$:

$$M w = p - h\,T^T f(\bar u) + J_m^T \lambda, \qquad J_e w = 0, \qquad
  \bar u = T(\vartheta w + (1-\vartheta) w_0),$$

$J_m$ taken at mid-step, where the impulse acts on average, and $J_e$ at its end, where
the joint must hold. The friction, motor and limits of a joint are rows as well,
$\lambda = -f(J\bar w - u_{motor})$ and $\lambda \ge 0 \perp J w \ge u_{limit}$.
Newton's method is applied (`velocity_search`); each iteration eliminates the bodies and
solves the rows directly:

$$A = M + h\,T^T K \vartheta T, \qquad (J_e A^{-1} J_m^T + \epsilon)\,\lambda = -J_e
  A^{-1} b.$$

Compared on a body with pin and wheel, against two-stage L-stable Runge-Kutta (twice the
cost, and dry friction then overshoots at the moment of stopping by up to half of a
step's impulse) and against backward Euler in four substeps (twice the cost, four times
the error of a wheel's decay).

All arrays are in lanes (`core.lanes`), twists and rows in world axes.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.body_friction import (
    Felt,
    answer_of_bodies,
    friction_of_bodies,
)
from boomdp_jax.physics.friction import Contact, Spin, limited
from boomdp_jax.physics.joints import Rows
from boomdp_jax.physics.row_algebra import (
    PerBody,
    PerRow,
    Tied,
    Twist,
    columns_of,
    compliance_of,
    coupled,
    moved_by,
    on_diagonal,
    pushed,
    speed,
)
from boomdp_jax.physics.small_linear import solve_in_lanes


class Laws(NamedTuple):
    """Frictions and motors of joints, each along a row."""

    rows: Tied
    friction: Spin
    """Impulses in place of forces."""
    start: PerRow
    """Speed at the start of the substep."""
    target: PerRow
    """Speed that it drives at, zero for friction."""
    body: PerRow
    """Index of a body that it moves."""


class Limits(NamedTuple):
    """Ranges of joints, each along a row."""

    rows: Tied
    least: PerRow
    """Speed at which the lower end is met when the substep ends."""
    most: PerRow
    ease: PerRow
    """J M^-1 J^T, which compares impulses with speeds."""


class VelocityProblem(NamedTuple):
    """Everything that the velocity update depends on."""

    mobile: PerBody
    """One, or zero for a static body, which nothing moves."""
    mass: PerBody
    inertia: PerBody
    momentum: Twist
    """p: momentum with the impulse of all known forces."""
    start: Twist
    """w_0."""
    frame: tuple[PerBody, PerBody]
    """Cosine and sine of the bodies at mid-step."""
    turn: tuple[PerBody, PerBody]
    """Cosine and sine of half the turn of the substep."""
    contacts: Contact | None
    """`[contact, body, lane]`, impulses in place of forces."""
    spins: Spin | None
    """Likewise."""
    push: Tied | None
    """J_m of joints, of what acts along their free coordinates, and of their limits."""
    end: Tied | None
    """J_e of the same."""
    rows_mid: Rows | None
    """Of joints alone."""
    ease: PerRow | None
    """J M^-1 J^T of each row of joints, zero for inactive ones."""
    is_steady: Bool[Array, "row lane"] | None
    """Whether a row of joints does not turn so far in this substep that it is taken at
    mid-step."""
    laws: Laws | None
    limits: Limits | None


class Solution(NamedTuple):
    """An iterate."""

    twist: Twist
    before: Twist
    """In the iteration before (see `friction.is_reversed`)."""
    impulse: PerRow | None
    """Of all rows: of joints, of their frictions and motors, of their limits."""


class Solved(NamedTuple):
    """What an iteration finds."""

    solution: Solution
    is_settled: Bool[Array, " lane"]
    """Whether a last iteration changed next to nothing, as far as is known; of a single
    one see `newton_step`."""


def first_guess(problem: VelocityProblem) -> Solution:
    """From which an iteration finds the solution in which everything sticks."""
    zero = jnp.zeros_like(problem.mass)
    sizes = [problem.ease]
    sizes += [None if problem.laws is None else problem.laws.start]
    sizes += [None if problem.limits is None else problem.limits.ease]
    rows = [jnp.zeros_like(size) for size in sizes if size is not None]
    rest = (zero, zero, zero)
    return Solution(rest, rest, jnp.concatenate(rows) if rows else None)


def newton_step(
    problem: VelocityProblem, guess: Solution, is_limited: Any = 1.0
) -> Solved:
    """One iteration of Newton's method.

    Args:
        problem: momenta, frictions and joint rows.
        guess: where it starts.
        is_limited: one, or zero to leave out the dry limits, so that everything sticks.

    Returns:
        Twists and impulses of the system linearised there; settled where no contact was
        taken as sticking for that.
    """
    felt = Felt(problem.frame, problem.turn, problem.start, guess.twist, guess.before)
    friction = friction_of_bodies(problem.contacts, problem.spins, felt, is_limited)
    zero = jnp.zeros_like(problem.mass)
    is_whole = jnp.ones(problem.mass.shape[-1], bool)
    if friction is not None:
        is_whole = is_whole & (jnp.sum(friction[2], axis=0) == 0.0)
    given = (zero, zero, zero)
    push, end = problem.push, problem.end
    if push is None or end is None or guess.impulse is None:
        _, free = answer_of_bodies(problem, friction, guess.twist, given)
        return Solved(Solution(free, guess.twist, None), is_whole)
    gain, diagonal, demand, is_needed, num_back = _system(problem, guess, is_limited)
    given = pushed(given, push, guess.impulse)
    answer, free = answer_of_bodies(problem, friction, guess.twist, given)
    one = runtime_one(problem.mass)
    columns = columns_of(push, answer, one)
    matrix = gain[:, None] * coupled(end, push, columns)
    matrix = matrix + on_diagonal(diagonal)
    lacking = demand - gain * speed(end, free) - diagonal * guess.impulse
    change = solve_in_lanes(matrix, lacking, is_needed)
    twist = moved_by(free, push, columns, change)
    x, y, spin = (hold(v, one) for v in twist)
    impulse = guess.impulse + change
    is_whole = is_whole & (num_back == 0.0)
    return Solved(Solution((x, y, spin), guess.twist, impulse), is_whole)


def _system(problem: VelocityProblem, guess: Solution, is_limited) -> tuple:
    """Of the rows, with g J_e w + d lambda = r: g, d, r, and which are needed.

    And of each lane, how many frictions are taken as sticking.
    """
    gain, diagonal, demand, needs = [], [], [], []
    num_back: Any = 0.0
    if problem.ease is not None:
        ease = problem.ease
        gain.append(jnp.ones_like(ease))
        diagonal.append(compliance_of(ease))
        demand.append(jnp.zeros_like(ease))
        needs.append(ease > 0.0)
    if problem.laws is not None:
        laws = problem.laws
        seen = speed(laws.rows, guess.twist), speed(laws.rows, guess.before)
        slope, offset, back = elementwise(
            law_line, laws.friction, laws.start, laws.target, *seen, is_limited
        )
        num_back = jnp.sum(back, axis=0)
        gain.append(slope)
        diagonal.append(jnp.ones_like(slope))
        demand.append(offset)
        needs.append(laws.friction.viscous > 0.0)
    if problem.limits is not None:
        limits = problem.limits
        pressure: Any = guess.impulse
        pressure = pressure[-limits.ease.shape[0] :]
        parts = elementwise(
            _limit, *limits[1:], speed(limits.rows, guess.twist), pressure
        )
        for whole, part in zip((gain, diagonal, demand), parts, strict=True):
            whole.append(part)
        needs.append(parts[0] > 0.0)
    rows = (jnp.concatenate(parts) for parts in (gain, diagonal, demand, needs))
    return *rows, num_back


def law_line(spin: Spin, start, target, now, before, is_limited) -> tuple:
    """Slope of a friction and its demand: lambda + slope J w = demand; in scalars.

    And one where it is taken as sticking (`friction.limited`), else zero.
    """

    def blend(value):
        return spin.weight * value + (1.0 - spin.weight) * start - target

    knee, u = spin.knee * is_limited, blend(now)
    scale, ((k,),), back = limited((u,), (spin.viscous,), (knee,), (blend(before),))
    slope = k * spin.weight
    return slope, slope * now - scale * spin.viscous * u, back


def _limit(least, most, ease, now, pressure) -> tuple:
    """Gain, diagonal and demand of a range: held at an end, or left alone."""
    # What the row would do without what the limit gives.
    free = now - ease * pressure
    is_least, is_most = free < least, free > most
    is_held = (is_least | is_most) & (ease > 0.0)
    one, zero = jnp.ones_like(now), jnp.zeros_like(now)
    softness = 1e-6 * ease
    return (
        jnp.where(is_held, one, zero),
        jnp.where(is_held, softness, one),
        jnp.where(is_held, jnp.where(is_least, least, most), zero),
    )
