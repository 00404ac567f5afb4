"""Likelihoods of many points of many objects, by one compiled program.

Points come as a flat list on the host. They are sorted into chunks of equal object and
structure (`chunking`) and handed out in calls of one program, as many at a time as
there are cores: whatever is fitted, weighed or sampled, and however many objects there
are, the physics is compiled once.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.spread import Program, num_at_a_time, run_each
from boomdp_jax.inference.likelihoods.chunking import (
    CHUNK_SIZE,
    MAX_MIXED_OWNERS,
    MAX_OWNERS,
    Chunking,
    for_each_chunk,
    max_chunks,
)
from boomdp_jax.inference.likelihoods.filtered_likelihood import (
    group_sums,
    without_gains,
)
from boomdp_jax.inference.likelihoods.one_step import NoiseStatistics
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.likelihoods.tracking import Gains


class Evaluation(NamedTuple):
    """What is known of each point; leading axis `point`, on the host."""

    log_density: np.ndarray
    """Prior included; minus infinity where the prediction is not finite."""
    num: np.ndarray
    square: np.ndarray
    """Counts and sums of squared innovations, `[point, body, 4]`."""
    innovation: np.ndarray | None
    """Whitened innovations, `[point, reading]`."""


class _Known(NamedTuple):
    """What the points of a chunk share; leading axis `owner`."""

    likelihood: Any
    """Without structures and gains, whose shapes depend on the number of structures."""
    gains: Gains
    reference: Float[Array, "owner body 4"]
    active: Bool[Array, "owner slot"]


def _gather(targets: StructureTarget, owners, owner, num, z) -> tuple:
    """What chunks need of the targets, which alone knows how many objects there are."""
    likelihood: Any = targets.log_likelihood
    index, structure = owners[:, 0], owners[:, 1]
    gains = jax.tree.map(lambda leaf: leaf[index, structure], likelihood.gains)
    reference = likelihood.reference[index, structure]
    bare = jax.tree.map(lambda leaf: leaf[index], without_gains(likelihood))
    active = targets.structures[index, structure]
    return _Known(bare, gains, reference, active), owner, num, z


def _evaluate_chunks(known: _Known, owner, num, z):
    """Log-likelihoods of chunks `[chunk, place, dim]`.

    Where places have owners of their own, what those have is picked row by row: read
    for all rows beforehand it would be too much for the caches.
    """
    is_mixed = owner.ndim == 2
    volumes = jax.vmap(lambda own: own.likelihood.log_volume(own.gains))(known)
    counts = jax.vmap(lambda own: own.likelihood.num_counted(own.gains))(known)
    by_row = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), known.gains)

    def one_chunk(own: tuple, points: tuple):
        (likelihood, gains, *rest), (z, place) = own, points
        is_used = likelihood.data.is_used

        def one_point(z, place, active, reference, log_volume, num):
            picked = (by_row, place) if is_mixed else (gains, None)
            whitened = likelihood.whitened(z, active, *picked, is_used)
            statistics = NoiseStatistics(num, group_sums(whitened**2))
            value = likelihood.log_marginal(statistics, log_volume, reference)
            return value, statistics, whitened.reshape(-1)

        if is_mixed:
            rest = [leaf[place] for leaf in (known.active, *others)]
            return jax.vmap(one_point)(z, place, *rest)
        return jax.vmap(lambda z: one_point(z, None, *rest))(z)

    others = (known.reference, volumes, counts)
    owned = (known.likelihood, known.gains, known.active, *others)
    first = owner
    if is_mixed:
        first, owned = owner[:, 0], (known.likelihood, None)
    return for_each_chunk(one_chunk, owned, first, num, (z, owner if is_mixed else z))


_EVALUATE = QuickCompile(_evaluate_chunks)
_LIKELIHOODS = Program(_gather, _EVALUATE)


def _gather_pushed(targets: StructureTarget, owners, gains, action, owner, num, z):
    """The same with gains and wrenches of each owner's own."""
    known, *rest = _gather(targets, owners, owner, num, z)
    likelihood = eqx.tree_at(
        lambda x: (x.data.steps.action, x.data.steps.commands),
        known.likelihood,
        (action, None),
        is_leaf=lambda leaf: leaf is None,
    )
    return known._replace(likelihood=likelihood, gains=gains), *rest


# Where commands take effect at once, what is compiled for points serves here, too.
_PUSHED = Program(_gather_pushed, _EVALUATE)


def _gather_restarted(targets: StructureTarget, owners, start, owner, num, z):
    """The same with rows that each start a track, and what they add to its start."""
    known, *rest = _gather(targets, owners, owner, num, z)
    data = known.likelihood.data
    is_used = data.is_used.astype(start.dtype)
    new = eqx.tree_at(
        lambda d: (
            d.is_start,
            d.is_second,
            d.start,
            d.first_mask,
            d.last_mask,
            d.steps.next_state,
        ),
        data,
        (
            jnp.ones_like(is_used),
            jnp.zeros_like(start),
            start,
            jnp.zeros_like(start),
            jnp.broadcast_to(is_used[..., None, None], start.shape),
            start,
        ),
    )
    if data.weight is not None:
        new = eqx.tree_at(lambda d: d.weight, new, jnp.ones_like(is_used))
    likelihood = eqx.tree_at(lambda x: x.data, known.likelihood, new)
    none = jnp.zeros_like(known.gains.first)
    unit = jnp.broadcast_to(jnp.eye(none.shape[-1], dtype=none.dtype), none.shape)
    known = known._replace(likelihood=likelihood, gains=Gains(none, none, none, unit))
    return known, *rest


