r"""Friction of a lone body: three unknowns, whatever touches the floor.

Unknown are the velocity of the anchor and the spin, $z = (s_x, s_y, \omega)$, in the
coordinates of `lone_body`, in which the mass is diagonal:

$$z = L\,(P - F^T f(\bar u)), \qquad \bar u = S z + \beta, \qquad L = diag(l, l, g),$$

with f the one friction law (`friction`), F its directions, S the same directions at
the end of the step times the share of the end velocity, and $\beta$ what the velocity
at the start contributes. One wheel is solved by one scalar equation (`lone_wheel`).
Several contacts are solved by Newton's method from the solution in which all stick.
Derivatives come from the implicit function theorem: one 3 x 3 system, in both modes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold
from boomdp_jax.physics.lone_wheel import slipping_wheel
from boomdp_jax.physics.small_linear import dot3, inverse3, matvec3, solve3

Triple = tuple[FloatScalar, ...]

# Newton steps after the sticking solution. Three bring one wheel or four feet to
# rounding; more only cost.
_NUM_NEWTON = 3


class Drag(NamedTuple):
    """Friction at a contact, in its two directions."""

    force: tuple[Triple, ...]
    """Rows of F: generalised force per force along each direction."""
    speed: tuple[Triple, ...]
    """Rows of S: velocity that friction sees, per generalised velocity."""
    drift: tuple[FloatScalar, ...]
    """Beta: what the start of the step contributes to it [m/s]."""
    viscous: tuple[FloatScalar, ...]
    """Impulse per speed [N s²/m]."""
    knee: tuple[FloatScalar, ...]
    """One over the speed at which the limit is reached [s/m]."""


class Brake(NamedTuple):
    """Friction against spin."""

    share: FloatScalar
    """Share of the end spin in the spin that friction sees."""
    drift: FloatScalar
    """What the spin at the start contributes to it [rad/s]."""
    viscous: FloatScalar
    knee: FloatScalar


class SlidingProblem(NamedTuple):
    """Everything that the velocities at the end of a step depend on."""

    push: Triple
    """P: what the momentum would be without friction."""
    ease: tuple[FloatScalar, FloatScalar]
    """l and g: velocity of the anchor and spin per generalised impulse."""
    drags: list[Drag]
    brakes: list[Brake]
    """Friction against spin from the floor."""
    joint: Brake | None
    """Friction of the pin, zero unless it holds (l is zero then)."""

    @property
    def all_brakes(self) -> list[Brake]:
        """Every friction against spin."""
        return self.brakes + ([] if self.joint is None else [self.joint])


def slip_scale(square: FloatScalar) -> FloatScalar:
    """What scales the viscous force back onto the limits, from s²: min(1, 1/s)."""
    return 1.0 / jnp.sqrt(jnp.maximum(square, 1.0))


def _slide(drag: Drag, z: Triple, one: FloatScalar):
    """Velocity that friction sees, scale of the viscous force, and its loss by slip."""
    u = tuple(
        hold(dot3(row, z) + drift, one)
        for row, drift in zip(drag.speed, drag.drift, strict=True)
    )
    square = (drag.knee[0] * u[0]) ** 2 + (drag.knee[1] * u[1]) ** 2
    return u, slip_scale(square), square > 1.0


def _turn(brake: Brake, z: Triple):
    u = brake.share * z[2] + brake.drift
    square = (brake.knee * u) ** 2
    return u, slip_scale(square), square > 1.0


def residual(problem: SlidingProblem, z: Triple, one: FloatScalar) -> Triple:
    """Z - L (P - F^T f): zero at the solution."""
    impulse = list(problem.push)
    for drag in problem.drags:
        u, scale, _ = _slide(drag, z, one)
        for row, c, speed in zip(drag.force, drag.viscous, u, strict=True):
            pull = scale * c * speed
            impulse = [p - t * pull for p, t in zip(impulse, row, strict=True)]
    for brake in problem.all_brakes:
        u, scale, _ = _turn(brake, z)
        impulse[2] = impulse[2] - scale * brake.viscous * u
    slide, turn = problem.ease
    return (
        z[0] - slide * impulse[0],
        z[1] - slide * impulse[1],
        z[2] - turn * impulse[2],
    )


def _jacobian(problem: SlidingProblem, z: Triple, one: FloatScalar):
    """Derivative of the residual, rows of entries.

    With A = F^T C u and B = S^T (knee² u), a slipping contact's part is
    scale (F^T C S - scale² A B^T).
    """
    zero = jnp.zeros_like(problem.ease[1])
    entries = [[zero] * 3 for _ in range(3)]
    for drag in problem.drags:
        force, speed, c = drag.force, drag.speed, drag.viscous
        u, scale, is_slip = _slide(drag, z, one)
        loss = jnp.where(is_slip, scale * scale * scale, 0.0)
        k = tuple(g * g * v for g, v in zip(drag.knee, u, strict=True))
        pull = [c[0] * u[0] * f + c[1] * u[1] * g for f, g in zip(*force, strict=True)]
        pinch = [k[0] * f + k[1] * g for f, g in zip(*speed, strict=True)]
        for i in range(3):
            for j in range(3):
                stick = (
                    c[0] * force[0][i] * speed[0][j] + c[1] * force[1][i] * speed[1][j]
                )
                entries[i][j] = (
                    entries[i][j] + scale * stick - loss * pull[i] * pinch[j]
                )
    for brake in problem.all_brakes:
        _, _, is_slip = _turn(brake, z)
        # Where it slips, in one dimension, the torque is constant.
        entries[2][2] = entries[2][2] + jnp.where(
            is_slip, 0.0, brake.viscous * brake.share
        )
    ease = (problem.ease[0], problem.ease[0], problem.ease[1])
    return [
        [hold(e * entries[i][j] + (1.0 if i == j else 0.0), one) for j in range(3)]
        for i, e in enumerate(ease)
    ]


def _newton(problem: SlidingProblem, one: FloatScalar) -> Triple:
    """Several contacts: start from all of them sticking, then iterate."""
    zero = jnp.zeros_like(problem.push[0] * one)
    no_limit = problem._replace(
        drags=[d._replace(knee=(zero, zero)) for d in problem.drags],
        brakes=[b._replace(knee=zero) for b in problem.all_brakes],
        joint=None,
    )
    start = (zero, zero, zero)
    z = _newton_step(no_limit, start, one)
    if not (problem.drags or problem.all_brakes):
        return z
    return jax.lax.fori_loop(
        0, _NUM_NEWTON, lambda _, z: _newton_step(problem, z, one), z
    )


def _newton_step(problem: SlidingProblem, z: Triple, one: FloatScalar) -> Triple:
    miss = tuple(hold(r, one) for r in residual(problem, z, one))
    change = solve3(_jacobian(problem, z, one), miss)
    return tuple(hold(a - b, one) for a, b in zip(z, change, strict=True))


def solve_sliding(problem: SlidingProblem, one: FloatScalar) -> Triple:
    """Velocity of the anchor and spin at the end of a step.

    Args:
        problem: momenta and frictions.
        one: from `runtime_one`.

    Returns:
        The anchor's velocity [m/s], in the frame at mid-step, and the spin [rad/s].
        Differentiable by the implicit function theorem.
    """

    @jax.custom_jvp
    def solve(problem, one):
        if len(problem.drags) <= 1 and not problem.brakes:
            drag = problem.drags[0] if problem.drags else None
            return slipping_wheel(problem.push, problem.ease, drag, problem.joint, one)
        return _newton(problem, one)

    def solve_jvp(primals, tangents):
        (problem, one), (rate, _) = primals, tangents
        z = solve(problem, one)
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
            return residual(jax.tree.unflatten(treedef, full), z, one)

        _, rate = jax.jvp(
            miss, ([leaves[i] for i in moving],), ([rates[i] for i in moving],)
        )
        inverse = [
            [hold(entry, one) for entry in row]
            for row in inverse3(_jacobian(problem, z, one))
        ]
        rate = tuple(-hold(r, one) for r in rate)
        return z, tuple(hold(v, one) for v in matvec3(inverse, rate))

    solve.defjvp(solve_jvp, symbolic_zeros=True)
    return solve(problem, one)
