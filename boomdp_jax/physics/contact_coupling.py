r"""Contact together with friction of wheels and floor, and with joints.

Momentum balance of a substep with the impulses $P$ of contacts is that without them
with $p + P$ in place of $p$ (`velocity_solve`). Both sides take turns: a sweep over
contacts, in which a body answers to an impulse with what its pins to the world, and
friction that cannot slip, leave it to move,

$$A^{-1} = (M + T^T K T)^{-1}, \qquad
  A^{-1} \leftarrow A^{-1} - \frac{A^{-1}J^TJA^{-1}}{JA^{-1}J^T},$$

then friction and joints are solved anew. What is left over is what the last solve
changes; it vanishes from one substep to the next where forces last.

What may slip is left out of $K$. Momentum balance with dry friction minimises a convex
function of twists whose curvature is least where everything slips; a sweep that takes
a body to answer as it does there never gives more than is missing. With the slope at
the present twist instead, a body that stands on stiff dry feet (1e5 N s/m, 1.5 kg)
takes from a finger at 3 mm/s the impulse that would move it as long as it sticks, and
is thrown 8 mm ahead; with twelve sweeps 0.8 mm, again and again.

All arrays of public functions are in lanes (`core.lanes`).
"""

import functools

import jax
import jax.numpy as jnp

from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.body_friction import (
    BodyAnswer,
    Felt,
    answer_of_bodies,
    friction_of_bodies,
)
from boomdp_jax.physics.contact_rows import Ease
from boomdp_jax.physics.contact_step import (
    Contacts,
    Touch,
    moved_with,
    part_all,
    settle_all,
    sweeping,
    touching,
)
from boomdp_jax.physics.contact_world import each_round
from boomdp_jax.physics.general_step import projected, velocity_problem
from boomdp_jax.physics.joints import Rows
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.small_linear import dot3, matvec3
from boomdp_jax.physics.velocity_search import solve_again, solve_velocity
from boomdp_jax.physics.velocity_solve import Solved, VelocityProblem

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
    # Under the impulses of the substep before.
    solved = solve_velocity(_pushed(problem, sums))
    twists = solved.solution.twist
    ease = _ease(problem, _sure_answer(problem, twists))
    eases = each_round(ease, num_bodies)
    sweep, meetings = sweeping(contacts, eases, prepared.length), []

    def answered(before: Solved, old: tuple, sums: tuple) -> Solved:
        """Friction and joints under the impulses of contacts."""
        changes = [jnp.any(p != q, axis=0) for p, q in zip(old, sums, strict=True)]
        has_changed = functools.reduce(jnp.logical_or, changes)
        return solve_again(_pushed(problem, sums), before.solution, has_changed)

    before = moved, tuple(motion[3:])
    for _ in range(num_sweeps):
        sweep, both, impulses, meetings = part_all(
            sweep, before, (*twists, *sums), impulses
        )
        solved, sums = answered(solved, sums, both[3:]), both[3:]
        twists = solved.solution.twist
    touches = touching(contacts, [problem.mobile / problem.mass * p for p in sums])
    place = moved_with(motion, touches, twists, prepared.length)
    both, impulses = settle_all(sweep, meetings, (*twists, *sums), impulses)
    solved, sums = answered(solved, sums, both[3:]), both[3:]
    final = Motion(*place, *solved.solution.twist)
    final = projected(
        prepared,
        problem,
        solved.is_settled,
        force,
        motion,
        final,
        # Smoothed contacts push before bodies touch.
        is_closed=contacts.smoothing is None,
    )
    return final, Touch(impulses, sums)


def _pushed(problem: VelocityProblem, sums: tuple) -> VelocityProblem:
    """With the impulses of contacts among the momenta."""
    x, y, spin = (p + q for p, q in zip(problem.momentum, sums, strict=True))
    return problem._replace(momentum=(x, y, spin))


def _sure_answer(problem: VelocityProblem, twist: tuple) -> BodyAnswer:
    """What bodies answer to an impulse, held only by friction that cannot slip.

    Friction counts as far as its dry limit is not reached at twice the speeds that
    there are; the impulse that would move a body that sticks, as long as it sticks, is
    far too much for one that slips.

    Args:
        problem: frictions and speeds at the start.
        twist: at the end, as far as it is known.

    Returns:
        A^-1, joints apart.
    """
    now = jax.lax.stop_gradient((problem.start, twist))
    fastest = functools.reduce(jnp.maximum, [jnp.hypot(x, y) for x, y, _ in now])
    spinning = functools.reduce(jnp.maximum, [jnp.abs(spin) for _, _, spin in now])
    fastest, spinning = (jnp.max(v, axis=0)[None, None] for v in (fastest, spinning))

    def surely(viscous, knee, seen):
        return viscous * jnp.clip(2.0 - 2.0 * knee * seen, 0.0, 1.0)

    contacts, spins = problem.contacts, problem.spins
    if contacts is not None:
        arms = contacts.rolling[2], contacts.lateral[2]
        seen = [fastest + jnp.abs(arm) * spinning for arm in arms]
        x, y = map(surely, contacts.viscous, contacts.knee, seen)
        contacts = contacts._replace(viscous=(x, y))
    if spins is not None:
        spins = spins._replace(viscous=surely(spins.viscous, spins.knee, spinning))
    felt = Felt(problem.frame, problem.turn, problem.start, twist, twist)
    friction = friction_of_bodies(contacts, spins, felt, 0.0)
    zero = jnp.zeros_like(problem.mass)
    return answer_of_bodies(problem, friction, twist, (zero, zero, zero))[0]


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
