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

import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.body_friction import BodyAnswer
from boomdp_jax.physics.contact_rows import Ease
from boomdp_jax.physics.contact_step import (
    Contacts,
    Touch,
    moved_with,
    part_all,
    settle_all,
)
from boomdp_jax.physics.contact_world import each_round
from boomdp_jax.physics.general_step import projected, velocity_problem
from boomdp_jax.physics.joints import Rows
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.small_linear import dot3, matvec3
from boomdp_jax.physics.velocity_solve import (
    VelocityProblem,
    answer_at,
    newton_step,
    solve_velocity,
)

# Below this share of a free body's answer a row has nothing left to hold.
_TINY_EASE = 1e-6


def is_coupled(prepared: Prepared) -> bool:
    """Whether anything but contact can hold a body of this scene."""
    joints = prepared.joints
    holds = (
        prepared.contacts,
        prepared.spins,
        joints.points,
        joints.rods,
        joints.angles,
    )
    return any(part is not None for part in holds)


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
    problem = velocity_problem(prepared, motion, force)
    sums, impulses = touch.sums, touch.impulses
    # Under the impulses of the substep before: a body that is pushed along the floor
    # slips, and answers to a change of them as one that does.
    solved = solve_velocity(_pushed(problem, sums))
    is_settled, twists = solved.is_settled, solved.solution.twist
    ease = _ease(problem, answer_at(problem, twists))
    rate = 1.0 / prepared.length

    def answered(twists, sums, before):
        """Friction and joints under the impulses of contacts."""
        found = before.solution
        guess = found._replace(twist=twists, before=found.twist)
        return newton_step(_pushed(problem, sums), guess)

    for _ in range(num_sweeps):
        both, impulses = part_all(
            contacts,
            each_round(ease, num_bodies),
            rate,
            moved,
            (*twists, *sums),
            impulses,
        )
        sums = both[3:]
        solved = answered(both[:3], sums, solved)
        twists = solved.solution.twist
        ease = _ease(problem, answer_at(problem, twists))
    place = moved_with(motion, _touches(sums), twists, prepared.length)
    both, impulses = settle_all(
        contacts,
        each_round(ease, num_bodies),
        tuple(motion[3:]),
        (*twists, *sums),
        impulses,
    )
    sums = both[3:]
    solved = answered(both[:3], sums, solved)
    final = Motion(*place, *solved.solution.twist)
    final = projected(prepared, problem, is_settled, force, motion, final)
    return final, Touch(impulses, sums)


def _touches(sums: tuple) -> Bool[Array, "body lane"]:
    return (sums[0] != 0.0) | (sums[1] != 0.0) | (sums[2] != 0.0)


def _pushed(problem: VelocityProblem, sums: tuple) -> VelocityProblem:
    """With the impulses of contacts among the momenta."""
    x, y, spin = (p + q for p, q in zip(problem.momentum, sums, strict=True))
    return problem._replace(momentum=(x, y, spin))


def _ease(problem: VelocityProblem, answer: BodyAnswer) -> Ease:
    """What a body's friction and its pins to the world leave it to move."""
    rows, held = problem.rows_mid, []
    if rows is not None:
        for row in range(rows.a.shape[0]):
            held.append(_of_row(rows, row, problem.mass.shape[0]))
    return Ease(*elementwise(_left, problem.mass, answer, held))


def _of_row(rows: Rows, row: int, num_bodies: int) -> tuple:
    """Which bodies a row ties to the world, and how; `[body, lane]`."""
    body = jnp.arange(num_bodies, dtype=rows.a.dtype)[:, None]
    is_held = (rows.a[row][None] == body) & (rows.b[row][None] == WORLD)
    return is_held.astype(rows.a.dtype), *(j[row][None] for j in rows.ja)


def _left(mass, answer: BodyAnswer, held: list) -> tuple:
    """Of one body in scalars."""
    xy = xs = ys = jnp.zeros_like(mass)
    if answer.mixed:
        # Contacts take the answer to be symmetric, which it is to first order.
        xy, xs, ys = (
            0.5 * (answer.mixed[i] + answer.mixed[i + 1]) for i in range(0, 6, 2)
        )
    inverse = [[answer.xx, xy, xs], [xy, answer.yy, ys], [xs, ys, answer.spin]]
    for is_held, *push in held:
        given = matvec3(inverse, push)
        total = dot3(push, given)
        can_hold = total * mass > _TINY_EASE
        share = jnp.where(can_hold, is_held / jnp.where(can_hold, total, 1.0), 0.0)
        inverse = [
            [inverse[i][j] - given[i] * given[j] * share for j in range(3)]
            for i in range(3)
        ]
    (xx, xy, xs), (_, yy, ys), (_, _, spin) = inverse
    return xx, yy, spin, (xy, xs, ys)
