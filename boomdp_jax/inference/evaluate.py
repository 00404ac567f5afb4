"""Likelihoods of many points of many objects, by one compiled program.

Points come as a flat list on the host. They are sorted into chunks of equal object and
structure (`chunking`), so that data and gains are read once for a chunk and products
with gains vectorise, and handed out in calls of one size, as many at a time as there
are cores: whatever is fitted, weighed or sampled, and however many objects there are,
the physics is compiled once.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.spread import Program, run_each
from boomdp_jax.inference.chunking import Chunking
from boomdp_jax.inference.filtered_likelihood import without_gains
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.tracking import Gains

# Points of a chunk and chunks of a call.
_POINTS_PER_CHUNK, _CHUNKS_PER_CALL = 16, 4


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
    reference: Float[Array, "chunk body 4"]
    active: Bool[Array, "chunk slot"]


def _gather(targets: StructureTarget, index, structure, z) -> tuple[_Chunks, Any]:
    """What chunks need of the targets, which alone knows how many objects there are."""
    likelihood: Any = targets.log_likelihood
    gains = jax.tree.map(lambda leaf: leaf[index, structure], likelihood.gains)
    reference = likelihood.reference[index, structure]
    bare = jax.tree.map(lambda leaf: leaf[index], without_gains(likelihood))
    active = targets.structures[index, structure]
    return _Chunks(bare, gains, reference, active), z


def _evaluate_chunks(chunks: _Chunks, z):
    """Log-likelihoods of chunks `[chunk, point, dim]`."""

    def one_chunk(both):
        (likelihood, gains, reference, active), z = both
        log_volume = likelihood.log_volume(gains)

        def one_point(z):
            found = likelihood.innovations(z, active, gains)
            value = likelihood.log_marginal(found.statistics, log_volume, reference)
            return value, found.statistics, found.whitened.reshape(-1)

        return jax.vmap(one_point)(z)

    # One after the other: with a batch axis of their own, what the points of a chunk
    # share would have to be spread over all of them before every small loop. That takes
    # twice as long, and the extended filter four times.
    return jax.lax.map(one_chunk, (chunks, z))


_EVALUATE = QuickCompile(_evaluate_chunks)
_LIKELIHOODS = Program(_gather, _EVALUATE)


def _gather_pushed(targets: StructureTarget, index, structure, gains, action, z):
    """The same with gains and wrenches of each chunk's own."""
    chunks, z = _gather(targets, index, structure, z)
    likelihood = eqx.tree_at(
        lambda x: (x.data.steps.action, x.data.steps.commands),
        chunks.likelihood,
        (action, None),
        is_leaf=lambda leaf: leaf is None,
    )
    return chunks._replace(likelihood=likelihood, gains=gains), z


# Where commands take effect at once, what is compiled for points serves here, too.
_PUSHED = Program(_gather_pushed, _EVALUATE)


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
    chunks = Chunking.of(
        index,
        structure,
        targets.structures.shape[1],
        size=_POINTS_PER_CHUNK,
        per_call=_CHUNKS_PER_CALL,
    )
    dtype, number = targets.log_prior.dtype, np.int32
    inputs = [
        (objects.astype(number), structures.astype(number), z[rows].astype(dtype))
        for (objects, structures), rows in chunks.calls()
    ]
    calls = run_each(_LIKELIHOODS, targets, inputs)

    def gather(pick):
        return chunks.in_order([pick(call) for call in calls])

    log_likelihood = gather(lambda call: call[0]).astype(float)
    log_density = log_likelihood + log_prior_density(targets, index, structure, z)
    return Evaluation(
        log_density=np.where(log_likelihood > -1e29, log_density, -np.inf),
        num=gather(lambda call: call[1].num),
        square=gather(lambda call: call[1].square),
        innovation=gather(lambda call: call[2]) if with_innovations else None,
    )


def pushed_innovations(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    gains: Gains,
    action: np.ndarray,
    z: np.ndarray,
) -> np.ndarray:
    """Innovations of lists of points under other gains and wrenches than the targets'.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        index: object of each list.
        structure: of each list.
        gains: of each list, leading axis `list`, on the host.
        action: wrenches in effect in each list, `[list, time, body, 3]` [N, N, N m].
        z: coordinates of up to 16 points of each list, `[list, point, dim]`.

    Returns:
        Whitened innovations `[list, point, time, 2, body, 6]`.
    """
    num_lists, num_points, _ = z.shape
    chunks = -(-num_lists // _CHUNKS_PER_CALL) * _CHUNKS_PER_CALL
    lists = np.minimum(np.arange(chunks), num_lists - 1)
    # Shapes of the calls are those of `evaluate_points`.
    points = np.minimum(np.arange(_POINTS_PER_CHUNK), num_points - 1)
    dtype, number = targets.log_prior.dtype, np.int32
    inputs = []
    for begin in range(0, chunks, _CHUNKS_PER_CALL):
        rows = lists[begin : begin + _CHUNKS_PER_CALL]
        inputs.append(
            (
                index[rows].astype(number),
                structure[rows].astype(number),
                jax.tree.map(lambda leaf, rows=rows: leaf[rows].astype(dtype), gains),
                action[rows].astype(dtype),
                z[rows][:, points].astype(dtype),
            )
        )
    calls = run_each(_PUSHED, targets, inputs)
    found = np.concatenate([call[2] for call in calls])[:num_lists, :num_points]
    shape = action.shape[1:3]
    return found.reshape(num_lists, num_points, shape[0], 2, shape[1], 6).astype(float)
