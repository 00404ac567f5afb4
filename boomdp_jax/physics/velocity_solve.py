r"""One implicit velocity update: friction and joints solved together.

Unknown are the twists $w$ (each in its body's frame at mid-step) and the joint
impulses $\lambda$:

$$M w = p + h\,T^T f(\bar u) + J_m^T \lambda, \qquad J_e w = 0, \qquad
  \bar u = T(\vartheta w + (1-\vartheta) w_0),$$

$J_m$ taken at mid-step, where the impulse acts on average, and $J_e$ at its end, where
the joint must hold. Newton's method starts from the solution in which every contact
sticks: from there a contact that slips is left on its own side, and a contact that
sticks is already solved. Derivatives come from the implicit function theorem at the
solution, not through the iterations, in both modes.

Compared on a body with pin and wheel, against two-stage L-stable Runge-Kutta (twice the
cost, and dry friction then overshoots at the moment of stopping by up to half of a
step's impulse) and against backward Euler in four substeps (twice the cost, four times
the error of a wheel's decay).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.friction import NUM_NEWTON, Contact, Spin, limited
from boomdp_jax.physics.joints import Row, Slot, select
from boomdp_jax.physics.small_linear import dot3, inverse3, matvec3, solve_rows

PerBody = Float[Array, "*body"]
Twist = tuple[PerBody, PerBody, PerBody]


class VelocityProblem(NamedTuple):
    """Everything that the velocity update depends on."""

    mobile: PerBody
    """One, or zero for a static body, which nothing moves."""
    mass: PerBody
    inertia: PerBody
    momentum: Twist
    """p: momentum with the impulse of all known forces, body frame at mid-step."""
    start: Twist
    """w_0, in the same frame."""
    turn: tuple[PerBody, PerBody]
    """Cosine and sine of half the turn of the step."""
    contacts: Contact | None
    """All contacts along a leading axis, with impulses in place of forces: coefficients
    times the length of the step."""
    spins: Spin | None
    """Likewise."""
    rows_mid: list[Row]
    rows_end: list[Row]
    compliance: list[Float[Array, ""]]
    """What keeps redundant and inactive rows solvable."""
    joint_spins: list[tuple[Slot, Spin]]
    """Friction of joints between two bodies (scenes of several bodies)."""


class Solution(NamedTuple):
    """Twists at the end of the step, and the impulses of rows and joint frictions."""

    twist: Twist
    impulse: list[Float[Array, ""]]


def _blend(weight, end, start):
    return weight * end + (1.0 - weight) * start


def _end_rows(problem: VelocityProblem):
    """T at the end of the step, where a stiff contact must not slip.

    Twists are in the frame at mid-step, half a turn before: T turns along.
    """
    contact: Any = problem.contacts
    cos, sin = (t[None] for t in problem.turn)
    return tuple(
        (cos * row[0] - sin * row[1], sin * row[0] + cos * row[1], row[2])
        for row in (contact.rolling, contact.lateral)
    )


def _start_speed(problem: VelocityProblem):
    """Contact velocity at the start of the step, half a turn before mid-step."""
    contact: Any = problem.contacts
    cos, sin = (t[None] for t in problem.turn)
    x, y, spin = (v[None] for v in problem.start)
    start = (cos * x - sin * y, sin * x + cos * y, spin)
    return tuple(dot3(row, start) for row in (contact.rolling, contact.lateral))


def _contact_speed(problem: VelocityProblem, w: Twist):
    """Rolling and lateral velocity that friction sees, contact axis first."""
    contact: Any = problem.contacts
    each = tuple(v[None] for v in w)
    return tuple(
        _blend(weight, dot3(row, each), start)
        for weight, row, start in zip(
            contact.weight,
            _end_rows(problem),
            _start_speed(problem),
            strict=True,
        )
    )


def _spin_speed(spin: Spin, w: Twist, start: Twist):
    return _blend(spin.weight, w[2][None], start[2][None])


def _joint_speed(slot: Slot, spin: Spin, w: Twist, start: Twist):
    def relative(v):
        return slot.active * (select(slot.a, v) - select(slot.b, v))

    return _blend(spin.weight, relative(w[2]), relative(start[2]))


def _residual(
    problem: VelocityProblem, solution: Solution, before: Twist | None = None
):
    """How far from solved: per body three numbers, then one per row."""
    w, start = solution.twist, problem.start
    out = [
        problem.mass * w[0] - problem.momentum[0],
        problem.mass * w[1] - problem.momentum[1],
        problem.inertia * w[2] - problem.momentum[2],
    ]
    contact, spin = problem.contacts, problem.spins
    if contact is not None:
        u = _contact_speed(problem, w)
        old = None if before is None else _contact_speed(problem, before)
        scale, _ = limited(u, contact.viscous, contact.knee, old)
        rolling = scale * contact.viscous[0] * u[0]
        lateral = scale * contact.viscous[1] * u[1]
        out = [
            o + jnp.sum(rolling * r + lateral * t, axis=0)
            for o, r, t in zip(out, contact.rolling, contact.lateral, strict=True)
        ]
    if spin is not None:
        u = _spin_speed(spin, w, start)
        old = None if before is None else (_spin_speed(spin, before, start),)
        scale, _ = limited((u,), (spin.viscous,), (spin.knee,), old)
        out[2] = out[2] + jnp.sum(scale * spin.viscous * u, axis=0)
    num = len(problem.rows_mid)
    for row, impulse in zip(problem.rows_mid, solution.impulse[:num], strict=True):
        out = [o - j * impulse for o, j in zip(out, row.push(), strict=True)]
    tail = [
        row.velocity(w) + compliance * impulse
        for row, compliance, impulse in zip(
            problem.rows_end, problem.compliance, solution.impulse[:num], strict=True
        )
    ]
    for (slot, joint), impulse in zip(
        problem.joint_spins, solution.impulse[num:], strict=True
    ):
        weight_a: Any = slot.a
        out[2] = out[2] - impulse * slot.active * (weight_a - slot.b)
        u = _joint_speed(slot, joint, w, start)
        old = None if before is None else (_joint_speed(slot, joint, before, start),)
        scale, _ = limited((u,), (joint.viscous,), (joint.knee,), old)
        tail.append(scale * joint.viscous * u + impulse)
    return tuple(out), tail


def slopes_of(problem: VelocityProblem, w: Twist, before: Twist | None = None):
    """K of every friction at a twist.

    Args:
        problem: frictions.
        w: the twist.
        before: the twist in the iteration before (see `friction.is_reversed`).

    Returns:
        Of contacts, of spins and of joints between two bodies.
    """
    start, contact, spin = problem.start, problem.contacts, problem.spins
    k_contact = k_spin = None
    if contact is not None:
        u = _contact_speed(problem, w)
        old = None if before is None else _contact_speed(problem, before)
        _, k_contact = limited(u, contact.viscous, contact.knee, old)
    if spin is not None:
        u = _spin_speed(spin, w, start)
        old = None if before is None else (_spin_speed(spin, before, start),)
        _, ((k_spin,),) = limited((u,), (spin.viscous,), (spin.knee,), old)
    k_joints = []
    for slot, joint in problem.joint_spins:
        u = _joint_speed(slot, joint, w, start)
        old = None if before is None else (_joint_speed(slot, joint, before, start),)
        _, ((k,),) = limited((u,), (joint.viscous,), (joint.knee,), old)
        k_joints.append(k)
    return k_contact, k_spin, k_joints


def damped_inertia(problem: VelocityProblem, k_contact, k_spin):
    """M + T^T K Theta T, as rows of entries.

    Args:
        problem: masses and frictions.
        k_contact: K of contacts (`slopes_of`).
        k_spin: K of spins.

    Returns:
        What momentum per twist is like to forces from outside.
    """
    zero = jnp.zeros_like(problem.mass)
    a = [
        [problem.mass, zero, zero],
        [zero, problem.mass, zero],
        [zero, zero, problem.inertia],
    ]
    contact, spin = problem.contacts, problem.spins
    if contact is not None:
        rows, end = (contact.rolling, contact.lateral), _end_rows(problem)
        k = [[k_contact[i][j] * contact.weight[j] for j in range(2)] for i in range(2)]
        for m in range(3):
            pulls = [sum(k[i][j] * rows[i][m] for i in range(2)) for j in range(2)]
            for n in range(3):
                entry = pulls[0] * end[0][n] + pulls[1] * end[1][n]
                a[m][n] = a[m][n] + jnp.sum(entry, axis=0)
    if spin is not None:
        a[2][2] = a[2][2] + jnp.sum(k_spin * spin.weight, axis=0)
    return a


def _solve_linear(
    problem: VelocityProblem, slopes, rhs: Twist, rhs_rows: list
) -> Solution:
    """Solve the system linearised with the given slopes of friction."""
    k_contact, k_spin, k_joints = slopes
    one = runtime_one(problem.mass)

    def held(values):
        return jax.tree.map(lambda v: hold(v, one), values)

    inverse = inverse3(held(damped_inertia(problem, k_contact, k_spin)))
    inverse = held([[problem.mobile * entry for entry in row] for row in inverse])
    free = matvec3(inverse, held(rhs))
    num, num_joints = len(problem.rows_mid), len(problem.joint_spins)
    if num + num_joints == 0:
        return Solution(free, [])
    # Each row moves bodies along columns A^-1 J_mid^T.
    dtype = problem.mass.dtype
    unit, none = jnp.ones((), dtype), jnp.zeros((), dtype)
    turning = [
        Row(slot, (none, none, slot.active), (none, none, -slot.active), none)
        for slot, _ in problem.joint_spins
    ]
    end = problem.rows_end + turning
    columns = [held(matvec3(inverse, row.push())) for row in problem.rows_mid + turning]
    free = held(free)
    gains = [unit] * num + [
        k * spin.weight
        for k, (_, spin) in zip(k_joints, problem.joint_spins, strict=True)
    ]
    diagonal = problem.compliance + [unit] * num_joints
    matrix = [
        [
            gains[i] * end[i].velocity(columns[j]) + (diagonal[i] if i == j else 0.0)
            for j in range(len(columns))
        ]
        for i in range(len(end))
    ]
    impulse = solve_rows(
        matrix,
        [rhs_rows[i] - gains[i] * end[i].velocity(free) for i in range(len(end))],
    )
    impulse = [hold(v, jnp.reshape(one, (-1,))[0]) for v in impulse]
    twist = list(free)
    for column, strength in zip(columns, impulse, strict=True):
        twist = [t + c * strength for t, c in zip(twist, column, strict=True)]
    return Solution(tuple(twist), impulse)


def _newton(problem: VelocityProblem) -> Solution:
    """Start from sticking contacts, then iterate."""
    num = len(problem.rows_mid) + len(problem.joint_spins)
    zero = jnp.zeros_like(problem.mass)
    rest = Solution((zero, zero, zero), [jnp.zeros((), zero.dtype)] * num)
    # Sticking is the viscous law without limits, whose solution is one linear solve.
    sticking = _unlimited(problem)
    solution = newton_step(sticking, rest, None)
    if problem.contacts is None and problem.spins is None and not problem.joint_spins:
        return solution

    def advance(_, pair):
        solution, before = pair
        return newton_step(problem, solution, before), solution.twist

    first = (solution, solution.twist)
    return jax.lax.fori_loop(0, NUM_NEWTON, advance, first)[0]


def _unlimited(problem: VelocityProblem) -> VelocityProblem:
    def free(friction):
        if friction is None:
            return None
        return friction._replace(knee=jax.tree.map(jnp.zeros_like, friction.knee))

    return problem._replace(
        contacts=free(problem.contacts),
        spins=free(problem.spins),
        joint_spins=[(slot, free(spin)) for slot, spin in problem.joint_spins],
    )


def newton_step(
    problem: VelocityProblem, solution: Solution, before: Twist | None
) -> Solution:
    """One iteration of Newton's method.

    Args:
        problem: momenta, frictions and joint rows.
        solution: where it starts.
        before: the twist in the iteration before.

    Returns:
        Twists and impulses of the system linearised there.
    """
    out, tail = _residual(problem, solution, before)
    step = _solve_linear(
        problem,
        slopes_of(problem, solution.twist, before),
        tuple(-o for o in out),
        [-t for t in tail],
    )
    return jax.tree.map(jnp.add, solution, step)


def solve_velocity(problem: VelocityProblem) -> Solution:
    """Solve one velocity update.

    Args:
        problem: momenta, frictions and joint rows.

    Returns:
        Twists and impulses. Differentiable by the implicit function theorem.
    """

    @jax.custom_jvp
    def solve(problem):
        return _newton(problem)

    def solve_jvp(primals, tangents):
        (problem,), (rate,) = primals, tangents
        solution = solve(problem)
        leaves, treedef = jax.tree.flatten(problem)
        rates = jax.tree.leaves(
            rate, is_leaf=lambda x: isinstance(x, jax.custom_derivatives.SymbolicZero)
        )
        moving = [
            i
            for i, r in enumerate(rates)
            if not isinstance(r, jax.custom_derivatives.SymbolicZero)
        ]

        def residual(values):
            full = list(leaves)
            for i, value in zip(moving, values, strict=True):
                full[i] = value
            return _residual(jax.tree.unflatten(treedef, full), solution)

        _, (out, tail) = jax.jvp(
            residual, ([leaves[i] for i in moving],), ([rates[i] for i in moving],)
        )
        tangent = _solve_linear(
            problem,
            slopes_of(problem, solution.twist),
            tuple(-o for o in out),
            [-t for t in tail],
        )
        return solution, tangent

    solve.defjvp(solve_jvp, symbolic_zeros=True)
    return solve(problem)
