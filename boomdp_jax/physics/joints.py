r"""Revolute and distance joints as rows of a linear constraint on twists.

With $p_a = x_a + R_a \, r_a$ the anchor of body a and $p_b$ its partner's (a fixed
point where the partner is the world):

- revolute: $C = p_a - p_b$, two rows; $\dot C = v_a + \omega_a r_a^\perp - v_b -
  \omega_b r_b^\perp$, so $J = [\,I \;\; R_a r_a^\perp \mid -I \;\; -R_b r_b^\perp\,]$;
- distance: $C = |p_a - p_b| - L$, one row, $J = d^T J_{revolute}$ with
  $d = (p_a - p_b)/|p_a - p_b|$;
- effective mass $K = J M^{-1} J^T$ for both.

Rows are expressed in the frame of body a, where a pin to the world is constant.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.params import WORLD, Distance, Revolute
from boomdp_jax.physics.small_linear import dot3

Triple = tuple[FloatScalar, FloatScalar, FloatScalar]
# Below this separation of its anchors [m] a rod has no direction; it then acts along
# no axis rather than along a random one.
_TINY_LENGTH = 1e-9


class Frames(NamedTuple):
    """Where bodies are, and the frames in which their twists are expressed."""

    x: Float[Array, " body"]
    y: Float[Array, " body"]
    cos: Float[Array, " body"]
    """Of the frame in which twists are expressed."""
    sin: Float[Array, " body"]
    turn: tuple[Float[Array, " body"], Float[Array, " body"]] | None = None
    """Cosine and sine of the body's orientation relative to that frame; None: equal."""


class Slot(NamedTuple):
    """One joint slot in scalars, taken out of its arrays before the time loop."""

    active: FloatScalar
    a: Float[Array, " body"] | None
    """Weight of each body as partner a; None in a scene of one body."""
    b: Float[Array, " body"] | None
    is_world: Bool[Array, ""]
    anchor_a: tuple[FloatScalar, FloatScalar]
    anchor_b: tuple[FloatScalar, FloatScalar]
    length: FloatScalar | None
    """Rest length [m]; None for a pin."""


class Row(NamedTuple):
    """One scalar constraint: J_a w_a + J_b w_b = 0."""

    slot: Slot
    ja: Triple
    jb: Triple | None
    """None where no partner can exist (a scene of one body)."""
    error: FloatScalar
    """C itself [m]."""

    def velocity(self, w) -> FloatScalar:
        """J w of a twist."""
        total = dot3(self.ja, tuple(select(self.slot.a, v) for v in w))
        if self.jb is not None:
            total = total + dot3(self.jb, tuple(select(self.slot.b, v) for v in w))
        return total

    def push(self) -> tuple:
        """J^T over bodies."""
        out = tuple(scatter(self.slot.a, j) for j in self.ja)
        if self.jb is None:
            return out
        return tuple(
            o + scatter(self.slot.b, j) for o, j in zip(out, self.jb, strict=True)
        )


def joint_slots(joint: Revolute | Distance, num_bodies: int) -> list[Slot]:
    """Every slot of one kind, in scalars."""
    dtype = joint.anchor_a.dtype
    body = jnp.arange(num_bodies)
    slots = []
    for slot in range(joint.active.shape[0]):
        is_alone = num_bodies == 1
        slots.append(
            Slot(
                active=joint.active[slot].astype(dtype),
                a=None if is_alone else (body == joint.body_a[slot]).astype(dtype),
                b=None if is_alone else (body == joint.body_b[slot]).astype(dtype),
                is_world=joint.body_b[slot] == WORLD,
                anchor_a=(joint.anchor_a[slot, 0], joint.anchor_a[slot, 1]),
                anchor_b=(joint.anchor_b[slot, 0], joint.anchor_b[slot, 1]),
                length=joint.length[slot] if isinstance(joint, Distance) else None,
            )
        )
    return slots


def select(weights: Float[Array, " body"] | None, values: Float[Array, "..."]):
    """The value of one body."""
    return values if weights is None else jnp.sum(weights * values)


def scatter(weights: Float[Array, " body"] | None, value: FloatScalar):
    """The value placed at one body, zero elsewhere."""
    return value if weights is None else weights * value


def _anchor(frames: Frames, weights, anchor):
    """Anchor in the frame of its body's twist."""
    if frames.turn is None:
        return anchor
    cos, sin = (select(weights, part) for part in frames.turn)
    return cos * anchor[0] - sin * anchor[1], sin * anchor[0] + cos * anchor[1]


def _pin_rows(slot: Slot, frames: Frames) -> tuple[Row, Row]:
    """The two rows of a coincidence of anchors, in the frame of body a."""
    on = slot.active
    ax, ay = _anchor(frames, slot.a, slot.anchor_a)
    ca, sa = select(slot.a, frames.cos), select(slot.a, frames.sin)
    xa, ya = select(slot.a, frames.x), select(slot.a, frames.y)
    bx, by = slot.anchor_b
    jb = (None, None)
    if slot.b is not None:
        has_b = jnp.where(slot.is_world, 0.0, on)
        lx, ly = _anchor(frames, slot.b, slot.anchor_b)
        cb, sb = select(slot.b, frames.cos), select(slot.b, frames.sin)
        # From b's frame to a's.
        c, s = ca * cb + sa * sb, ca * sb - sa * cb
        rx, ry = c * lx - s * ly, s * lx + c * ly
        bx = jnp.where(slot.is_world, bx, select(slot.b, frames.x) + cb * lx - sb * ly)
        by = jnp.where(slot.is_world, by, select(slot.b, frames.y) + sb * lx + cb * ly)
        jb = (
            (-has_b * c, has_b * s, has_b * ry),
            (-has_b * s, -has_b * c, -has_b * rx),
        )
    dx, dy = xa - bx, ya - by
    zero = jnp.zeros_like(on)
    return (
        Row(slot, (on, zero, -on * ay), jb[0], on * (ca * dx + sa * dy + ax)),
        Row(slot, (zero, on, on * ax), jb[1], on * (ca * dy - sa * dx + ay)),
    )


def _rod_row(slot: Slot, frames: Frames) -> Row:
    """The row of a fixed distance."""
    row_x, row_y = _pin_rows(slot, frames)
    square = row_x.error**2 + row_y.error**2
    has_length = square > _TINY_LENGTH**2
    separation = jnp.sqrt(jnp.where(has_length, square, 1.0))
    dx = jnp.where(has_length, row_x.error / separation, 0.0)
    dy = jnp.where(has_length, row_y.error / separation, 0.0)

    def along(x, y):
        return tuple(dx * p + dy * q for p, q in zip(x, y, strict=True))

    jb = None if row_x.jb is None else along(row_x.jb, row_y.jb)
    rest: Any = slot.length
    length = jnp.where(has_length, separation, 0.0) - rest
    return Row(slot, along(row_x.ja, row_y.ja), jb, slot.active * length)


def joint_rows(slots: list[Slot], frames: Frames) -> list[Row]:
    """All rows of all slots: two of a pin, one of a rod.

    Args:
        slots: pins and rods.
        frames: where the bodies are.

    Returns:
        The rows; those of an inactive slot are zero.
    """
    rows = []
    for slot in slots:
        if slot.length is None:
            rows += _pin_rows(slot, frames)
        else:
            rows.append(_rod_row(slot, frames))
    return rows
