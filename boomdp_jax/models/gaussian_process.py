r"""Gaussian processes: smooth functions whose length scales the evidence chooses.

Each output is a process by itself, of mean zero (coasting) and covariance

$$k(x, x') = a^2 \exp(-\tfrac12 \textstyle\sum_j (x_j - x_j')^2 / l_j^2),$$

seen with noise s (Rasmussen and Williams 2006, Gaussian processes for machine learning,
chapters 2 and 5; for learning dynamics, Deisenroth and Rasmussen 2011, PILCO). Inputs
are standardised, targets in units of their size. The scales a, l, s of each output
climb its log marginal likelihood, with a wide prior that holds them where rows say
nothing, by a fixed number of Adam's steps from where they were.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

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
    size_of,
    spread_place,
    spread_rows,
    squared_distances,
)

# Rows closer than this share of the signal make a matrix that 32 bit cannot factor.
_LEAST_NOISE = {4: 3e-3, 8: 1e-4}
# Middle and spread of the scales a priori, in log units: signal, lengths, noise.
_FIRST_SIGNAL, _FIRST_LENGTH, _FIRST_NOISE = math.log(2.0), math.log(3.0), -3.0
_PRIOR_SPREAD = 1.5
_LEARNING_RATE = 0.1


class Scales(eqx.Module):
    """What a covariance function is made of; logarithms."""

    log_signal: Float[Array, "*batch"]
    log_length: Float[Array, "*batch input"]
    log_noise: Float[Array, "*batch"]


class ProcessFit(eqx.Module):
    """Rows, and the scales of each output."""

    table: Table
    scales: Scales
    """With an axis `output`."""
    num_tuned: Int[Array, "*batch"]
    """Rows seen when they were chosen."""


class ProcessRows(eqx.Module):
    """Rows as queries need them, of each output."""

    scaling: Scaling
    points: Float[Array, "*batch output row input"]
    """Standardised inputs in units of the length scales."""
    weight: Float[Array, "*batch output row"]
    """Inverse covariance times targets, times the signal's variance."""
    scales: Scales
    size: Float[Array, "*batch output"]
    """Unit of the targets."""
    precision: Float[Array, "*batch output row row"] | None
    """Inverse covariance; None if no noise is drawn."""


class GaussianProcess(AbstractRegressor):
    """One process per output.

    Uses few rows best, and says how sure it is; costs the cube of the rows it keeps
    (with each row, and a hundred times that when scales are chosen). Full, it keeps
    rows that are far from each other.
    """

    capacity: int = eqx.field(static=True)
    num_tuning_rows: int = eqx.field(static=True)
    num_tuning_steps: int = eqx.field(static=True)
    is_noisy: bool = eqx.field(static=True)

    def __init__(
        self,
        *,
        capacity: int = 256,
        num_tuning_rows: int = 128,
        num_tuning_steps: int = 40,
        is_noisy: bool = False,
    ):
        """Settings.

        Args:
            capacity: rows that are kept.
            num_tuning_rows: of these, how many choose the scales, at most.
            num_tuning_steps: steps of their climb, each time.
            is_noisy: whether predictions are drawn from the predictive distribution;
                else they are its mean. Then a query costs the square of the rows.

        Raises:
            ValueError: a count below one.
        """
        check_at_least("capacity", capacity, 1)
        check_at_least("num_tuning_rows", num_tuning_rows, 1)
        check_at_least("num_tuning_steps", num_tuning_steps, 1)
        self.capacity = capacity
        self.num_tuning_rows = min(num_tuning_rows, capacity)
        self.num_tuning_steps = num_tuning_steps
        self.is_noisy = is_noisy

    def init(self, key: Key, num_inputs: int, num_outputs: int) -> ProcessFit:
        """No rows, and the scales of the prior."""
        del key
        return ProcessFit(
            table=empty_table(self.capacity, num_inputs, num_outputs),
            scales=Scales(
                log_signal=jnp.full((num_outputs,), _FIRST_SIGNAL),
                log_length=jnp.full((num_outputs, num_inputs), _FIRST_LENGTH),
                log_noise=jnp.full((num_outputs,), _FIRST_NOISE),
            ),
            num_tuned=jnp.zeros((), jnp.int32),
        )

    def add(
        self,
        fit: ProcessFit,
        inputs: Float[Array, " input"],
        targets: Float[Array, " output"],
        is_seen: BoolScalar,
    ) -> ProcessFit:
        """Take one row in, in place of one that is near another."""
        place = spread_place(fit.table, inputs)
        table = add_row(fit.table, inputs, targets, is_seen, at=place)
        return ProcessFit(table, fit.scales, fit.num_tuned)

    def is_due(self, fit: ProcessFit) -> BoolScalar:
        """When rows have grown by half."""
        return has_grown(fit.table, fit.num_tuned)

    def tune(self, fit: ProcessFit) -> ProcessFit:
        """Climb the evidence of each output."""
        table = fit.table
        place, mask = spread_rows(table, self.num_tuning_rows)
        points = scaling_of(table.inputs, table.mask)(table.inputs)[place]
        targets = size_of(table.targets, table.mask)(table.targets)[place]
        optimiser = optax.adam(_LEARNING_RATE)

        def climb(scales: PyTree, target: Float[Array, " row"]) -> PyTree:
            def loss(scales: Scales) -> FloatScalar:
                evidence = log_marginal_likelihood(scales, points, target, mask)
                return -evidence - _log_prior(scales)

            def move(carry: tuple, _: None) -> tuple[tuple, None]:
                scales, state = carry
                step, state = optimiser.update(jax.grad(loss)(scales), state)
                return (optax.apply_updates(scales, step), state), None

            start = (scales, optimiser.init(scales))
            moved = jax.lax.scan(move, start, None, self.num_tuning_steps)[0][0]
            # A climb that left the numbers, or fell, has not happened.
            is_better = loss(moved) < loss(scales)
            return jax.tree.map(
                lambda new, old: jnp.where(is_better, new, old), moved, scales
            )

        scales = jax.vmap(climb, in_axes=(0, 1))(fit.scales, targets)
        return ProcessFit(table, scales, table.num_seen)

    def prepare(self, fit: ProcessFit) -> ProcessRows:
        """The one hypothesis."""
        table = fit.table
        scaling = scaling_of(table.inputs, table.mask)
        size = size_of(table.targets, table.mask)
        points, targets = scaling(table.inputs), size(table.targets)

        def of(scales: Scales, target: Float[Array, " row"]) -> tuple[Array, ...]:
            factor = _factor(scales, points, table.mask)
            target = jnp.where(table.mask, target, 0.0)
            weight = jax.scipy.linalg.cho_solve((factor, True), target)
            weight = weight * jnp.exp(2.0 * scales.log_signal)
            if not self.is_noisy:
                return points / jnp.exp(scales.log_length)[None], weight
            eye = jnp.eye(self.capacity, dtype=points.dtype)
            precision = jax.scipy.linalg.cho_solve((factor, True), eye)
            precision = jnp.where(table.mask[None], precision, 0.0)
            return points / jnp.exp(scales.log_length)[None], weight, precision

        scaled, weight, *rest = jax.vmap(of, in_axes=(0, 1))(fit.scales, targets)
        rows = ProcessRows(
            scaling=scaling,
            points=scaled,
            weight=weight,
            scales=fit.scales,
            size=size.spread,
            precision=rest[0] if rest else None,
        )
        return jax.tree.map(lambda leaf: leaf[None], rows)

    @full_precision
    def predict(
        self, key: Key, hypothesis: ProcessRows, inputs: Float[Array, " input"]
    ) -> Float[Array, " output"]:
        """Mean of the predictive distribution, or a draw from it."""
        query = hypothesis.scaling(inputs)

        def correlation(
            points: Float[Array, "row input"], scales: Scales
        ) -> Float[Array, " row"]:
            point = query / jnp.exp(scales.log_length)
            return jnp.exp(-0.5 * squared_distances(point[None], points)[0])

        near = jax.vmap(correlation)(hypothesis.points, hypothesis.scales)
        mean = jnp.sum(near * hypothesis.weight, axis=1)
        if hypothesis.precision is None:
            return mean * hypothesis.size
        signal = jnp.exp(2.0 * hypothesis.scales.log_signal)
        known = jnp.einsum("or,ors,os->o", near, hypothesis.precision, near)
        variance = signal - signal**2 * known
        least = _noise_variance(hypothesis.scales)
        sd = jnp.sqrt(jnp.maximum(variance, 0.0) + least)
        drawn = mean + sd * jax.random.normal(key, mean.shape, mean.dtype)
        return drawn * hypothesis.size


