r"""Friction of a lone body: three unknowns, whatever touches the floor.

Unknown are the velocity of the anchor at the end of a step, in the body's frame there,
and the spin, $e = (s_x, s_y, \omega)$, in the coordinates of `lone_body`, in which the
mass is diagonal:

$$R\,e = L\,(P - F^T f(\bar u)), \qquad \bar u = F(\Theta e + (1 - \Theta) e_0),
  \qquad L = diag(l, l, g),$$

with f the one friction law (`friction`), F its directions in the body's frame, R the
turn from the end of the step back to mid-step, where impulses act, and $\Theta$ the
share of the end velocity; R e is what is returned. One wheel is solved by one scalar
equation (`lone_wheel`). Several contacts are solved by Newton's method from the
solution in which all stick, which is linear with coefficients that do not change
(`Stuck`): by a fixed number of iterations in the same loop as everything else, or by
as many as are needed (`lone_search`), whose result is then handed in. Derivatives come
from the implicit function theorem: one 3 x 3 system, in both modes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.friction import NUM_NEWTON, is_reversed
from boomdp_jax.physics.lone_contacts import (
    Feet,
    Motions,
    Pair,
    Track,
    Triple,
    blend,
    feet_force,
    feet_sums,
    into,
    out_of,
    slip_scale,
    track_force,
    track_sums,
)
from boomdp_jax.physics.lone_wheel import Grip, slipping_wheel
from boomdp_jax.physics.small_linear import solve3

# Where iterations have a fixed number: shares of further ones after `NUM_NEWTON`. Of
# 100,000 random tracks 137 are not solved then, of those with feet 147; without these
# 1404 and 1972, most of which would be after two more, and 538 and 308 never.
_LATE_SHARES = (1.0, 1.0, 0.5, 1.0, 1.0)


class Brake(NamedTuple):
    """Friction against spin."""

    viscous: FloatScalar
    knee: FloatScalar
    share: FloatScalar
    """Share of the end spin in the spin that friction sees."""


class Stuck(NamedTuple):
    """Friction of everything that sticks, which is linear and never changes.

    Symmetric, in entries xx, xy, xt, yy, yt, tt.
    """

    end: tuple
    """Impulse per motion at the end, F^T C Theta F."""
    start: tuple
    """Impulse per motion at the start, F^T C (1 - Theta) F."""


class SlidingProblem(NamedTuple):
    """Everything that the velocities at the end of a step depend on."""

    push: Triple
    """P: what the momentum would be without friction, frame at mid-step."""
    start: Triple
    """Velocity of the anchor and spin at the start, in the body's frame there."""
    ease: Pair
    """l and 1/g: velocity of the anchor per impulse [1/kg], inertia [kg m²]."""
    turn: Pair
    """Cosine and sine of the turn from mid-step to the end."""
    tracks: list[Track]
    feet: list[Feet]
    brakes: list[Brake]
    """Friction against spin from the floor."""
    joint: Brake | None
    """Friction of the pin, zero unless it holds (l is zero then)."""

    @property
    def all_brakes(self) -> list[Brake]:
        """Every friction against spin."""
        return self.brakes + ([] if self.joint is None else [self.joint])


def residual(problem: SlidingProblem, solution: Triple) -> Triple:
    """R e - L (P - F^T f), of R e as it is returned: zero at the solution."""
    e = (*into(problem.turn, *solution[:2]), solution[2])
    motions = Motions(e, problem.start)
    forces = [track_force(track, motions) for track in problem.tracks]
    forces += [feet_force(feet, motions) for feet in problem.feet]
    x, y, moment = problem.push
    for force in forces:
        x, y, moment = x - force[0], y - force[1], moment - force[2]
    for brake in problem.all_brakes:
        u = blend(brake.share, e[2], problem.start[2])
        moment = moment - slip_scale((brake.knee * u) ** 2) * brake.viscous * u
    return _miss(problem, solution, (x, y, moment))


def _miss(problem: SlidingProblem, solution: Triple, impulse: Triple) -> Triple:
    slide, turn = problem.ease[0], 1.0 / problem.ease[1]
    x, y, spin = solution
    return x - slide * impulse[0], y - slide * impulse[1], spin - turn * impulse[2]


def _jacobian(problem: SlidingProblem, entries) -> list:
    """R + L A, rows of entries."""
    (cos, sin), slide, turn = problem.turn, problem.ease[0], 1.0 / problem.ease[1]
    xx, xy, xt, yx, yy, yt, tx, ty, tt = entries
    return [
        [cos + slide * xx, slide * xy - sin, slide * xt],
        [slide * yx + sin, cos + slide * yy, slide * yt],
        [turn * tx, turn * ty, 1.0 + turn * tt],
    ]


