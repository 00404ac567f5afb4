r"""Joints as rows of a linear constraint on twists.

With $p_a = x_a + R_a r_a$ the anchor of body a and $p_b$ its partner's (a fixed point
where the partner is the world), $d = p_a - p_b$, $r$ for $R r$ and $r^\perp$ for $r$
turned by a right angle:

- coincident anchors (revolute, weld): $C = d$, two rows, $\dot C = v_a + \omega_a
  r_a^\perp - v_b - \omega_b r_b^\perp$;
- a fixed distance: $C = |d| - L$, one row, $J = d^T J_{coincident} / |d|$;
- a fixed angle (weld, prismatic): $C = \theta_a - \theta_b - \alpha$, one row;
- a guide (prismatic): $C = n \cdot d$ with $n$ across the axis, fixed in b; one row,
  $\dot C = n \cdot (v_a + \omega_a r_a^\perp - v_b - \omega_b (r_b + d)^\perp)$.

Along the coordinate that a joint leaves free (angle of a revolute, slide of a
prismatic) the same form gives the row on which its friction, motor and limits act.

All arrays are in lanes (`core.lanes`), twists and rows in world axes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.many_bodies import is_many
from boomdp_jax.physics.params import WORLD, Params

PerBody = Float[Array, "body lane"]
PerSlot = Float[Array, "slot lane"]
PerRow = Float[Array, "row lane"]
Pair = tuple[PerSlot, PerSlot]
# Below this separation of its anchors [m] a rod has no direction; it then acts along
# no axis rather than along a random one.
_TINY_LENGTH = 1e-9


class Frames(NamedTuple):
    """Where bodies are."""

    x: PerBody
    y: PerBody
    theta: PerBody
    cos: PerBody
    sin: PerBody


class Ends(NamedTuple):
    """What the slots of a kind tie together."""

    on: PerSlot
    """One where a slot is active, else zero."""
    has_b: PerSlot
    """Likewise, and zero too where the partner is the world."""
    a: PerSlot
    """Index of the body."""
    b: PerSlot
    """Index of the partner; `WORLD` for the world."""
    anchor_a: Pair
    anchor_b: Pair


class Joints(NamedTuple):
    """Slots by what they hold; None where there are none."""

    points: Ends | None
    """Coincident anchors: revolute, then weld."""
    rods: Ends | None
    length: PerSlot | None
    """Of the rods [m]."""
    angles: Ends | None
    """Fixed angles: weld, then prismatic."""
    angle: PerSlot | None
    """Of these [rad]."""
    guides: Ends | None
    """Prismatic."""
    axis: Pair | None
    """Of the guides: cosine and sine in the partner's frame."""
    turns: Ends | None
    """Revolute, for what acts on their angle."""


class Rows(NamedTuple):
    """Scalar constraints J_a w_a + J_b w_b = 0; zeros for an inactive slot."""

    a: PerRow
    b: PerRow
    ja: tuple[PerRow, PerRow, PerRow]
    jb: tuple[PerRow, PerRow, PerRow]
    error: PerRow
    """C itself [m, rad]."""


def joints_of(params: Params, dtype) -> Joints:
    """All slots of a hypothesis, in lanes."""

    def ends(joint) -> Ends | None:
        if joint is None or joint.active.shape[0] == 0:
            return None
        on = joint.active.astype(dtype)
        return Ends(
            on=on,
            has_b=jnp.where(joint.body_b == WORLD, 0.0, on),
            a=joint.body_a.astype(dtype),
            b=joint.body_b.astype(dtype),
            anchor_a=(joint.anchor_a[:, 0], joint.anchor_a[:, 1]),
            anchor_b=(joint.anchor_b[:, 0], joint.anchor_b[:, 1]),
        )

    pins, rods = ends(params.revolute), ends(params.distance)
    welds, guides = ends(params.weld), ends(params.prismatic)
    angle, axis = [], None
    if params.weld is not None and welds is not None:
        angle.append(params.weld.angle)
    if params.prismatic is not None and guides is not None:
        angle.append(params.prismatic.angle)
        axis = (jnp.cos(params.prismatic.axis), jnp.sin(params.prismatic.axis))
    return Joints(
        points=join(pins, welds),
        rods=rods,
        length=None if rods is None else params.distance.length,
        angles=join(welds, guides),
        angle=jnp.concatenate(angle) if angle else None,
        guides=guides,
        axis=axis,
        turns=pins,
    )


