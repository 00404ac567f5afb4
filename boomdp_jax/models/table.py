"""Rows that a regression learns from: a ring of fixed capacity with a mask."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, IntScalar
from boomdp_jax.core.full_precision import full_precision

# Of a column's mean: spreads below this share are rounding, not information.
_LEAST_SPREAD = 1e-6
# Of the largest number of a row, in units of the last place: the same.
_ROUNDING = 16.0

RETUNE_GROWTH = 1.5
"""By which factor rows grow until what is costly is chosen anew; less: oftener."""
LEAST_ROWS = 4
"""With fewer rows nothing is chosen."""


class Table(eqx.Module):
    """Inputs and targets of what was seen of one body, newest in place of oldest."""

    inputs: Float[Array, "*batch row input"]
    targets: Float[Array, "*batch row output"]
    group: Int[Array, "*batch row"]
    """Which of several regressions a row belongs to; zero where there is one."""
    mask: Bool[Array, "*batch row"]
    """Which rows are in use."""
    num_seen: Int[Array, "*batch"]
    """Rows taken in so far, those that made room included."""

    @property
    def capacity(self) -> int:
        """How many rows there is room for."""
        return self.mask.shape[-1]

    @property
    def num_rows(self) -> IntScalar:
        """How many are in use."""
        return jnp.sum(self.mask, axis=-1)


class Scaling(eqx.Module):
    """Units in which columns have mean zero and spread one."""

    mean: Float[Array, "*batch column"]
    spread: Float[Array, "*batch column"]
    """Standard deviation; one for a column that does not vary."""

    def __call__(
        self, values: Float[Array, "*rows column"]
    ) -> Float[Array, "*rows column"]:
        """Numbers in these units."""
        shape = (1,) * (values.ndim - 1) + self.mean.shape
        return (values - self.mean.reshape(shape)) / self.spread.reshape(shape)


def empty_table(capacity: int, num_inputs: int, num_outputs: int) -> Table:
    """A table without rows.

    Args:
        capacity: rows to make room for.
        num_inputs: columns of what goes in.
        num_outputs: columns of what comes out.

    Returns:
        The table, on the default float type.

    Raises:
        ValueError: no room for a row.
    """
    if capacity < 1:
        raise ValueError(f"capacity: expected at least 1 row, got {capacity}")
    return Table(
        inputs=jnp.zeros((capacity, num_inputs)),
        targets=jnp.zeros((capacity, num_outputs)),
        group=jnp.zeros(capacity, jnp.int32),
        mask=jnp.zeros(capacity, bool),
        num_seen=jnp.zeros((), jnp.int32),
    )


def add_row(
    table: Table,
    inputs: Float[Array, " input"],
    targets: Float[Array, " output"],
    is_seen: BoolScalar | bool = True,
    *,
    group: IntScalar | int = 0,
    at: IntScalar | None = None,
) -> Table:
    """Take one row in.

    Args:
        table: so far.
        inputs: what went in.
        targets: what came out.
        is_seen: false for a row that is left out; it may then hold anything.
        group: which regression it belongs to.
        at: place of the row; default: after the newest, in place of the oldest.

    Returns:
        The table with it.
    """
    place = table.num_seen % table.capacity if at is None else at
    is_seen = jnp.asarray(is_seen)

    def put(column: Array, value: Array) -> Array:
        new = jnp.where(is_seen, jnp.asarray(value, column.dtype), column[place])
        return column.at[place].set(new)

    return Table(
        inputs=put(table.inputs, inputs),
        targets=put(table.targets, targets),
        group=put(table.group, jnp.asarray(group)),
        mask=put(table.mask, jnp.asarray(True)),
        num_seen=table.num_seen + is_seen.astype(table.num_seen.dtype),
    )


def spread_place(table: Table, inputs: Float[Array, " input"]) -> IntScalar:
    """Where to put a row so that a full table keeps to all that was seen.

    Of the two rows that are nearest to each other, the new one among them, the older
    one in the table makes room. Work is the square of the number of rows.

    Args:
        table: so far.
        inputs: of the new row.

    Returns:
        A place for `add_row`; the next free one while there is room.
    """
    units = scaling_of(table.inputs, table.mask)
    rows = units(table.inputs)
    far = jnp.finfo(rows.dtype).max
    gaps = squared_distances(rows, rows)
    gaps = jnp.where(jnp.eye(table.capacity, dtype=bool), far, gaps)
    nearest = jnp.min(gaps, axis=1)
    to_new = squared_distances(units(inputs)[None], rows)[0]
    place = jnp.argmin(jnp.minimum(nearest, to_new))
    return jnp.where(table.num_seen < table.capacity, table.num_seen, place)


@full_precision
def squared_distances(
    points: Float[Array, "point column"], rows: Float[Array, "row column"]
) -> Float[Array, "point row"]:
    """Between every two, by one product of matrices; never negative."""
    square = jnp.sum(points**2, axis=-1)[:, None] + jnp.sum(rows**2, axis=-1)[None]
    return jnp.maximum(square - 2.0 * points @ rows.T, 0.0)


@full_precision
def scaling_of(
    values: Float[Array, "row column"], mask: Bool[Array, " row"]
) -> Scaling:
    """Mean and standard deviation of the columns.

    Args:
        values: of a table.
        mask: which rows count.

    Returns:
        Units; zero and one with no row, spread one where a column does not vary, or by
        no more than the rounding of the largest: a force along x, turned into another
        frame or half a circle round, has some 1e-16 of itself along y.
    """
    weight = mask.astype(values.dtype)
    num = jnp.maximum(jnp.sum(weight), 1.0)
    mean = weight @ values / num
    square = weight @ (values - mean[None]) ** 2 / num
    rounding = _ROUNDING * jnp.finfo(values.dtype).eps
    largest = jnp.max(square + mean**2, initial=0.0)
    least = (_LEAST_SPREAD * jnp.abs(mean)) ** 2 + jnp.finfo(values.dtype).tiny
    varies = square > jnp.maximum(least, rounding**2 * largest)
    return Scaling(mean, jnp.where(varies, jnp.sqrt(jnp.where(varies, square, 1)), 1))


@full_precision
def size_of(values: Float[Array, "row column"], mask: Bool[Array, " row"]) -> Scaling:
    """Root mean square of the columns, about zero: units that keep zero zero."""
    weight = mask.astype(values.dtype)
    square = weight @ values**2 / jnp.maximum(jnp.sum(weight), 1.0)
    varies = square > jnp.finfo(values.dtype).tiny
    spread = jnp.where(varies, jnp.sqrt(jnp.where(varies, square, 1.0)), 1.0)
    return Scaling(jnp.zeros_like(spread), spread)


def has_grown(table: Table, num_tuned: IntScalar) -> BoolScalar:
    """Whether there are half as many rows again as when something was chosen last.

    Args:
        table: now.
        num_tuned: `Table.num_seen` then.

    Returns:
        Whether it is time.
    """
    least = jnp.maximum(RETUNE_GROWTH * num_tuned, LEAST_ROWS)
    return table.num_seen >= least


def spread_rows(
    table: Table, num: int
) -> tuple[Int[Array, " chosen"], Bool[Array, " chosen"]]:
    """Rows in use at equal steps through the table, or all if they are no more.

    Args:
        table: rows, the first ones in use.
        num: how many to choose, at most the capacity.

    Returns:
        Their places, and which of these are rows in use.
    """
    index, num_rows = jnp.arange(num), table.num_rows
    place = jnp.where(num_rows <= num, index, index * num_rows // num)
    return place, index < num_rows


def check_at_least(name: str, value: float | int, least: float | int) -> None:
    """Refuse a setting that is too small.

    Raises:
        ValueError: what was expected of which setting, and what was got.
    """
    if not value >= least:
        raise ValueError(f"{name}: expected at least {least}, got {value}")
