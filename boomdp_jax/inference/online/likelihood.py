"""Likelihoods of an online belief's particles: of all rows, and of one row more.

Both are parts of one compiled program. Over all rows, points are sorted into chunks of
equal structure, so that gains are read once for a chunk, and only rows in use are gone
through; over one row more, every particle's filter takes a single step.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.inference.likelihoods.filtered_likelihood import (
    FilteredLikelihood,
    group_sums,
)
from boomdp_jax.inference.likelihoods.one_step import NoiseStatistics
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.likelihoods.tracking import Gains, predictor, track_row
from boomdp_jax.inference.online.state import Tally
from boomdp_jax.inference.readings.track_data import TrackRow

# Points of a chunk: enough to fill vectors, few enough that not too many are padding.
_CHUNK = 64

Tracked = tuple[Float[Array, "point body 6"], Float[Array, "point body 4"]]
"""State after the last row and sums of squared innovations of each point."""


def track_points(
    target: StructureTarget,
    structure: Int[Array, " point"],
    z: Float[Array, "point dim"],
    begin: IntScalar,
    end: IntScalar,
) -> Tracked:
    """Take many hypotheses through the table.

    Args:
        target: with a `FilteredLikelihood`.
        structure: of each point.
        z: coordinates of each point.
        begin: first row.
        end: row after the last one; the cost is in proportion to the rows between.
    """
    likelihood = likelihood_of(target)
    num, num_levels = structure.shape[0], num_levels_of(target)
    shape = likelihood.data.steps.state.shape[1:]
    level = levels_of(target, structure, z)
    source, owner, num_chunks = _chunks(level, num_levels * target.num_structures)

    def one_chunk(index, carry):
        mean, square = carry
        chosen, k = source[index], owner[index]
        gains, active = likelihood.gains_of(k), target.structures[k // num_levels]
        found = jax.vmap(lambda z: _track(likelihood, z, active, gains, begin, end))(
            z[jnp.minimum(chosen, num - 1)]
        )
        # Padding is written beyond the end, which is dropped.
        return mean.at[chosen].set(found[0]), square.at[chosen].set(found[1])

    empty = jnp.zeros((num, *shape)), jnp.zeros((num, shape[0], 4))
    return jax.lax.fori_loop(0, num_chunks, one_chunk, empty)


def _chunks(structure: Int[Array, " point"], num_structures: int):
    """Points of each chunk (beyond the last: padding), its structure, and how many."""
    num = structure.shape[0]
    size = min(_CHUNK, num)
    most = -(-num // size) + min(num_structures, num) - 1
    each = jnp.arange(num_structures)
    count = jnp.sum(structure[None] == each[:, None], axis=1)
    chunks = -(-count // size)
    last = jnp.cumsum(chunks)
    order = jnp.argsort(structure)
    sorted_structure = structure[order]
    rank = jnp.arange(num) - (jnp.cumsum(count) - count)[sorted_structure]
    place = (last - chunks)[sorted_structure] * size + rank
    source = jnp.full(most * size, num).at[place].set(order)
    owner = jnp.searchsorted(last, jnp.arange(most), side="right")
    owner = jnp.minimum(owner, num_structures - 1)
    return source.reshape(most, size), owner, last[-1]


def _track(
    likelihood: FilteredLikelihood,
    z: Float[Array, " dim"],
    active,
    gains: Gains,
    begin: IntScalar,
    end: IntScalar,
):
    """One point through all rows."""
    coordinates, data = likelihood.coordinates, likelihood.data
    params = coordinates(z, active)
    predict = predictor(coordinates.world, params, data.steps.dt)

    def advance(index, carry):
        state, square = carry
        row, gain = jax.tree.map(lambda leaf: leaf[index], (data.rows, gains))
        state, whitened = track_row(predict, state, row, gain)
        added = group_sums(whitened[None] ** 2)
        if row.weight is not None:
            added = added * row.weight
        return state, square + added

    shape = data.steps.state.shape[1:]
    empty = jnp.zeros(shape), jnp.zeros((shape[0], 4))
    return jax.lax.fori_loop(begin, end, advance, empty)


def track_one_row(
    target: StructureTarget,
    structure: Int[Array, " point"],
    z: Float[Array, "point dim"],
    mean: Float[Array, "point body 6"],
    row: TrackRow,
    gains: Gains,
) -> Tracked:
    """Take many hypotheses through one row more.

    Args:
        target: with a `FilteredLikelihood`.
        structure: of each point.
        z: coordinates of each point.
        mean: state of each point before the row.
        row: its readings.
        gains: for the row, with a leading level axis.
    """
    likelihood = likelihood_of(target)
    coordinates = likelihood.coordinates

    def one(k, level, z, mean):
        params = coordinates(z, target.structures[k])
        predict = predictor(coordinates.world, params, likelihood.data.steps.dt)
        gain = jax.tree.map(lambda leaf: leaf[level], gains)
        state, whitened = track_row(predict, mean, row, gain)
        return state, group_sums(whitened[None] ** 2)

    return jax.vmap(one)(structure, levels_of(target, structure, z), z, mean)


def tally_of(target: StructureTarget) -> Tally:
    """Count innovations and add up whitenings over the table, for every level."""
    likelihood = likelihood_of(target)
    each = jax.vmap(lambda g: (likelihood.num_counted(g), likelihood.log_volume(g)))
    return Tally(*each(likelihood.gains))


def tally_row(gains: Gains) -> Tally:
    """The same for a single row.

    Args:
        gains: for the row, with a leading level axis.
    """

    def one(gains: Gains) -> tuple[Array, Array]:
        counts = gains.counts.reshape(1, 2, -1, 6)
        return group_sums(counts), gains.log_volume

    return Tally(*jax.vmap(one)(jax.tree.map(lambda leaf: leaf[:, None], gains)))


def log_likelihoods(
    target: StructureTarget,
    tally: Tally,
    level: Int[Array, " point"],
    square: Float[Array, "point body 4"],
) -> Float[Array, " point"]:
    """Log-likelihoods of points from their statistics.

    Args:
        target: with a `FilteredLikelihood`.
        tally: what all points of a level share.
        level: of each point, see `levels_of`.
        square: sums of squared innovations of each point.
    """
    likelihood = likelihood_of(target)

    def one(k: IntScalar, square: Float[Array, "body 4"]) -> FloatScalar:
        statistics = NoiseStatistics(tally.num[k], square)
        assert likelihood.reference is not None
        return likelihood.log_marginal(
            statistics, tally.log_volume[k], likelihood.reference[k]
        )

    found = jax.vmap(one)(level, square)
    return found if likelihood.offset is None else found + likelihood.offset[level]


def num_levels_of(target: StructureTarget) -> int:
    """Levels of noise of each structure."""
    reference = likelihood_of(target).reference
    assert reference is not None
    return reference.shape[-3] // target.num_structures


def levels_of(
    target: StructureTarget,
    structure: Int[Array, " point"],
    z: Float[Array, "point dim"],
) -> Int[Array, " point"]:
    """Which gains a point has: those of its structure and of its level of noise.

    Where there are several levels the last coordinate says which: it is uniform over
    one period, of which each level takes an equal part.
    """
    num = num_levels_of(target)
    if num == 1:
        return structure
    part = jnp.floor(num * (z[:, -1] / target.period[-1] + 0.5)).astype(structure.dtype)
    return num * structure + jnp.clip(part, 0, num - 1)


def likelihood_of(target: StructureTarget) -> FilteredLikelihood:
    """The target's likelihood, known to be one of a filter."""
    likelihood = target.log_likelihood
    assert isinstance(likelihood, FilteredLikelihood)
    return likelihood
