"""Likelihoods of many points of many objects, by one compiled program.

Points come as a flat list on the host. They are sorted into chunks of equal object and
structure, so that data and gains are read once for a chunk and products with gains
vectorise, and handed out in calls of one size, as many at a time as there are cores:
whatever is fitted, weighed or sampled, and however many objects there are, the physics
is compiled once.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.side_by_side import call_each
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.tracking import Gains

_CHUNK = 32
_CHUNKS_PER_CALL = 4


class Evaluation(NamedTuple):
    """What is known of each point; leading axis `point`, on the host."""

    log_density: np.ndarray
    """Prior included; minus infinity where the prediction is not finite."""
    num: np.ndarray
    square: np.ndarray
    """Counts and sums of squared innovations, `[point, body, 4]`."""
    innovation: np.ndarray | None
    """Whitened innovations, `[point, reading]`."""


class _Chunks(NamedTuple):
    """What the points of each chunk share; leading axis `chunk`."""

    likelihood: Any
    """Without structures and gains, whose shapes depend on the number of structures."""
    gains: Gains
    active: Bool[Array, "chunk slot"]


@QuickCompile
def _gather(targets: StructureTarget, index, structure) -> _Chunks:
    likelihood: Any = targets.log_likelihood
    gains = jax.tree.map(lambda leaf: leaf[index, structure], likelihood.gains)
    bare = eqx.tree_at(lambda x: (x.gains, x.structures), likelihood, (None, None))
    bare = jax.tree.map(lambda leaf: leaf[index], bare)
    return _Chunks(bare, gains, targets.structures[index, structure])


@QuickCompile
def _evaluate_chunks(chunks: _Chunks, z):
    """Log-likelihoods of chunks `[chunk, point, dim]`."""

    def one_chunk(chunk, z):
        likelihood, gains, active = chunk
        log_volume = likelihood.log_volume(gains)

        def one_point(z):
            found = likelihood.innovations(z, active, gains)
            value = likelihood.log_marginal(found.statistics, log_volume)
            return value, found.statistics, found.whitened.reshape(-1)

        return jax.vmap(one_point)(z)

    return jax.vmap(one_chunk)(chunks, z)


def _call(targets: StructureTarget, index, structure, z):
    """One call of the compiled program, its result on the host."""
    number = np.dtype(np.int32)
    chunks = _gather(targets, on_device(index, number), on_device(structure, number))
    found = _evaluate_chunks(chunks, on_device(z, targets.log_prior.dtype))
    return jax.tree.map(np.asarray, found)


def log_prior_density(
    targets: StructureTarget, index: np.ndarray, structure: np.ndarray, z: np.ndarray
) -> np.ndarray:
    """The same as `StructureTarget.log_prior_density`, of many points on the host."""
    period = np.asarray(targets.period, float)[index]
    slots, slot = np.asarray(targets.structures[0]), np.asarray(targets.slot[0])
    active = np.concatenate([slots, np.ones((len(slots), 1), bool)], axis=1)
    normal = -0.5 * z**2 - 0.5 * np.log(2.0 * np.pi)
    uniform = -np.log(np.where(period > 0, period, 1.0))
    each = np.where(period > 0, uniform, normal)
    total = np.sum(np.where(active[:, slot][structure], each, 0.0), axis=1)
    return np.asarray(targets.log_prior, float)[index, structure] + total


def evaluate_points(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    z: np.ndarray,
    *,
    with_innovations: bool = False,
) -> Evaluation:
    """Log-densities and noise statistics of a list of points.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        index: object of each point.
        structure: of each point.
        z: coordinates of each point, `[point, dim]`.
        with_innovations: whether to bring back the innovations, for a fit.

    Returns:
        One row per point, in the order given.
    """
    num_points = z.shape[0]
    num_structures = targets.structures.shape[1]
    group = index.astype(np.int64) * num_structures + structure
    order = np.argsort(group, kind="stable")
    names, begins, sizes = np.unique(
        group[order], return_index=True, return_counts=True
    )
    num_chunks = -(-sizes // _CHUNK)
    total = int(num_chunks.sum())
    padded = -(-total // _CHUNKS_PER_CALL) * _CHUNKS_PER_CALL
    # Which point fills each place; places left over repeat their group's first point.
    source = np.zeros((padded, _CHUNK), np.int64)
    owner = np.zeros(padded, np.int64)
    first = 0
    for name, begin, size, count in zip(names, begins, sizes, num_chunks, strict=True):
        places = np.full(count * _CHUNK, order[begin])
        places[:size] = order[begin : begin + size]
        source[first : first + count] = places.reshape(count, _CHUNK)
        owner[first : first + count] = name
        first += count
    if first:
        source[first:], owner[first:] = source[0, 0], owner[0]
    parts = [slice(n, n + _CHUNKS_PER_CALL) for n in range(0, padded, _CHUNKS_PER_CALL)]
    calls = call_each(
        _call,
        [
            (targets, *divmod(owner[rows], num_structures), z[source[rows]])
            for rows in parts
        ],
        targets,
    )
    flat = source[:total].reshape(-1)

    def gather(pick):
        found = np.concatenate([pick(call) for call in calls])
        joined = found.reshape(-1, *found.shape[2:])[: flat.size]
        out = np.empty((num_points, *joined.shape[1:]), joined.dtype)
        out[flat] = joined
        return out

    log_likelihood = gather(lambda call: call[0]).astype(float)
    log_density = log_likelihood + log_prior_density(targets, index, structure, z)
    return Evaluation(
        log_density=np.where(log_likelihood > -1e29, log_density, -np.inf),
        num=gather(lambda call: call[1].num),
        square=gather(lambda call: call[1].square),
        innovation=gather(lambda call: call[2]) if with_innovations else None,
    )