def _linearise(problem: SlidingProblem, e: Triple, before: Triple | None):
    """Residual, its derivative, rows of entries, and how many are taken as sticking."""
    motions = Motions(e, problem.start, before)
    parts = [track_sums(track, motions) for track in problem.tracks]
    parts += [feet_sums(feet, motions) for feet in problem.feet]
    # Where nothing but spin is resisted.
    parts = parts or [(jnp.zeros_like(e[2]),) * 13]
    *entries, x, y, moment, num_back = (
        sum(column[1:], start=column[0]) for column in zip(*parts, strict=True)
    )
    for brake in problem.all_brakes:
        u = blend(brake.share, e[2], problem.start[2])
        ratio, is_back = brake.knee * u, False
        if before is not None:
            old = brake.knee * blend(brake.share, before[2], problem.start[2])
            is_back = is_reversed((ratio,), (old,))
            num_back = num_back + jnp.where(is_back, 1.0, 0.0)
        square = jnp.where(is_back, 1.0, ratio * ratio)
        moment = moment + slip_scale(square) * brake.viscous * u
        # Where it slips, in one dimension, the torque is constant.
        slope = jnp.where(square > 1.0, 0.0, brake.viscous * brake.share)
        entries[8] = entries[8] + slope
    push = problem.push
    impulse = (push[0] - x, push[1] - y, push[2] - moment)
    solution = (*out_of(problem.turn, e[0], e[1]), e[2])
    return _miss(problem, solution, impulse), _jacobian(problem, entries), num_back


def all_stuck(problem: SlidingProblem, stuck: Stuck) -> Triple:
    """The solution without limits, in the frame at the end of the step."""
    xx, xy, xt, yy, yt, tt = stuck.start
    ux, uy, spin = problem.start
    x = problem.push[0] - (xx * ux + xy * uy + xt * spin)
    y = problem.push[1] - (xy * ux + yy * uy + yt * spin)
    moment = problem.push[2] - (xt * ux + yt * uy + tt * spin)
    slide, turn = problem.ease[0], 1.0 / problem.ease[1]
    pushed = (slide * x, slide * y, turn * moment)
    xx, xy, xt, yy, yt, tt = stuck.end
    jacobian = _jacobian(problem, (xx, xy, xt, xy, yy, yt, xt, yt, tt))
    return solve3(jacobian, pushed)


def none_rubs(problem: SlidingProblem) -> Triple:
    """The solution without friction, likewise."""
    slide, (x, y, moment) = problem.ease[0], problem.push
    x, y = into(problem.turn, slide * x, slide * y)
    return x, y, moment / problem.ease[1]


def _newton(problem: SlidingProblem, stuck: Stuck) -> Triple:
    """Several contacts: start from all of them sticking, then iterate."""
    e = before = all_stuck(problem, stuck)
    for _ in range(NUM_NEWTON):
        e, before = newton_step(problem, e, before)[0], e
    for share in _LATE_SHARES:
        new, _ = newton_step(problem, e, None)
        x, y, spin = (a + share * (b - a) for a, b in zip(e, new, strict=True))
        e = (x, y, spin)
    return e


def newton_step(
    problem: SlidingProblem, e: Triple, before: Triple | None
) -> tuple[Triple, FloatScalar]:
    """One iteration of Newton's method.

    Args:
        problem: momenta and frictions.
        e: where it starts, frame at the end of the step.
        before: where the iteration before did (see `friction.is_reversed`), if any.

    Returns:
        Where it ends, and how many contacts it took as sticking for a turn: a solution
        of that is none of the problem's.
    """
    miss, jacobian, num_back = _linearise(problem, e, before)
    x, y, spin = (a - b for a, b in zip(e, solve3(jacobian, miss), strict=True))
    return (x, y, spin), num_back


def solve_sliding(
    problem: SlidingProblem, aid: Stuck | Grip | None, found: Triple | None = None
) -> Triple:
    """Velocity of the anchor and spin at the end of a step.

    Args:
        problem: momenta and frictions.
        aid: the same friction without limits; of a single contact or none, the grip of
            the pin's friction, if there is a pin. Not differentiated: it says nothing
            that the problem does not.
        found: the solution, if it was searched for before, in the frame at the end of
            the step. Not differentiated either.

    Returns:
        The anchor's velocity [m/s], in the frame at mid-step, and the spin [rad/s].
        Differentiable by the implicit function theorem.
    """

    @jax.custom_jvp
    def solve(problem, aid, found):
        if found is None:
            if not isinstance(aid, Stuck):
                return slipping_wheel(problem, aid)
            found = _newton(problem, aid)
        x, y, spin = found
        return *out_of(problem.turn, x, y), spin

    def solve_jvp(primals, tangents):
        (problem, aid, found), (rate, *_) = primals, tangents
        solution = solve(problem, aid, found)
        leaves, treedef = jax.tree.flatten(problem)
        rates = jax.tree.leaves(
            rate, is_leaf=lambda x: isinstance(x, jax.custom_derivatives.SymbolicZero)
        )
        moving = [
            i
            for i, r in enumerate(rates)
            if not isinstance(r, jax.custom_derivatives.SymbolicZero)
        ]

        def miss(values):
            full = list(leaves)
            for i, value in zip(moving, values, strict=True):
                full[i] = value
            return residual(jax.tree.unflatten(treedef, full), solution)

        _, rate = jax.jvp(
            miss, ([leaves[i] for i in moving],), ([rates[i] for i in moving],)
        )
        e = (*into(problem.turn, *solution[:2]), solution[2])
        _, jacobian, _ = _linearise(problem, e, None)
        x, y, spin = (-value for value in solve3(jacobian, rate))
        return solution, (*out_of(problem.turn, x, y), spin)

    solve.defjvp(solve_jvp, symbolic_zeros=True)
    return solve(problem, aid, found)