_RESTARTED = Program(_gather_restarted, _EVALUATE)


def _is_mixed(targets: StructureTarget) -> bool:
    """Whether a step costs so much that chunks have points of several structures."""
    likelihood: Any = targets.log_likelihood
    return likelihood.reference.shape[-2] > 1


def log_prior_density(
    targets: StructureTarget, index: np.ndarray, structure: np.ndarray, z: np.ndarray
) -> np.ndarray:
    """The same as `StructureTarget.log_prior_density`, of many points on the host."""
    period = np.asarray(targets.period, float)[index]
    slots, slot = np.asarray(targets.structures)[0], np.asarray(targets.slot)[0]
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
    num_structures = targets.structures.shape[1]
    is_mixed = _is_mixed(targets)
    chunks = Chunking.of(index, structure, num_structures, is_mixed=is_mixed)
    dtype = targets.log_prior.dtype
    dealt = list(chunks.calls(num_at_a_time()))
    inputs = [
        (call.owners, call.owner, call.num, z[call.rows].astype(dtype))
        for call in dealt
    ]
    calls = run_each(_LIKELIHOODS, targets, inputs)

    def gather(pick):
        return chunks.in_order(
            [pick(found)[: call.num] for found, call in zip(calls, dealt, strict=True)]
        )

    log_likelihood = gather(lambda found: found[0]).astype(float)
    log_density = log_likelihood + log_prior_density(targets, index, structure, z)
    return Evaluation(
        log_density=np.where(log_likelihood > -1e29, log_density, -np.inf),
        num=gather(lambda found: found[1].num),
        square=gather(lambda found: found[1].square),
        innovation=gather(lambda found: found[2]) if with_innovations else None,
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
        z: coordinates of up to `CHUNK_SIZE` points of each list, `[list, point, dim]`.

    Returns:
        Whitened innovations `[list, point, time, 2, body, 6]`.
    """
    joined = _of_lists(_PUSHED, targets, index, structure, (gains, action), z)
    num_rows, num_bodies = action.shape[1:3]
    return joined.reshape(*z.shape[:2], num_rows, 2, num_bodies, 6)


def single_steps(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    start: np.ndarray,
    z: np.ndarray,
) -> np.ndarray:
    """Where every row leads from states that are given, whatever was read.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        index: object of each list.
        structure: of each list.
        start: states before the step of each row, `[list, time, body, 6]`.
        z: coordinates of up to `CHUNK_SIZE` points of each list, `[list, point, dim]`.

    Returns:
        Change of the state `[list, point, time, body, 6]`, of angles by less than half
        a turn; zero in rows of which nothing is used.
    """
    joined = _of_lists(_RESTARTED, targets, index, structure, (start,), z)
    num_rows, num_bodies = start.shape[1:3]
    joined = joined.reshape(*z.shape[:2], num_rows, 2, num_bodies, 6)
    return -joined[:, :, :, 1]


def _of_lists(
    program: Program,
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    own: tuple,
    z: np.ndarray,
) -> np.ndarray:
    """Whitened innovations of lists of points that have something of their own.

    Args:
        program: takes `own` after the owners.
        targets: stacked along a leading object axis.
        index: object of each list.
        structure: of each list.
        own: trees of arrays on the host, leading axis `list`.
        z: `[list, point, dim]`.

    Returns:
        `[list, point, reading]`.
    """
    num_lists, num_points, _ = z.shape
    # Shapes of the calls are those of `evaluate_points`, each list a chunk.
    points = np.minimum(np.arange(CHUNK_SIZE), num_points - 1)
    is_mixed = _is_mixed(targets)
    most = MAX_MIXED_OWNERS if is_mixed else MAX_OWNERS
    at_a_time = min(max_chunks(), most)
    chunk = np.minimum(np.arange(max_chunks()), most - 1).astype(np.int32)
    owner = np.tile(chunk[:, None], CHUNK_SIZE) if is_mixed else chunk
    dtype = targets.log_prior.dtype
    inputs, counts = [], []
    for begin in range(0, num_lists, at_a_time):
        rows = np.minimum(np.arange(begin, begin + most), num_lists - 1)
        owners = np.stack([index[rows], structure[rows]], axis=1).astype(np.int32)
        counts.append(min(at_a_time, num_lists - begin))
        inputs.append(
            (
                owners,
                *jax.tree.map(lambda leaf, rows=rows: leaf[rows].astype(dtype), own),
                owner,
                np.array(counts[-1], np.int32),
                z[rows[chunk]][:, points].astype(dtype),
            )
        )
    calls = run_each(program, targets, inputs)
    found = [call[2][:num] for call, num in zip(calls, counts, strict=True)]
    return np.concatenate(found)[:, :num_points].astype(float)
