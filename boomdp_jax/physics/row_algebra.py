"""What rows and the bodies that they tie do to each other.

Of few bodies a row is kept with its arms on every one of them, most of them zero
(`Levers`): what belongs to a body is then at hand without looking for it, and the
products are a few long sums. Of many the two bodies of each row are picked out by their
index. (An iteration of Newton's method for a pair with nine rows takes half the time
with levers, and compiles in half the time.)

All arrays are in lanes (`core.lanes`), twists and rows in world axes.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.holding import hold
from boomdp_jax.core.one_loop import elementwise
from boomdp_jax.physics.body_friction import BodyAnswer
from boomdp_jax.physics.joints import Rows, of_body
from boomdp_jax.physics.many_bodies import is_many

PerBody = Float[Array, "body lane"]
PerRow = Float[Array, "row lane"]
Twist = tuple[PerBody, PerBody, PerBody]

# Rows up to which a loop over them is written out.
_FEW_ROWS = 6


class Levers(NamedTuple):
    """J, with zeros for bodies that a row does not tie.

    Zero times what is not finite is not finite: a body that flew apart spoils all that
    have joints in its world, which worlds of many bodies do not notice.
    """

    x: Float[Array, "row body lane"]
    y: Float[Array, "row body lane"]
    spin: Float[Array, "row body lane"]


Tied = Rows | Levers
"""Rows in the form that suits the number of bodies."""


def tied(rows: Rows, num_bodies: int) -> Tied:
    """Rows in that form; levers tell nothing of errors.

    Args:
        rows: which bodies they tie, and how.
        num_bodies: of the world.
    """
    if is_many(num_bodies):
        return rows
    body = jnp.arange(num_bodies, dtype=rows.a.dtype)[None, :, None]
    at_a, at_b = rows.a[:, None] == body, rows.b[:, None] == body
    return Levers(
        *(
            jnp.where(at_a, p[:, None], 0.0) + jnp.where(at_b, q[:, None], 0.0)
            for p, q in zip(rows.ja, rows.jb, strict=True)
        )
    )


def with_arms(function: Callable[..., Array], first: Tied, *others: Tied) -> Tied:
    """Rows whose arms are a function of those of others that tie the same bodies.

    Args:
        function: of arrays `[row, *body, lane]`.
        first: from which everything else is taken.
        others: likewise.
    """
    if isinstance(first, Levers):
        return jax.tree.map(function, first, *others)
    arms = [(rows.ja, rows.jb) for rows in (first, *others) if isinstance(rows, Rows)]
    ja, jb = jax.tree.map(function, *arms)
    return first._replace(ja=ja, jb=jb)


def per_row(values: Array, rows: Tied) -> Array:
    """Numbers or truth values of rows, to go with their arms."""
    return values[:, None] if isinstance(rows, Levers) else values


def speed(rows: Tied, twist: Iterable[PerBody]) -> PerRow:
    """J w."""
    twist = tuple(twist)
    if isinstance(rows, Levers):
        return _total(
            j[:, body] * v[body][None]
            for body in range(rows.x.shape[1])
            for j, v in zip(rows, twist, strict=True)
        )
    return _total(
        j * v
        for index, push in ((rows.a, rows.ja), (rows.b, rows.jb))
        for j, v in zip(push, of_body(index, twist), strict=True)
    )


def ease_of(rows: Tied, light: PerBody, spinning: PerBody) -> PerRow:
    """J M^-1 J^T of every row.

    Args:
        rows: J.
        light: speed per impulse of every body.
        spinning: spin per angular impulse.
    """
    if isinstance(rows, Levers):
        return _total(
            (rows.x[:, i] ** 2 + rows.y[:, i] ** 2) * light[i][None]
            + rows.spin[:, i] ** 2 * spinning[i][None]
            for i in range(rows.x.shape[1])
        )
    total: Any = 0.0
    for index, (x, y, spin) in ((rows.a, rows.ja), (rows.b, rows.jb)):
        ease, turning = of_body(index, (light, spinning))
        total = total + (x * x + y * y) * ease + spin * spin * turning
    return total


def columns_of(rows: Tied, answer: BodyAnswer, one: PerBody) -> Any:
    """What a push along each row does to its bodies, `A^-1 J^T`.

    Args:
        rows: J.
        answer: A^-1 of every body.
        one: from `runtime_one`, of the bodies' masses; rows with an index need none.

    Returns:
        Twists, for `coupled` and `moved_by`.
    """
    if isinstance(rows, Levers):
        given = jax.tree.map(lambda field: field[None], answer)(*rows)
        held = jnp.broadcast_to(one[None], rows.x.shape)
        return Levers(*(hold(jnp.broadcast_to(v, held.shape), held) for v in given))
    at_both = (of_body(index, answer) for index in (rows.a, rows.b))
    return elementwise(_answered, (rows.ja, rows.jb), *at_both)


def _answered(pushes: tuple, *answers: tuple) -> tuple:
    """Of one row in scalars."""
    return tuple(
        BodyAnswer(*answer)(*push) for push, answer in zip(pushes, answers, strict=True)
    )


def coupled(end: Tied, push: Tied, columns: Any) -> Float[Array, "row row lane"]:
    """J_e A^-1 J_m^T.

    Args:
        end: J_e.
        push: J_m; levers need it no more, having the columns.
        columns: `columns_of` J_m.
    """
    if isinstance(end, Levers):
        return _total(
            j[:, None, body] * c[None, :, body]
            for body in range(end.x.shape[1])
            for j, c in zip(end, columns, strict=True)
        )
    assert isinstance(push, Rows)

    def between(i, j, answer):
        return [jnp.where(i[:, None] == j[None], c[None], 0.0) for c in answer]

    total: Any = 0.0
    for index, row in ((end.a, end.ja), (end.b, end.jb)):
        parts = [between(index, push.a, columns[0]), between(index, push.b, columns[1])]
        for j, p, q in zip(row, *parts, strict=True):
            total = total + j[:, None] * (p + q)
    return total


def pushed(values: Twist, rows: Tied, impulse: PerRow) -> Twist:
    """Impulses on bodies and those along rows, `p + J^T lambda`.

    Args:
        values: p, of every body.
        rows: J.
        impulse: lambda.
    """
    arms = rows if isinstance(rows, Levers) else (rows.ja, rows.jb)
    return moved_by(values, rows, arms, impulse)


def moved_by(values: Twist, rows: Tied, columns: Any, impulse: PerRow) -> Twist:
    """Twists after impulses along rows.

    Args:
        values: before, of every body.
        rows: which bodies are pushed.
        columns: what each does to them, `columns_of` the rows.
        impulse: along each.
    """
    if isinstance(rows, Levers):
        x, y, spin = (
            v + jnp.sum(c * impulse[:, None], axis=0)
            for v, c in zip(values, columns, strict=True)
        )
        return x, y, spin
    pushes = tuple(tuple(c * impulse for c in column) for column in columns)
    return _to_bodies(rows, pushes, values)


def compliance_of(ease: PerRow) -> PerRow:
    """Enough softness to keep redundant rows solvable; one for inactive rows."""
    tiny = 0.03 * jnp.sqrt(jnp.finfo(ease.dtype).eps)
    return jnp.where(ease > 0.0, tiny * ease, 1.0)


def on_diagonal(values: PerRow) -> Float[Array, "row row lane"]:
    """Diagonal matrices."""
    unit = jnp.eye(values.shape[0], dtype=values.dtype)
    return unit[..., None] * values[None]


def _to_bodies(rows: Rows, pushes: tuple, values: Twist) -> Twist:
    """Add to each body what all rows bring to it.

    Args:
        rows: which bodies they tie.
        pushes: what each brings to its first and to its second body, three numbers.
        values: three numbers of every body.
    """
    num_bodies, lanes = values[0].shape
    body = jnp.arange(num_bodies, dtype=rows.a.dtype)[:, None]
    table = jnp.stack(
        [rows.a, *pushes[0], rows.b, *pushes[1]], axis=1
    )  # One row of it is what one turn of the loop needs.

    def add(row, totals):
        a, *to_a = jax.lax.dynamic_index_in_dim(table, row, keepdims=False)[:4]
        b, *to_b = jax.lax.dynamic_index_in_dim(table, row, keepdims=False)[4:]
        return tuple(
            total
            + jnp.where(a[None] == body, p[None], 0.0)
            + jnp.where(b[None] == body, q[None], 0.0)
            for total, p, q in zip(totals, to_a, to_b, strict=True)
        )

    first = tuple(jnp.broadcast_to(v, (num_bodies, lanes)) for v in values)
    num = table.shape[0]
    if num > _FEW_ROWS:
        first = jax.lax.fori_loop(0, num, add, first)
    else:
        for row in range(num):
            first = add(row, first)
    x, y, spin = first
    return x, y, spin


def _total(terms: Iterable) -> Any:
    return functools.reduce(jnp.add, terms)
