"""Putting joint drift right, in position and in velocity, weighted by mass."""

import jax
import jax.numpy as jnp

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.joints import Frames, Row, joint_rows
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.small_linear import solve_rows
from boomdp_jax.physics.trigonometry import sincos


def ease_between(prepared: Prepared, row: Row, other: Row):
    """J M^-1 J^T between two rows."""
    p, q = row.push(), other.push()
    total = (p[0] * q[0] + p[1] * q[1]) * (prepared.mobile / prepared.mass)
    return jnp.sum(total + p[2] * q[2] * (prepared.mobile / prepared.inertia))


def compliance_of(prepared: Prepared, rows: list[Row]):
    """Enough softness to keep redundant rows solvable; one for inactive rows."""
    tiny = 0.03 * jnp.sqrt(jnp.finfo(prepared.mass.dtype).eps)
    out = []
    for row in rows:
        ease = ease_between(prepared, row, row)
        out.append(jnp.where(ease > 0, tiny * ease, 1.0))
    return out


def project(prepared: Prepared, motion: Motion) -> Motion:
    """Bring poses, then twists, back onto the joints, weighted by mass."""
    one = runtime_one(prepared.mass)

    def held(values):
        return jax.tree.map(lambda v: hold(v, one), values)

    sin, cos = held(sincos(motion.theta))
    dx, dy, dtheta = _correction(prepared, motion, cos, sin, None)
    motion = motion._replace(
        x=motion.x + cos * dx - sin * dy,
        y=motion.y + sin * dx + cos * dy,
        theta=motion.theta + dtheta,
    )
    motion = held(motion)
    sin, cos = held(sincos(motion.theta))
    twist = held(
        (
            cos * motion.vx + sin * motion.vy,
            cos * motion.vy - sin * motion.vx,
            motion.spin,
        )
    )
    dx, dy, dspin = _correction(prepared, motion, cos, sin, twist)
    return held(
        motion._replace(
            vx=motion.vx + cos * dx - sin * dy,
            vy=motion.vy + sin * dx + cos * dy,
            spin=motion.spin + dspin,
        )
    )


def _correction(prepared: Prepared, motion: Motion, cos, sin, twist):
    """Smallest change, in kinetic energy, that zeroes C (or J w where w is given)."""
    frames = Frames(motion.x, motion.y, cos, sin)
    rows = joint_rows(prepared.slots, frames)
    compliance = compliance_of(prepared, rows)
    matrix = [
        [
            ease_between(prepared, rows[i], rows[j])
            + (compliance[i] if i == j else 0.0)
            for j in range(len(rows))
        ]
        for i in range(len(rows))
    ]
    errors = [row.error if twist is None else row.velocity(twist) for row in rows]
    zero = jnp.zeros_like(prepared.mass)
    change = [zero, zero, zero]
    one = jnp.reshape(runtime_one(prepared.mass), (-1,))[0]
    matrix, errors = jax.tree.map(lambda v: hold(v, one), (matrix, errors))
    impulses = [hold(v, one) for v in solve_rows(matrix, errors)]
    for row, impulse in zip(rows, impulses, strict=True):
        change = [c - j * impulse for c, j in zip(change, row.push(), strict=True)]
    light = (prepared.mobile / prepared.mass, prepared.mobile / prepared.inertia)
    change = (change[0] * light[0], change[1] * light[0], change[2] * light[1])
    return tuple(hold(c, one) for c in change)