def join(*parts: Any) -> Any:
    """One after another along the first axis, of those that are there."""
    parts = tuple(part for part in parts if part is not None)
    if not parts:
        return None
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def of_body(index: PerRow, values: Any) -> Any:
    """What one body has, in each row; zero for the world.

    Args:
        index: of the body.
        values: tree of arrays `[body, lane]`.

    Returns:
        Tree of arrays `[row, lane]`.
    """
    leaves, treedef = jax.tree.flatten(values)
    if is_many(leaves[0].shape[0]):
        body = jnp.arange(leaves[0].shape[0], dtype=index.dtype)
        is_it = (index[:, None] == body[None, :, None])[None]
        total = jnp.sum(jnp.where(is_it, jnp.stack(leaves)[:, None], 0.0), axis=2)
        return jax.tree.unflatten(treedef, list(total))
    # Stacked, which makes one operation of each body's instead of many.
    table = jnp.stack(leaves, axis=1)
    total = jnp.zeros((len(leaves), *index.shape), table.dtype)
    for body in range(table.shape[0]):
        total = jnp.where((index == body)[None], table[body][:, None], total)
    return jax.tree.unflatten(treedef, list(total))


def on_bodies(index: PerRow, values: Any, num_bodies: int) -> PerBody:
    """What rows say of the bodies that an index names, added up.

    Args:
        index: of a body of each row.
        values: of each row, numbers or truth values.
        num_bodies: how many there are.
    """
    body = jnp.arange(num_bodies, dtype=index.dtype)[None, :, None]
    is_it = index[:, None] == body
    return jnp.sum(jnp.where(is_it, jnp.asarray(values, index.dtype)[:, None], 0.0), 0)


def moved_end(rows: Any, mobile: PerBody) -> PerRow:
    """Index of a body of each row that is not static: the first one, if it can be.

    Args:
        rows: `Rows`, or anything with both indices.
        mobile: one, or zero for a static body.
    """
    return jnp.where(of_body(rows.a, mobile) > 0.0, rows.a, rows.b)


def bilateral_rows(joints: Joints, frames: Frames) -> Rows | None:
    """All rows that hold in both directions.

    Args:
        joints: the slots.
        frames: where the bodies are.

    Returns:
        The rows: both of coincident anchors, rods, angles, guides; None if there is no
        slot.
    """
    parts = []
    for ends, function, more in (
        (joints.points, _point, ()),
        (joints.rods, _rod, (joints.length,)),
        (joints.angles, _angle, (joints.angle,)),
        (joints.guides, _guide, (joints.axis,)),
    ):
        if ends is None:
            continue
        found = elementwise(function, _placed(ends, frames), *more)
        parts += [Rows(ends.a, ends.b, *row) for row in found]
    return join(*parts)


def turn_rows(joints: Joints, frames: Frames) -> Rows | None:
    """The angle of every revolute, with the angle for an error."""
    if joints.turns is None:
        return None
    placed = _placed(joints.turns, frames)
    ((*row,),) = elementwise(_angle, placed, jnp.zeros_like(joints.turns.on))
    return Rows(joints.turns.a, joints.turns.b, *row)


def slide_rows(joints: Joints, frames: Frames) -> Rows | None:
    """The slide of every prismatic, with the slide for an error."""
    if joints.guides is None:
        return None
    placed = _placed(joints.guides, frames)
    ((*row,),) = elementwise(_slide, placed, joints.axis)
    return Rows(joints.guides.a, joints.guides.b, *row)


