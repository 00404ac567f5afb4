"""Many walkers over structures and coordinates, moved together.

Each chain is a population of walkers. It starts at draws of its own from the fitted
mixture, resampled by importance, and all of its walkers then make the same cycle of
moves as a single chain would (`moves`): jumps, local changes, walks, each accepted with
its exact ratio. A move of all walkers of all chains of all objects is one batch of
likelihoods. Chains share nothing, so that R-hat across them tells what importance
weights and moves together have not evened out (Margossian et al. 2024, Nested R-hat).

Prefer this to `structure_chain.run_chains` where a likelihood is far cheaper in a batch
than alone.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.importance_evidence import (
    ImportanceEvidence,
)
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.mixture_building import fit_spare_components
from boomdp_jax.inference.moves import (
    MOVES,
    MoveInfo,
    Point,
    Proposal,
    accept,
    propose_change,
    propose_walk,
)
from boomdp_jax.inference.noise import Noise, host_generator, pick
from boomdp_jax.inference.structure_chain import ChainDraws
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.weighing import batch_noise, evaluate_each, weigh_twice

# Moves of one sweep, by name.
_CYCLE = ("jump", "walk", "change", "walk", "jump")
_PRIOR_SHARE = 0.3
_WALK_ACCEPT = 0.4
# A component is fitted to walkers of a structure if this many per coordinate differ,
# and gets this share of the structure's weight.
_WALKERS_PER_DIM, _SPARE_SHARE = 4, 0.6


class PopulationSettings(NamedTuple):
    """How many walkers make how many sweeps."""

    num_chains: int = 4
    num_walkers: int = 64
    """Of each chain."""
    num_warmup: int = 4
    """Sweeps that adapt the walk's step size and are thrown away."""
    num_sweeps: int = 8
    """Sweeps that are kept; each gives one draw per walker."""
    num_importance: int = 2048
    """Draws from the mixture that refine its weights; and again, that are weighed."""
    max_doublings: int = 2
    """How often the number of sweeps may double, of which then every second is kept,
    where the chains do not agree yet."""


class MoveCounts(NamedTuple):
    """Proposals made and accepted, `[object, move, 2]`; see `structure_chain`."""

    proposed: np.ndarray
    accepted: np.ndarray


class Population(NamedTuple):
    """Draws of all objects, and what the mixture was worth."""

    draws: ChainDraws
    """`[object, chain, draw]`; the draws of one walker follow each other."""
    counts: MoveCounts
    evidence: ImportanceEvidence
    """With a leading object axis."""


def sample_population(
    key: Key,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    settings: PopulationSettings,
    *,
    evaluate: Callable[..., Array] | None = None,
    is_mixed: Callable[[ChainDraws], bool] = lambda draws: True,
) -> Population:
    """Draw from the posteriors of a batch of objects.

    Args:
        key: random key.
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        mixtures: one of each object.
        settings: how much to draw.
        evaluate: from targets, structures `[object, point]` and coordinates `[object,
            point, dim]` to log-densities `[object, point]`; default: that of the
            targets, in chunks.
        is_mixed: whether draws `[object, chain, draw]` of all objects will do.

    Returns:
        Draws of every chain, move counts, and evidence by importance sampling.
    """
    evaluate = evaluate_each if evaluate is None else evaluate
    rng = host_generator(key)
    mixtures, evidence = weigh_twice(
        rng, targets, mixtures, settings.num_importance, evaluate
    )
    points = _start(evidence, targets, mixtures, settings)
    num_objects = targets.structures.shape[0]
    step_size = np.full(num_objects, 0.5)
    shape = (num_objects, len(MOVES), 2)
    proposed, accepted = np.zeros(shape, int), np.zeros(shape, int)

    def sweep_once(points: Point, mixtures: LaplaceMixture, is_warm_up: bool) -> Point:
        for move in _CYCLE:
            batch = _proposals(move, rng, points, targets, mixtures, step_size)
            points, info = _verdict(rng, points, targets, batch, evaluate)
            if not is_warm_up:
                _count(proposed, accepted, MOVES.index(move), info)
            elif move == "walk":
                rate = np.mean(np.asarray(info.accept_probability, float), axis=1)
                step_size[:] *= np.exp(rate - _WALK_ACCEPT)
                np.clip(step_size, 0.02, 0.98, out=step_size)
        return points

    for _ in range(settings.num_warmup):
        points = sweep_once(points, mixtures, True)
    if settings.num_warmup > 0:
        mixtures = _adapt(targets, mixtures, points)
        proposal = _log_proposal(targets, mixtures, points.structure, points.z)
        points = eqx.tree_at(lambda p: p.log_proposal, points, proposal)
    kept, every = [], 1
    for doubling in range(settings.max_doublings + 1):
        if doubling > 1:
            every *= 2
        for _ in range(settings.num_sweeps):
            for _ in range(every):
                points = sweep_once(points, mixtures, False)
            kept.append(points)
        if doubling > 0:
            kept = kept[1::2]
        draws = _arrange(kept, settings)
        if is_mixed(draws):
            break
    return Population(
        draws=draws,
        counts=MoveCounts(proposed, accepted),
        evidence=evidence,
    )


