r"""Locally weighted regression: a linear law for each question, of the rows near it.

With standardised inputs, at a query q every row i has the weight

$$w_i = \exp(-|x_i - q|^2 / 2 b^2),$$

b the bandwidth, for the k nearest rows, and the prediction is the level at q of the
ridge regression with these weights (Atkeson, Moore and Schaal 1997, Locally weighted
learning). With the weighted means $\bar x, \bar y$, covariance C of the inputs and
covariance G of inputs and targets it is

$$\bar y + G^T (C + \lambda I)^{-1} (q - \bar x),$$

one system with one right-hand side. All sums over rows are one product of the weights
with a matrix of every row's squares and products, which does not depend on q: for a
batch of queries, two products of matrices, an exponential for each pair, and the
systems. No prediction leaves the range of targets by more than half of it. Bandwidth
and λ are those of the least leave-one-out error.

Rows may belong to groups (conditions of contact), each a regression by itself; a query
of a group without rows is answered by group zero.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.models.regression import AbstractRegressor
from boomdp_jax.models.table import (
    Scaling,
    Table,
    add_row,
    check_at_least,
    empty_table,
    has_grown,
    scaling_of,
    spread_rows,
    squared_distances,
)

# The papers' bandwidth among narrower and wider ones; the widest is all but linear.
_BANDWIDTHS = (0.3, 0.6, 1.0, 1.5, 2.5, 4.0, 8.0)
# Per weight; the least is what rounding allows in 32 bit.
_RIDGES = (1e-5, 1e-3, 1e-1)
_FIRST_RIDGE = 1e-3
# By which share of their range predictions may leave that of the targets seen. Away
# from all rows a slope has no end: without this a cart in the open that was learnt in
# the world frame is soon predicted at six times the error of coasting.
_BEYOND = 0.5


class LocalFit(eqx.Module):
    """Rows, and what was chosen last."""

    table: Table
    bandwidth: Float[Array, "*batch"]
    """b, in standardised units."""
    ridge: Float[Array, "*batch"]
    """λ, per weight."""
    num_tuned: Int[Array, "*batch"]
    """Rows seen by then."""


class LocalRows(eqx.Module):
    """Rows as queries need them."""

    scaling: Scaling
    points: Float[Array, "*batch row input"]
    """Standardised inputs."""
    moments: Float[Array, "*batch row moment"]
    """One, inputs, targets, and their products, of every row."""
    mask: Bool[Array, "*batch row"]
    group: Int[Array, "*batch row"]
    bandwidth: Float[Array, "*batch"]
    ridge: Float[Array, "*batch"]
    low: Float[Array, "*batch output"]
    """Least of what may be predicted."""
    high: Float[Array, "*batch output"]


class LocallyWeighted(AbstractRegressor):
    """Locally weighted linear regression.

    Learns any smooth law where it has been, and needs rows all over: they grow as a
    power of the number of inputs. A prediction costs a pass over the table; one sort
    more, by bisection, if more rows are kept than count as neighbours.
    """

    capacity: int = eqx.field(static=True)
    num_neighbours: int = eqx.field(static=True)
    bandwidths: tuple[float, ...] = eqx.field(static=True)
    ridges: tuple[float, ...] = eqx.field(static=True)
    num_held_out: int = eqx.field(static=True)

    def __init__(
        self,
        *,
        capacity: int = 1000,
        num_neighbours: int = 1000,
        bandwidths: tuple[float, ...] = _BANDWIDTHS,
        ridges: tuple[float, ...] = _RIDGES,
        num_held_out: int = 200,
    ):
        """Settings.

        Args:
            capacity: newest rows that are kept.
            num_neighbours: nearest rows that count (k).
            bandwidths: to choose from, in standardised units.
            ridges: λ to choose from, per weight.
            num_held_out: rows that are left out in turn when choosing, at most.

        Raises:
            ValueError: a count below one, or no positive number to choose from.
        """
        for name, value in (
            ("capacity", capacity),
            ("num_neighbours", num_neighbours),
            ("num_held_out", num_held_out),
        ):
            check_at_least(name, value, 1)
        for name, values in (("bandwidths", bandwidths), ("ridges", ridges)):
            if not values or not min(values) > 0:
                raise ValueError(f"{name}: expected positive numbers, got {values}")
        self.capacity = capacity
        self.num_neighbours = num_neighbours
        self.bandwidths = tuple(bandwidths)
        self.ridges = tuple(ridges)
        self.num_held_out = num_held_out

    def init(self, key: Key, num_inputs: int, num_outputs: int) -> LocalFit:
        """No rows."""
        del key
        middle = self.bandwidths[len(self.bandwidths) // 2]
        return LocalFit(
            table=empty_table(self.capacity, num_inputs, num_outputs),
            bandwidth=jnp.full((), middle),
            ridge=jnp.full((), _FIRST_RIDGE),
            num_tuned=jnp.zeros((), jnp.int32),
        )

    def add(
        self,
        fit: LocalFit,
        inputs: Float[Array, " input"],
        targets: Float[Array, " output"],
        is_seen: BoolScalar,
        group: IntScalar | int = 0,
    ) -> LocalFit:
        """Take one row in, of one group."""
        table = add_row(fit.table, inputs, targets, is_seen, group=group)
        return LocalFit(table, fit.bandwidth, fit.ridge, fit.num_tuned)

    def is_due(self, fit: LocalFit) -> BoolScalar:
        """When rows have grown by half."""
        return has_grown(fit.table, fit.num_tuned)

    def tune(self, fit: LocalFit) -> LocalFit:
        """Choose bandwidth and ridge of the least leave-one-out error."""
        rows = local_rows(fit)
        bandwidths = jnp.asarray(self.bandwidths, fit.bandwidth.dtype)
        ridges = jnp.asarray(self.ridges, fit.ridge.dtype)
        spread = scaling_of(fit.table.targets, fit.table.mask).spread
        place, is_row = spread_rows(fit.table, min(self.num_held_out, self.capacity))
        points, group = rows.points[place], rows.group[place]
        targets = fit.table.targets[place] / spread[None]
        is_other = place[:, None] != jnp.arange(self.capacity)[None]

        def errors_at(bandwidth: FloatScalar) -> Float[Array, " ridge"]:
            at = eqx.tree_at(lambda leaf: leaf.bandwidth, rows, bandwidth)
            sums = jax.vmap(
                lambda point, own, other: self._sums(at, point, own, other)
            )(points, group, is_other)

            def error_at(ridge: FloatScalar) -> FloatScalar:
                told = jax.vmap(lambda one, point: _level(one, point, ridge))(
                    sums, points
                )
                square = (told / spread[None] - targets) ** 2
                return jnp.sum(jnp.where(is_row[:, None], square, 0.0))

            return jax.vmap(error_at)(ridges)

        errors = jax.lax.map(errors_at, bandwidths)
        best = jnp.argmin(errors)
        return LocalFit(
            table=fit.table,
            bandwidth=bandwidths[best // len(self.ridges)],
            ridge=ridges[best % len(self.ridges)],
            num_tuned=fit.table.num_seen,
        )

    def prepare(self, fit: LocalFit) -> LocalRows:
        """The one hypothesis."""
        return jax.tree.map(lambda leaf: leaf[None], local_rows(fit))

    def predict(
        self,
        key: Key,
        hypothesis: LocalRows,
        inputs: Float[Array, " input"],
        group: IntScalar | int = 0,
    ) -> Float[Array, " output"]:
        """The local law's level at a query of one group."""
        del key
        point = hypothesis.scaling(inputs)
        sums = self._sums(hypothesis, point, jnp.asarray(group), hypothesis.mask)
        level = _level(sums, point, hypothesis.ridge)
        return jnp.clip(level, hypothesis.low, hypothesis.high)

    @full_precision
    def _sums(
        self,
        rows: LocalRows,
        point: Float[Array, " input"],
        group: IntScalar,
        is_other: Bool[Array, " row"],
    ) -> "_Sums":
        """Weighted sums over the rows that count for a query."""
        counts = rows.mask & is_other
        is_own = counts & (rows.group == group)
        counts = counts & (rows.group == jnp.where(jnp.any(is_own), group, 0))
        square = squared_distances(point[None], rows.points)[0]
        far = jnp.finfo(square.dtype).max
        square = jnp.where(counts, square, far)
        if self.num_neighbours < self.capacity:
            counts = counts & (square <= kth_least(square, self.num_neighbours))
        # Relative to the nearest row, or nothing would be left of any far from all.
        beyond = jnp.where(counts, square - jnp.min(square), far)
        weight = jnp.exp(-0.5 * beyond / rows.bandwidth**2)
        return _split(weight @ rows.moments, point.shape[0])