class _Placed(NamedTuple):
    """A slot and where its bodies are, in scalars; zeros for the world."""

    ends: Ends
    pose_a: Frames
    pose_b: Frames


def _placed(ends: Ends, frames: Frames) -> _Placed:
    return _Placed(
        ends,
        of_body(ends.a, frames),
        of_body(ends.b, frames),
    )


def _arms(slot: _Placed) -> tuple:
    """Anchors about the centres of mass, and from b's to a's; world axes."""
    (on, has_b, _, b, (ax, ay), (bx, by)), p, q = slot
    is_world = b == WORLD
    rx, ry = p.cos * ax - p.sin * ay, p.sin * ax + p.cos * ay
    sx = jnp.where(is_world, bx, q.cos * bx - q.sin * by)
    sy = jnp.where(is_world, by, q.sin * bx + q.cos * by)
    return on, has_b, (rx, ry), (sx, sy), (p.x + rx - q.x - sx, p.y + ry - q.y - sy)


def _along(on, has_b, direction: tuple, arm_a: tuple, arm_b: tuple, error) -> tuple:
    """The row of a motion along a direction."""
    dx, dy = direction
    ja = (on * dx, on * dy, on * (arm_a[0] * dy - arm_a[1] * dx))
    jb = (-has_b * dx, -has_b * dy, -has_b * (arm_b[0] * dy - arm_b[1] * dx))
    return ja, jb, on * error


def _point(slot: _Placed) -> tuple:
    on, has_b, arm_a, arm_b, gap = _arms(slot)
    one, zero = jnp.ones_like(on), jnp.zeros_like(on)
    return (
        _along(on, has_b, (one, zero), arm_a, arm_b, gap[0]),
        _along(on, has_b, (zero, one), arm_a, arm_b, gap[1]),
    )


def _rod(slot: _Placed, length) -> tuple:
    on, has_b, arm_a, arm_b, (dx, dy) = _arms(slot)
    square = dx * dx + dy * dy
    has_length = square > _TINY_LENGTH**2
    distance = jnp.sqrt(jnp.where(has_length, square, 1.0))
    share = jnp.where(has_length, 1.0 / distance, 0.0)
    error = jnp.where(has_length, distance, 0.0) - length
    return (_along(on, has_b, (share * dx, share * dy), arm_a, arm_b, error),)


def _angle(slot: _Placed, angle) -> tuple:
    on, has_b = slot.ends.on, slot.ends.has_b
    zero = jnp.zeros_like(on)
    error = on * (slot.pose_a.theta - slot.pose_b.theta - angle)
    return (((zero, zero, on), (zero, zero, -has_b), error),)


def _axis(slot: _Placed, axis: tuple) -> tuple:
    """The guide's axis in the world."""
    q = slot.pose_b
    is_world = slot.ends.b == WORLD
    c, s = jnp.where(is_world, 1.0, q.cos), jnp.where(is_world, 0.0, q.sin)
    return c * axis[0] - s * axis[1], s * axis[0] + c * axis[1]


def _guide(slot: _Placed, axis: tuple) -> tuple:
    on, has_b, arm_a, arm_b, (dx, dy) = _arms(slot)
    tx, ty = _axis(slot, axis)
    whole = (arm_b[0] + dx, arm_b[1] + dy)
    return (_along(on, has_b, (-ty, tx), arm_a, whole, tx * dy - ty * dx),)


def _slide(slot: _Placed, axis: tuple) -> tuple:
    on, has_b, arm_a, arm_b, (dx, dy) = _arms(slot)
    tx, ty = _axis(slot, axis)
    whole = (arm_b[0] + dx, arm_b[1] + dy)
    return (_along(on, has_b, (tx, ty), arm_a, whole, tx * dx + ty * dy),)
