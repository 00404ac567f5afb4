"""The extended Kalman filter at lists of points, each with its own noise."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.spread import Program, num_at_a_time, run_each
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.chunking import (
    CHUNK_SIZE,
    Chunking,
    for_each_chunk,
)
from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import (
    Filtered,
    NoiseLevel,
    extended_filter,
)
from boomdp_jax.inference.likelihoods.target import StructureTarget

# Points filtered by one call of the program that makes gains.
_POINTS_PER_CALL = 8
# Bodies by whose number points of a chunk are divided, at most.
_MOST_DIVIDED = 4


def _gather_chunks(targets: StructureTarget, owners, owner, num, points) -> tuple:
    likelihood: Any = targets.log_likelihood
    index = owners[:, 0]
    known = likelihood.coordinates, likelihood.data
    known = jax.tree.map(lambda leaf: leaf[index], known)
    structure, z, noise = points
    active = targets.structures[index[owner][:, None], structure]
    return known, owner, num, (active, z, noise)


def _densities_of_chunks(known, owner, num, points):
    """Log-likelihoods of chunks `[chunk, place, ...]`."""

    def one_chunk(known, points):
        coordinates, data = known
        is_used = data.is_used

        def one_point(active, z, noise):
            params, level = coordinates(z, active), NoiseLevel(*noise)
            return filter_density(coordinates.world, params, data, level, is_used)

        return jax.vmap(one_point)(*points)

    return for_each_chunk(one_chunk, known, owner, num, points)


_DENSITIES = Program(_gather_chunks, _densities_of_chunks)


def filter_densities(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    z: np.ndarray,
    noise: NoiseFit,
) -> np.ndarray:
    """Log-likelihood of points by the extended filter, each with its own noise.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        index: object of each point.
        structure: of each point.
        z: coordinates of each point.
        noise: of each point.

    Returns:
        `[point]`, minus infinity where the filter's result is not finite.
    """
    # Nothing here belongs to a structure as gains do: chunks are of one object. Of each
    # point its neighbours are stepped as well, of a pair thirteen states.
    size = CHUNK_SIZE // min(noise.reading.shape[1], _MOST_DIVIDED)
    chunks = Chunking.of(index, np.zeros_like(structure), 1, size=size)
    dtype = targets.log_prior.dtype
    dealt = list(chunks.calls(num_at_a_time()))
    inputs = [
        (
            call.owners,
            call.owner,
            call.num,
            (
                structure[call.rows].astype(np.int32),
                z[call.rows].astype(dtype),
                (
                    noise.reading[call.rows].astype(dtype),
                    noise.impulse[call.rows].astype(dtype),
                ),
            ),
        )
        for call in dealt
    ]
    calls = run_each(_DENSITIES, targets, inputs)
    found = chunks.in_order(
        [values[: call.num] for values, call in zip(calls, dealt, strict=True)]
    ).astype(float)
    return np.where(np.isfinite(found), found, -np.inf)


def _gather_points(targets: StructureTarget, index, structure, z, noise) -> tuple:
    """What each point needs of the targets, so that their number is not compiled in."""
    likelihood: Any = targets.log_likelihood
    known = likelihood.coordinates, likelihood.data
    known = jax.tree.map(lambda leaf: leaf[index], known)
    return known, targets.structures[index, structure], z, noise


def _filter_each(known, active, z, noise) -> Filtered:
    is_used = jnp.any(known[1].is_used, axis=0)

    def one(known, active, z, noise):
        coordinates, data = known
        params, level = coordinates(z, active), NoiseLevel(*noise)
        return extended_filter(coordinates.world, params, data, level, is_used)

    return jax.vmap(one)(known, active, z, noise)


_FILTERS = Program(_gather_points, _filter_each)


def filter_points(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    z: np.ndarray,
    noise: NoiseFit,
) -> Filtered:
    """The same with gains, leading axis `point`, on the host."""
    num = len(index)
    dtype = targets.log_prior.dtype
    inputs = []
    for begin in range(0, num, _POINTS_PER_CALL):
        rows = np.minimum(np.arange(begin, begin + _POINTS_PER_CALL), num - 1)
        level = (noise.reading[rows].astype(dtype), noise.impulse[rows].astype(dtype))
        inputs.append(
            (
                index[rows].astype(np.int32),
                structure[rows].astype(np.int32),
                z[rows].astype(dtype),
                level,
            )
        )
    calls = run_each(_FILTERS, targets, inputs)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:num], *calls)
