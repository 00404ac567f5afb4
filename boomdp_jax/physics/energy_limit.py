"""No energy out of nothing, island by island.

Where bodies turn so far in a substep that the rows of their joints are not what they
were, or come far off them, or where Newton's method has not come to rest, or a contact
kicks what joints hold, a step is wrong whatever it does. Twists are then scaled down,
which joints do not notice, to the kinetic energy at the start and the work of forces
and motors. Bodies that nothing joins have nothing to do with it: an island is what
joints tie together, and all bodies in contact, since impulses of contacts bring energy
from one to the other. (Whether Newton's method came to rest is known of a world alone.)

All arrays are in lanes (`core.lanes`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.physics.islands import joined_by_contact, over_islands
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Prepared

# More of its kinetic energy no substep adds to an island out of nothing; where a
# linkage comes close to a dead centre, it may come to a third.
_MOST_GAIN = 0.005
# Roundings of a coordinate that a displacement may be off by.
_ROUNDING = 4.0

PerBody = Float[Array, "body lane"]


class Doubts(NamedTuple):
    """Where a substep cannot be right."""

    is_settled: Bool[Array, " lane"]
    """Whether Newton's method came to rest."""
    is_wrong: Bool[Array, "body lane"]
    """Bodies with joints or friction that turned or went too far."""
    is_closed: bool
    """Whether nothing but forces and motors brings energy."""


def limited_energy(
    prepared: Prepared,
    start: Motion,
    end: Motion,
    force: tuple,
    motors: PerBody | float,
    touches: PerBody | None,
    doubts: Doubts,
) -> Motion:
    """The end of a substep without energy that nothing brought.

    Args:
        prepared: what does not depend on the state.
        start: of the substep.
        end: of the substep.
        force: world frame, at the centres of mass [N, N, N m].
        motors: most work that motors can have done, by a body that each moves.
        touches: share of contact in a body's motion; None: nothing touches.
        doubts: about this substep.

    Returns:
        The end, with twists scaled down where needed.
    """
    half_mass = 0.5 * prepared.mobile * prepared.mass
    half_inertia = 0.5 * prepared.mobile * prepared.inertia

    def kinetic(motion: Motion) -> PerBody:
        linear = half_mass * (motion.vx**2 + motion.vy**2)
        return linear + half_inertia * motion.spin**2

    length = prepared.length[None]
    weight = [w / length for w in prepared.weight]
    forces = (force[0] + weight[0], force[1] + weight[1], force[2])
    work = sum(
        prepared.mobile * f * (new - old)
        for f, new, old in zip(forces, end[:3], start[:3], strict=True)
    )
    # Where a body hardly moves, the work on it is rounding of where it is.
    rounding = _ROUNDING * float(jnp.finfo(end.x.dtype).eps)
    slack = sum(
        prepared.mobile * jnp.abs(f) * jnp.maximum(jnp.abs(new), jnp.abs(old))
        for f, new, old in zip(forces, end[:3], start[:3], strict=True)
    )
    slack = rounding * jax.lax.stop_gradient(slack)
    is_right = ~doubts.is_wrong & doubts.is_settled[None]
    first, present = kinetic(start), kinetic(end)
    motors = jnp.broadcast_to(motors, first.shape)
    islands = prepared.islands
    if touches is not None and islands is not None:
        islands = joined_by_contact(islands, touches)
    first, present, work, motors, slack, num_wrong = over_islands(
        islands,
        (first, present, work, motors, slack, (~is_right).astype(first.dtype)),
    )
    is_right = num_wrong == 0.0
    allowed = jnp.maximum(first + work + motors, 0.0) + slack
    # Overlapping bodies may be moved up without being paid for it.
    most = first + jnp.maximum(work, 0.0) + motors + slack
    is_kicked = doubts.is_closed & (present > (1.0 + _MOST_GAIN) * most)
    allowed = jnp.where(is_right, most, allowed)
    is_much = (~is_right | is_kicked) & (present > allowed)
    ratio = allowed / jnp.where(is_much, present, 1.0)
    # No derivative of the root of nothing.
    has_ratio = is_much & (ratio > 0.0)
    root = jnp.sqrt(jnp.where(has_ratio, ratio, 1.0))
    scale = jnp.where(is_much, jnp.where(has_ratio, root, 0.0), 1.0)
    return end._replace(vx=scale * end.vx, vy=scale * end.vy, spin=scale * end.spin)
