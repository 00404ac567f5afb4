r"""Contact together with friction of wheels and floor, and with joints.

Momentum balance of a substep with the impulses $P$ of contacts is that without them
with $p + P$ in place of $p$ (`velocity_solve`). Both sides take turns: a sweep over
contacts, in which a body answers to an impulse with what its own friction and its pins
to the world leave it to move,

$$A^{-1} = (M + T^T K T)^{-1}, \qquad
  A^{-1} \leftarrow A^{-1} - \frac{A^{-1}J^TJA^{-1}}{JA^{-1}J^T},$$

then an iteration of Newton's method for friction and joints, of which bodies that are
tied to others take notice. What is left over is what the last iteration changes; it
vanishes from one substep to the next where forces last.

All arrays of public functions are in lanes (`core.lanes`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.physics.contact_rows import Ease
from boomdp_jax.physics.contact_step import (
    Contacts,
    Touch,
    moved_with,
    part_all,
    settle_all,
)
from boomdp_jax.physics.contact_world import each_round
from boomdp_jax.physics.general_step import to_world, velocity_problem
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.projection import project
from boomdp_jax.physics.small_linear import dot3, inverse3, matvec3
from boomdp_jax.physics.velocity_solve import (
    Solution,
    VelocityProblem,
    damped_inertia,
    newton_step,
    slopes_of,
    solve_velocity,
)

# Below this share of a free body's answer a row has nothing left to hold.
_TINY_EASE = 1e-6


def is_coupled(prepared: Prepared) -> bool:
    """Whether anything but contact can hold a body of this scene."""
    parts = (prepared.contacts, prepared.spins)
    joints = (prepared.slots, prepared.joint_spins)
    return any(part is not None for part in parts) or any(joints)


def coupled_substep(
    contacts: Contacts,
    prepared: Prepared,
    motion: Motion,
    moved: tuple,
    force: tuple,
    touch: Touch,
    num_sweeps: int,
) -> tuple[Motion, Touch]:
    """Advance by one substep.

    Args:
        contacts: of this step.
        prepared: what does not depend on the state.
        motion: at the start of the substep.
        moved: displacement of every body in this step.
        force: world frame, at the centres of mass [N, N, N m].
        touch: from the substep before.
        num_sweeps: iterations before positions are moved.

    Returns:
        The motion at the end, and what the next substep starts with.
    """
    num_bodies = motion.x.shape[0]
    problem, turn = _along(velocity_problem)(prepared, motion, force)
    solution = _along(solve_velocity)(problem)
    free = to_world(solution.twist, *turn)
    rate = 1.0 / prepared.length
    before, sums, impulses = solution.twist, touch.sums, touch.impulses
    ease = _along(_ease)(prepared, problem, solution, before, turn)
    twists = tuple(v + dv for v, dv in zip(free, ease(sums), strict=True))

    def answer(twists, sums):
        """Friction and joints under the impulses of contacts."""
        base = _from_world(twists, *turn)
        pushed = _pushed(problem, sums, *turn)
        new = _along(newton_step)(pushed, Solution(base, solution.impulse), before)
        return new, base

    for _ in range(num_sweeps):
        eases = each_round(ease, num_bodies)
        both, impulses = part_all(
            contacts, eases, rate, moved, (*twists, *sums), impulses
        )
        sums = both[3:]
        solution, before = answer(both[:3], sums)
        twists = to_world(solution.twist, *turn)
        ease = _along(_ease)(prepared, problem, solution, before, turn)
    place = moved_with(motion, _touches(sums), twists, prepared.length)
    both, impulses = settle_all(
        contacts,
        each_round(ease, num_bodies),
        tuple(motion[3:]),
        (*twists, *sums),
        impulses,
    )
    sums = both[3:]
    solution, _ = answer(both[:3], sums)
    final = Motion(*place, *to_world(solution.twist, *turn))
    if prepared.slots:
        final = _along(project)(prepared, final)
    return final, Touch(impulses, sums)


def _along(function):
    """A function of one world, along lanes."""
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def _touches(sums: tuple) -> Bool[Array, "body lane"]:
    return (sums[0] != 0.0) | (sums[1] != 0.0) | (sums[2] != 0.0)


def _from_world(twist: tuple, cos, sin) -> tuple:
    x, y, spin = twist
    return cos * x + sin * y, cos * y - sin * x, spin


def _pushed(problem: VelocityProblem, sums: tuple, cos, sin) -> VelocityProblem:
    """With the impulses of contacts among the momenta."""
    push = _from_world(sums, cos, sin)
    momentum = tuple(p + q for p, q in zip(problem.momentum, push, strict=True))
    return problem._replace(momentum=momentum)


def _ease(
    prepared: Prepared,
    problem: VelocityProblem,
    solution: Solution,
    before: tuple,
    turn: tuple,
) -> Ease:
    """What a body's friction and its pins to the world leave it to move, one world."""
    k_contact, k_spin, _ = slopes_of(problem, solution.twist, before)
    a = damped_inertia(problem, k_contact, k_spin)
    a = [[0.5 * (a[i][j] + a[j][i]) for j in range(3)] for i in range(3)]
    inverse = [[prepared.mobile * v for v in row] for row in inverse3(a)]
    for row in problem.rows_mid:
        if row.slot.a is None:
            continue
        held = row.slot.a * row.slot.is_world.astype(prepared.mass.dtype)
        answer = matvec3(inverse, row.ja)
        total = dot3(row.ja, answer)
        is_held = total * prepared.mass > _TINY_EASE
        share = jnp.where(is_held, held / jnp.where(is_held, total, 1.0), 0.0)
        inverse = [
            [inverse[i][j] - answer[i] * answer[j] * share for j in range(3)]
            for i in range(3)
        ]
    cos, sin = turn
    (xx, xy, xs), (_, yy, ys), (_, _, ss) = inverse
    cross = cos * sin * (xx - yy)
    return Ease(
        x=cos * cos * xx - 2.0 * cos * sin * xy + sin * sin * yy,
        y=sin * sin * xx + 2.0 * cos * sin * xy + cos * cos * yy,
        spin=ss,
        mixed=(
            cross + (cos * cos - sin * sin) * xy,
            cos * xs - sin * ys,
            sin * xs + cos * ys,
        ),
    )
