"""The extended Kalman filter at lists of points, each with its own noise."""

from typing import Any

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.side_by_side import call_each
from boomdp_jax.inference.chunking import Chunking
from boomdp_jax.inference.filter_density import filter_density
from boomdp_jax.inference.filtered_likelihood import without_gains
from boomdp_jax.inference.kalman import Filtered, NoiseLevel, extended_filter
from boomdp_jax.inference.noise_level import NoiseFit
from boomdp_jax.inference.target import StructureTarget

_INDEX = np.dtype(np.int32)
# Points filtered by one call of the program that makes gains.
_POINTS_PER_CALL = 8


@QuickCompile
def _gather(targets: StructureTarget, index, structure):
    likelihood: Any = targets.log_likelihood
    bare = without_gains(likelihood)
    likelihoods = jax.tree.map(lambda leaf: leaf[index], bare)
    return likelihoods, targets.structures[index[:, None], structure]


@QuickCompile
def _densities(likelihoods, active, z, noise: NoiseLevel):
    """Log-likelihoods of chunks `[chunk, point, ...]`."""

    def one_chunk(likelihood, active, z, noise):
        coordinates = likelihood.coordinates

        def one_point(active, z, noise):
            params = coordinates(z, active)
            return filter_density(coordinates.scene, params, likelihood.data, noise)

        return jax.vmap(one_point)(active, z, noise)

    return jax.vmap(one_chunk)(likelihoods, active, z, noise)


def _densities_on_host(targets, index, structure, z, reading, impulse):
    dtype = targets.log_prior.dtype
    likelihoods, active = _gather(
        targets, on_device(index, _INDEX), on_device(structure, _INDEX)
    )
    noise = NoiseLevel(on_device(reading, dtype), on_device(impulse, dtype))
    return np.asarray(_densities(likelihoods, active, on_device(z, dtype), noise))


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
    # Nothing here belongs to a structure as gains do: chunks are of one object.
    chunks = Chunking.of(index, np.zeros_like(structure), 1)
    calls = call_each(
        _densities_on_host,
        [
            (
                targets,
                owner[0],
                structure[rows],
                z[rows],
                noise.reading[rows],
                noise.impulse[rows],
            )
            for owner, rows in chunks.calls()
        ],
        targets,
    )
    found = chunks.in_order(calls).astype(float)
    return np.where(np.isfinite(found), found, -np.inf)


@QuickCompile
def _filter_points(targets: StructureTarget, index, structure, z, noise: NoiseLevel):
    def one(i, k, z, noise):
        target = jax.tree.map(lambda leaf: leaf[i], targets)
        likelihood: Any = target.log_likelihood
        coordinates = likelihood.coordinates
        params = coordinates(z, target.structures[k])
        return extended_filter(coordinates.scene, params, likelihood.data, noise)

    return jax.vmap(one)(index, structure, z, noise)


def _filter_on_host(*arguments):
    return jax.tree.map(np.asarray, _filter_points(*arguments))


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
        level = NoiseLevel(
            on_device(noise.reading[rows], dtype), on_device(noise.impulse[rows], dtype)
        )
        inputs.append(
            (
                targets,
                on_device(index[rows], _INDEX),
                on_device(structure[rows], _INDEX),
                on_device(z[rows], dtype),
                level,
            )
        )
    calls = call_each(_filter_on_host, inputs, targets)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:num], *calls)