@QuickCompile
def _fit_spare(targets, mixtures, mean, scale_tril, share):
    return jax.vmap(fit_spare_components)(targets, mixtures, mean, scale_tril, share)


def _adapt(
    targets: StructureTarget, mixtures: LaplaceMixture, points: Point
) -> LaplaceMixture:
    """Fit a component to the walkers in each structure where there are enough."""
    structure, z = np.asarray(points.structure), np.asarray(points.z, float)
    num_objects, num_structures = targets.structures.shape[:2]
    dim = z.shape[-1]
    period = np.asarray(targets.period, float)
    mean = np.zeros((num_objects, num_structures, dim))
    tril = np.tile(np.eye(dim), (num_objects, num_structures, 1, 1))
    share = np.zeros((num_objects, num_structures))
    for i, k in np.ndindex(num_objects, num_structures):
        mine = z[i, structure[i] == k]
        if len(np.unique(mine, axis=0)) < _WALKERS_PER_DIM * dim:
            continue
        is_angle = period[i] > 0
        turn = np.where(is_angle, period[i], 1.0)
        offset = mine - mine[0]
        offset -= np.where(is_angle, turn * np.round(offset / turn), 0.0)
        middle = offset.mean(0)
        # Coordinates not in use are all zero and get a scale of one.
        in_use = np.ptp(mine, axis=0) > 0
        covariance = np.atleast_2d(np.cov(offset, rowvar=False))
        covariance = covariance * np.outer(in_use, in_use)
        covariance += np.diag(~in_use) + np.diag(1e-6 * np.diag(covariance))
        try:
            tril[i, k] = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            continue
        mean[i, k] = mine[0] + middle
        mean[i, k] -= np.where(is_angle, turn * np.round(mean[i, k] / turn), 0.0)
        share[i, k] = _SPARE_SHARE
    dtype = points.z.dtype
    parts = (on_device(part, dtype) for part in (mean, tril, share))
    return _fit_spare(targets, mixtures, *parts)


def _start(
    evidence: ImportanceEvidence,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    settings: PopulationSettings,
) -> Point:
    """Resample walkers of each chain from its own share of the weighed draws.

    Draws are dealt out in turn, so that systematically drawn components are shared
    evenly. Resampling is systematic about the middle of each interval.
    """
    num_objects, num_draws = evidence.log_weight.shape
    num_chains, num_walkers = settings.num_chains, settings.num_walkers
    weight = np.exp(np.asarray(evidence.log_weight, float))
    rows = np.zeros((num_objects, num_chains, num_walkers), int)
    middle = (np.arange(num_walkers) + 0.5) / num_walkers
    for i in range(num_objects):
        for chain in range(num_chains):
            mine = np.arange(chain, num_draws, num_chains)
            total = np.cumsum(weight[i, mine])
            if total[-1] > 0:
                place = np.searchsorted(total / total[-1], middle, side="right")
            else:
                place = np.arange(num_walkers)
            rows[i, chain] = mine[np.minimum(place, len(mine) - 1)]
    rows = rows.reshape(num_objects, -1)
    each = np.arange(num_objects)[:, None]

    def pick_rows(array):
        picked = np.asarray(array)[each, rows]
        return on_device(picked, picked.dtype)

    structure, z = pick_rows(evidence.structure), pick_rows(evidence.z)
    return Point(
        structure=structure,
        z=z,
        log_density=pick_rows(evidence.log_density),
        log_proposal=_log_proposal(targets, mixtures, structure, z),
    )