def local_rows(fit: LocalFit) -> LocalRows:
    """Work out what all queries have in common."""
    table = fit.table
    scaling = scaling_of(table.inputs, table.mask)
    points = jnp.where(table.mask[:, None], scaling(table.inputs), 0.0)
    is_any = jnp.any(table.mask)
    far = jnp.where(is_any, jnp.inf, 0.0).astype(points.dtype)
    low, high = (
        bound(jnp.where(table.mask[:, None], table.targets, sign * far), axis=0)
        for bound, sign in ((jnp.min, 1.0), (jnp.max, -1.0))
    )
    upper = np.triu_indices(points.shape[1])
    cross = points[:, :, None] * table.targets[:, None, :]
    parts = [
        jnp.ones_like(points[:, :1]),
        points,
        table.targets,
        points[:, upper[0]] * points[:, upper[1]],
        cross.reshape(len(points), -1),
    ]
    return LocalRows(
        scaling=scaling,
        points=points,
        moments=jnp.concatenate(parts, axis=1) * table.mask[:, None],
        mask=table.mask,
        group=table.group,
        bandwidth=fit.bandwidth,
        ridge=fit.ridge,
        low=low - _BEYOND * (high - low),
        high=high + _BEYOND * (high - low),
    )


class _Sums(NamedTuple):
    """Of the weights, and weighted means."""

    weight: FloatScalar
    inputs: Float[Array, " input"]
    targets: Float[Array, " output"]
    square: Float[Array, "input input"]
    cross: Float[Array, "input output"]


