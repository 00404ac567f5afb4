r"""Linear regression: ridge, chosen by leaving out one row after the other.

With standardised inputs $X = U S V^T$ of n rows and a constant that is not shrunk,
the leverage of row i is $h_i = 1/n + \sum_j (x_i^T V_j)^2 / (s_j^2 + n \lambda)$ and
what is predicted for it without it misses by $e_i / (1 - h_i)$ (Allen 1974, The
relationship between variable selection and data augmentation and a method for
prediction). So every row is left out once at the price of one decomposition.

The cheapest of the models, and all that is needed where forces, not states, decide. It
cannot turn friction that saturates, nor anything that depends on the heading.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
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
)

# Per row and in standardised units: from what rounding allows in 32 bit to a slope
# that is all but gone.
_RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
_FIRST_RIDGE = 1e-2


class LinearFit(eqx.Module):
    """Rows, and the ridge chosen last."""

    table: Table
    ridge: Float[Array, "*batch"]
    """λ, per row."""
    num_tuned: Int[Array, "*batch"]
    """Rows seen by then."""


class LinearMap(eqx.Module):
    """An affine function."""

    scaling: Scaling
    slope: Float[Array, "*batch input output"]
    """In units of `scaling`."""
    level: Float[Array, "*batch output"]
    """At the mean input."""


class LinearRegression(AbstractRegressor):
    """Ridge regression, all outputs stacked.

    A prediction costs one small product; a row costs a product over all rows.
    """

    capacity: int = eqx.field(static=True)
    ridges: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, *, capacity: int = 1000, ridges: tuple[float, ...] = _RIDGES):
        """Settings.

        Args:
            capacity: newest rows that are kept.
            ridges: λ to choose from, per row, in units of standardised inputs.

        Raises:
            ValueError: no room, no ridge, or one that is not positive.
        """
        check_at_least("capacity", capacity, 1)
        if not ridges or not min(ridges) > 0:
            raise ValueError(f"ridges: expected positive numbers, got {ridges}")
        self.capacity = capacity
        self.ridges = tuple(ridges)

    def init(self, key: Key, num_inputs: int, num_outputs: int) -> LinearFit:
        """No rows."""
        del key
        return LinearFit(
            table=empty_table(self.capacity, num_inputs, num_outputs),
            ridge=jnp.full((), _FIRST_RIDGE),
            num_tuned=jnp.zeros((), jnp.int32),
        )

    def add(
        self,
        fit: LinearFit,
        inputs: Float[Array, " input"],
        targets: Float[Array, " output"],
        is_seen: BoolScalar,
    ) -> LinearFit:
        """Take one row in."""
        table = add_row(fit.table, inputs, targets, is_seen)
        return LinearFit(table, fit.ridge, fit.num_tuned)

    def is_due(self, fit: LinearFit) -> BoolScalar:
        """When rows have grown by half."""
        return has_grown(fit.table, fit.num_tuned)

    def tune(self, fit: LinearFit) -> LinearFit:
        """Choose the ridge of the least leave-one-out error."""
        ridges = jnp.asarray(self.ridges, fit.ridge.dtype)
        errors = jax.vmap(lambda ridge: leave_one_out_error(fit.table, ridge))(ridges)
        return LinearFit(fit.table, ridges[jnp.argmin(errors)], fit.table.num_seen)

    def prepare(self, fit: LinearFit) -> LinearMap:
        """The one affine function."""
        parts = _decompose(fit.table)
        slope = _slope(parts, fit.ridge)
        return jax.tree.map(
            lambda leaf: leaf[None], LinearMap(parts.scaling, slope, parts.level)
        )

    @full_precision
    def predict(
        self, key: Key, hypothesis: LinearMap, inputs: Float[Array, " input"]
    ) -> Float[Array, " output"]:
        """One product."""
        del key
        return hypothesis.level + hypothesis.scaling(inputs) @ hypothesis.slope


@full_precision
def leave_one_out_error(table: Table, ridge: FloatScalar) -> FloatScalar:
    """Mean squared error of what is predicted for each row without it.

    Args:
        table: rows.
        ridge: λ, per row.

    Returns:
        The mean over rows and outputs, each output in units of its spread.
    """
    parts = _decompose(table)
    slope = _slope(parts, ridge)
    rest = parts.centred - parts.design @ slope
    shrunk = parts.projected**2 / (parts.square + parts.num * ridge)[None]
    leverage = 1.0 / parts.num + jnp.sum(shrunk, axis=1)
    # A row that alone says something of a slope predicts nothing of itself.
    left = jnp.maximum(1.0 - leverage, jnp.sqrt(jnp.finfo(rest.dtype).eps))
    spread = scaling_of(table.targets, table.mask).spread
    missed = rest / left[:, None] / spread[None]
    missed = jnp.where(table.mask[:, None], missed, 0.0)
    return jnp.sum(missed**2) / (parts.num * table.targets.shape[-1])


class _Parts(NamedTuple):
    """Rows in the axes of their spread."""

    scaling: Scaling
    design: Float[Array, "row input"]
    centred: Float[Array, "row output"]
    level: Float[Array, " output"]
    axes: Float[Array, "input axis"]
    square: Float[Array, " axis"]
    projected: Float[Array, "row axis"]
    num: FloatScalar


@full_precision
def _decompose(table: Table) -> _Parts:
    """Centre, standardise, and find the axes."""
    weight = table.mask.astype(table.inputs.dtype)[:, None]
    scaling = scaling_of(table.inputs, table.mask)
    design = scaling(table.inputs) * weight
    num = jnp.maximum(jnp.sum(weight), 1.0)
    level = jnp.sum(weight * table.targets, axis=0) / num
    centred = (table.targets - level[None]) * weight
    square, axes = jnp.linalg.eigh(design.T @ design)
    return _Parts(
        scaling=scaling,
        design=design,
        centred=centred,
        level=level,
        axes=axes,
        square=jnp.maximum(square, 0.0),
        projected=design @ axes,
        num=num,
    )


@full_precision
def _slope(parts: _Parts, ridge: FloatScalar) -> Float[Array, "input output"]:
    """Of the ridge regression."""
    along = parts.projected.T @ parts.centred
    return parts.axes @ (along / (parts.square + parts.num * ridge)[:, None])