@QuickCompile
def _log_proposal(targets, mixtures, structure, z):
    def one(target, mixture, structure, z):
        return jax.vmap(lambda k, z: mixture.log_density(target, k, z))(structure, z)

    return jax.vmap(one)(targets, mixtures, structure, z)


class _Batch(NamedTuple):
    """A proposal of every walker, before its likelihood is known."""

    proposal: Proposal
    log_proposal: Float[Array, "object walker"]


@functools.partial(QuickCompile, static=("move",))
def _propose(
    move: str,
    noise: Noise,
    points: Point,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    step_size: Float[Array, " object"],
) -> _Batch:
    def one(noise, point, target, mixture, step_size):
        if move == "walk":
            proposal = propose_walk(noise, point, target, mixture, step_size)
        elif move == "change":
            proposal = propose_change(noise, point, target, mixture, _PRIOR_SHARE)
        else:
            component = pick(mixture.log_weight, noise.choice[0])
            draw = mixture.sample_component(noise, target, component)
            proposal = Proposal(
                structure=draw.structure,
                z=draw.z,
                log_correction=point.log_proposal,
                is_valid=draw.is_inside,
                is_made=jnp.asarray(True),
            )
        log_proposal = mixture.log_density(target, proposal.structure, proposal.z)
        if move == "jump":
            correction = proposal.log_correction - log_proposal
            proposal = proposal._replace(log_correction=correction)
        return _Batch(proposal, log_proposal)

    over = jax.vmap(jax.vmap(one, (0, 0, None, None, None)))
    return over(noise, points, targets, mixtures, step_size)


@QuickCompile
def _decide(
    points: Point, batch: _Batch, log_density, uniform
) -> tuple[Point, MoveInfo]:
    def one(point, batch, log_density, uniform):
        proposal = batch.proposal
        is_valid = proposal.is_valid & proposal.is_made & (log_density < jnp.inf)
        candidate = Point(
            structure=proposal.structure,
            z=proposal.z,
            log_density=jnp.where(is_valid, log_density, -jnp.inf),
            log_proposal=batch.log_proposal,
        )
        moved, info = accept(uniform, point, candidate, proposal.log_correction)
        return moved, info._replace(is_made=proposal.is_made)

    return jax.vmap(jax.vmap(one))(points, batch, log_density, uniform)


def _proposals(
    move: str,
    rng: np.random.Generator,
    points: Point,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    step_size: np.ndarray,
) -> _Batch:
    """A proposal of every walker."""
    noise = batch_noise(rng, targets, mixtures, points.structure.shape[1])
    size = on_device(step_size, points.z.dtype)
    return _propose(move, noise, points, targets, mixtures, size)


def _verdict(
    rng: np.random.Generator,
    points: Point,
    targets: StructureTarget,
    batch: _Batch,
    evaluate: Callable[..., Array],
) -> tuple[Point, MoveInfo]:
    """Accept or refuse every proposal."""
    proposal, dtype = batch.proposal, points.z.dtype
    log_density = evaluate(targets, proposal.structure, proposal.z).astype(dtype)
    # Which choices a proposal makes is its own affair; the verdict gets a fresh number.
    uniform = on_device(1.0 - rng.random(points.structure.shape), dtype)
    return _decide(points, batch, log_density, uniform)


def _count(proposed, accepted, index: int, info: MoveInfo) -> None:
    is_made, is_taken = np.asarray(info.is_made), np.asarray(info.accepted)
    changes = np.asarray(info.changes_structure)
    for column, mask in enumerate((~changes, changes)):
        proposed[:, index, column] += np.sum(is_made & mask, axis=1)
        accepted[:, index, column] += np.sum(is_taken & mask, axis=1)


def _arrange(kept: list[Point], settings: PopulationSettings) -> ChainDraws:
    """Sweeps put together, walker after walker within each chain."""

    def whole(name: str) -> Array:
        parts = [np.asarray(getattr(points, name)) for points in kept]
        stacked = np.stack(parts, axis=2)
        num_objects = stacked.shape[0]
        shape = (num_objects, settings.num_chains, -1, *stacked.shape[3:])
        return on_device(stacked.reshape(shape), stacked.dtype)

    return ChainDraws(whole("structure"), whole("z"), whole("log_density"))