def _split(sums: Float[Array, " moment"], num_inputs: int) -> _Sums:
    """Sums of moments as weighted means."""
    num_pairs = num_inputs * (num_inputs + 1) // 2
    num_outputs = (len(sums) - 1 - num_inputs - num_pairs) // (1 + num_inputs)
    weight = jnp.maximum(sums[0], jnp.finfo(sums.dtype).tiny)
    ends = np.cumsum([num_inputs, num_outputs, num_pairs])
    inputs, targets, pairs, cross = jnp.split(sums[1:] / weight, ends)
    index = np.zeros((num_inputs, num_inputs), int)
    first, second = np.triu_indices(num_inputs)
    index[first, second] = index[second, first] = np.arange(num_pairs)
    return _Sums(
        weight, inputs, targets, pairs[index], cross.reshape(num_inputs, num_outputs)
    )


@full_precision
def _level(
    sums: _Sums, point: Float[Array, " input"], ridge: FloatScalar
) -> Float[Array, " output"]:
    """What the local ridge regression says at a query."""
    spread = sums.square - sums.inputs[:, None] * sums.inputs[None]
    cross = sums.cross - sums.inputs[:, None] * sums.targets[None]
    matrix = spread + ridge * jnp.eye(len(point), dtype=point.dtype)
    return sums.targets + _solve(matrix, point - sums.inputs) @ cross


def _solve(
    matrix: Float[Array, "row row"], right: Float[Array, " row"]
) -> Float[Array, " row"]:
    """Of a positive definite system, by elimination that a batch shares.

    LAPACK, called for each of many small systems, takes several times as long.
    """
    whole = jnp.concatenate([matrix, right[:, None]], axis=1)
    least = jnp.finfo(matrix.dtype).eps
    rows = []
    for _ in range(len(right)):
        # Rounding may leave next to nothing, or less, of a direction without spread.
        row = whole[0] / jnp.maximum(whole[0, 0], least)
        rows.append(row)
        whole = whole[1:, 1:] - whole[1:, :1] * row[None, 1:]
    solution = jnp.zeros((0,), right.dtype)
    for row in reversed(rows):
        value = row[-1:] - jnp.sum(row[1:-1] * solution, keepdims=True)
        solution = jnp.concatenate([value, solution])
    return solution


def kth_least(values: Float[Array, " row"], k: int) -> FloatScalar:
    """The k-th least of numbers that are not negative, by bisection of their bits.

    Floats that are not negative are ordered as the integers of the same bits.
    """
    dtype = jnp.int32 if values.dtype.itemsize == 4 else jnp.int64
    bits = jax.lax.bitcast_convert_type(values, dtype)

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        is_enough = jnp.sum(bits <= middle) >= k
        return jnp.where(is_enough, low, middle + 1), jnp.where(is_enough, middle, high)

    bounds = (jnp.zeros((), dtype), jnp.max(bits))
    num_bits = 8 * values.dtype.itemsize
    return jax.lax.bitcast_convert_type(
        jax.lax.fori_loop(0, num_bits, halve, bounds)[1], values.dtype
    )
