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
from typing import Any, NamedTuple

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
    NUM_POINTS,
    Contacts,
    Impulses,
    Meetings,
    Sweeping,
    Touch,
    moved_with,
    part_all,
    settle_all,
    sweeping,
    touching,
)
from boomdp_jax.physics.general_step import projected, velocity_problem
from boomdp_jax.physics.joints import Rows
from boomdp_jax.physics.many_bodies import is_many
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.small_linear import dot3, matvec3
from boomdp_jax.physics.tournament import (
    Rounds,
    as_rounds,
    each_round,
    num_rounds,
    num_seats,
)
from boomdp_jax.physics.velocity_search import solve_from
from boomdp_jax.physics.velocity_solve import Solution, VelocityProblem, first_guess

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
    problem = velocity_problem(prepared, motion, force)
    before = moved, tuple(motion[3:])
    num_bodies = motion.x.shape[0]
    stage = _first_stage(problem, motion, touch)
    given = sweeping(contacts, stage.eases, prepared.length, num_bodies)

    def sweep_with(stage: _Stage) -> Sweeping:
        return given._replace(eases=stage.eases)

    def begun(stage: _Stage) -> _Stage:
        """Nothing but the impulses of the substep before."""
        return stage

    def eased(stage: _Stage) -> _Stage:
        """Bodies answer to contacts as the first solve has it; the first sweep."""
        answer = _sure_answer(problem, stage.solution.twist)
        eases = each_round(_ease(problem, answer), num_bodies)
        return parted(stage._replace(eases=eases))

    def parted(stage: _Stage) -> _Stage:
        """A sweep before bodies are moved."""
        both = (*stage.solution.twist, *stage.sums)
        _, both, impulses, meetings = part_all(
            sweep_with(stage), before, both, stage.impulses
        )
        return stage._replace(sums=both[3:], impulses=impulses, meetings=meetings)

    def settled(stage: _Stage) -> _Stage:
        """Bodies are moved; the last sweep."""
        twists, sums = stage.solution.twist, stage.sums
        touches = touching(contacts, [problem.mobile / problem.mass * p for p in sums])
        place = moved_with(motion, touches, twists, prepared.length)
        both = (*twists, *sums)
        both, impulses = settle_all(
            sweep_with(stage), stage.meetings, both, stage.impulses
        )
        return stage._replace(place=tuple(place), sums=both[3:], impulses=impulses)

    ways = (begun, eased, parted, settled)

    def advance(stage: _Stage, way) -> tuple[_Stage, None]:
        """Contacts, then friction and joints under their impulses."""
        is_loop = not isinstance(way, int)
        new = jax.lax.switch(way, ways, stage) if is_loop else ways[way](stage)
        changes = [
            jnp.any(p != q, axis=0) for p, q in zip(stage.sums, new.sums, strict=True)
        ]
        is_open = functools.reduce(jnp.logical_or, changes) | (way == 0)
        turn = jnp.minimum(way, 1)
        solved = solve_from(_pushed(problem, new.sums), new.solution, is_open, turn)
        return new._replace(solution=solved.solution, is_done=solved.is_settled), None

    order = [0, 1, *[2] * (num_sweeps - 1), 3]
    if is_many(num_bodies):
        # Sweeps and solves are compiled once.
        stage, _ = jax.lax.scan(advance, stage, jnp.asarray(order, jnp.int32))
    else:
        for way in order:
            stage, _ = advance(stage, way)
    final = Motion(*stage.place, *stage.solution.twist)
    final = projected(
        prepared,
        problem,
        stage.is_done,
        force,
        motion,
        final,
        touches=touching(
            contacts, [problem.mobile / problem.mass * p for p in stage.sums]
        ),
        # Smoothed contacts push before bodies touch.
        is_closed=contacts.smoothing is None,
    )
    return final, Touch(stage.impulses, stage.sums)


class _Stage(NamedTuple):
    """What is known between a solve and the next sweep."""

    solution: Solution
    is_done: Any
    """Whether the solve came to rest."""
    sums: tuple
    impulses: Impulses
    eases: Rounds
    meetings: Meetings
    place: tuple


def _first_stage(problem: VelocityProblem, motion: Motion, touch: Touch) -> _Stage:
    """Before the first solve; what later stages fill in is blank."""
    num_bodies, zero = motion.x.shape[0], jnp.zeros_like(motion.x)
    eases = each_round(Ease(zero, zero, zero, (zero, zero, zero)), num_bodies)
    shape = (num_rounds(num_bodies), num_seats(num_bodies) // 2, motion.x.shape[-1])
    none = jnp.zeros(shape, motion.x.dtype)
    return _Stage(
        first_guess(problem),
        jnp.ones(motion.x.shape[-1], bool),
        touch.sums,
        touch.impulses,
        eases,
        as_rounds([none] * NUM_POINTS, num_bodies),
        tuple(motion[:3]),
    )


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
        arms = [jnp.abs(row[2]) for row in (contacts.rolling, contacts.lateral)]
        if contacts.size is not None:
            # Feet rub alike in every direction.
            most = jnp.maximum(*arms)[-contacts.size.shape[0] :]
            arms = [arm.at[-contacts.size.shape[0] :].set(most) for arm in arms]
        seen = [fastest + arm * spinning for arm in arms]
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