def log_marginal_likelihood(
    scales: Scales,
    points: Float[Array, "row input"],
    target: Float[Array, " row"],
    mask: Bool[Array, " row"],
) -> FloatScalar:
    r"""Log-density of one output's targets, the function integrated out.

    Args:
        scales: of the covariance.
        points: standardised inputs.
        target: of each.
        mask: which rows count.

    Returns:
        $\log N(y; 0, K + s^2 I)$ of the rows that count.
    """
    factor = _factor(scales, points, mask)
    target = jnp.where(mask, target, 0.0)
    white = jax.scipy.linalg.solve_triangular(factor, target, lower=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(factor)))
    num = jnp.sum(mask)
    return -0.5 * jnp.sum(white**2) - log_det - 0.5 * num * math.log(2 * math.pi)


def _factor(
    scales: Scales, points: Float[Array, "row input"], mask: Bool[Array, " row"]
) -> Float[Array, "row row"]:
    """Lower factor of the covariance of what was seen; of the unit matrix elsewhere."""
    points = points / jnp.exp(scales.log_length)[None]
    # Distances of a row to itself are exactly zero only if taken as such.
    square = squared_distances(points, points)
    eye = jnp.eye(len(points), dtype=points.dtype)
    square = jnp.where(eye > 0, 0.0, square)
    covariance = jnp.exp(2.0 * scales.log_signal - 0.5 * square)
    covariance = jnp.where(mask[:, None] & mask[None], covariance, 0.0)
    rest = jnp.where(mask, _noise_variance(scales), 1.0)
    return jnp.linalg.cholesky(covariance + rest[:, None] * eye)


def _noise_variance(scales: Scales) -> Float[Array, "*output"]:
    """Of what is seen, never so small that a matrix cannot be factored."""
    least = _LEAST_NOISE[scales.log_noise.dtype.itemsize]
    least_variance = least**2 * (1.0 + jnp.exp(2.0 * scales.log_signal))
    return jnp.exp(2.0 * scales.log_noise) + least_variance


def _log_prior(scales: Scales) -> FloatScalar:
    """Wide, about where the scales begin."""
    return (
        -0.5
        * (
            jnp.sum((scales.log_length - _FIRST_LENGTH) ** 2)
            + (scales.log_signal - _FIRST_SIGNAL) ** 2
            + (scales.log_noise - _FIRST_NOISE) ** 2
        )
        / (_PRIOR_SPREAD**2)
    )
