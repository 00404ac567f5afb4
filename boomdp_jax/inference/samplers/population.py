"""Many walkers over structures and coordinates, moved together.

Each chain is a population of walkers. It starts at draws of its own from the fitted
mixture, resampled by importance, and all of its walkers then make the same cycle of
moves as a single chain would (`moves`): jumps, local changes, walks, each accepted with
its exact ratio. A move of all walkers of all chains of all objects is one batch of
likelihoods. Chains share nothing but what their moves are fitted to, so that R-hat
across them tells what importance weights and moves together have not evened out
(Margossian et al. 2024, Nested R-hat).

Prefer this to `structure_chain.run_chains` where a likelihood is far cheaper in a batch
than alone.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.adapt_mixture import adapt_mixtures
from boomdp_jax.inference.samplers.importance_evidence import ImportanceEvidence
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import MOVES, Point
from boomdp_jax.inference.samplers.resampling import resample_walkers
from boomdp_jax.inference.samplers.spare_fit import fit_spare
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from boomdp_jax.inference.samplers.walker_moves import (
    MoveCounts,
    count_moves,
    decide_all,
    log_proposal_of,
    no_moves,
    propose_all,
)
from boomdp_jax.inference.samplers.weighing import (
    evaluate_asked,
    evaluate_each,
    taken_over,
)

# Moves of one sweep, by name.
_CYCLE = ("jump", "walk", "change", "walk", "jump")
# Changes are of use where such a share of them is accepted in warm-up, less one: where
# one structure has nearly all, each is a likelihood for nothing.
_LEAST_ACCEPTED = 0.01


class PopulationSettings(NamedTuple):
    """How many walkers make how many sweeps."""

    num_chains: int = 4
    num_walkers: int = 64
    """Of each chain."""
    num_warmup: int = 4
    """Sweeps that a component is fitted to and that are thrown away."""
    num_sweeps: int = 8
    """Sweeps that are kept; each gives one draw per walker."""
    num_importance: int = 2048
    """Draws of each round that adapts the mixture; the last ones are the evidence."""
    max_doublings: int = 4
    """How often the number of sweeps of an object may double, of which then every
    second is kept, where its chains do not agree yet; the component is then fitted
    anew."""


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
    is_mixed: Callable[[ChainDraws], np.ndarray | bool] = lambda draws: True,
) -> Population:
    """Draw from the posteriors of a batch of objects.

    Args:
        key: random key.
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        mixtures: one of each object.
        settings: how much to draw.
        evaluate: as `weighing.evaluate_each`, which is the default.
        is_mixed: whether draws `[object, chain, draw]` of each object will do.

    Returns:
        Draws of every chain, move counts, and evidence by importance sampling.
    """
    evaluate = evaluate_each if evaluate is None else evaluate
    rng = host_generator(key)
    mixtures, evidence = adapt_mixtures(
        rng, targets, mixtures, settings.num_importance, evaluate
    )
    points = resample_walkers(
        evidence, targets, mixtures, settings.num_chains, settings.num_walkers
    )
    num_objects = targets.structures.shape[0]
    counts = no_moves(num_objects)
    is_open = can_change = np.ones(num_objects, bool)

    def sweep_once(points: Point, mixtures: LaplaceMixture) -> Point:
        for move in _CYCLE:
            is_asked = is_open & (can_change | (move != "change"))
            if not np.any(is_asked):
                continue
            batch = propose_all(move, rng, points, targets, mixtures)
            where = batch.proposal.structure, batch.proposal.z
            log_density = evaluate_asked(evaluate, targets, *where, is_asked)
            points, info = decide_all(rng, points, batch, log_density)
            count_moves(counts, move, info, is_asked)
        return points

    places = []
    for _ in range(settings.num_warmup):
        points = sweep_once(points, mixtures)
        places.append((np.asarray(points.structure), np.asarray(points.z)))
    if places:
        can_change = _can_change(counts)
        counts = no_moves(num_objects)
        mixtures, points = _refitted(targets, mixtures, points, places)
    draws, kept, every = None, [], 1
    for doubling in range(settings.max_doublings + 1):
        if doubling > 1:
            every *= 2
        for _ in range(settings.num_sweeps):
            for _ in range(every):
                points = sweep_once(points, mixtures)
            kept.append(points)
        if doubling > 0:
            kept = kept[1::2]
        latest = _arrange(kept, settings)
        # Those whose chains agreed before have not moved since.
        draws = latest if draws is None else taken_over(is_open, latest, draws)
        is_open = is_open & ~np.broadcast_to(is_mixed(draws), num_objects)
        if not np.any(is_open) or doubling == settings.max_doublings:
            break
        # Walkers that started from few draws have gone further by now.
        places = [(np.asarray(p.structure), np.asarray(p.z)) for p in kept]
        mixtures, points = _refitted(targets, mixtures, points, places)
    assert draws is not None
    return Population(
        draws=draws,
        counts=counts,
        evidence=evidence,
    )


def _refitted(
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    points: Point,
    places: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[LaplaceMixture, Point]:
    """Mixtures with a component where walkers came by, which walk on with them.

    Args:
        targets: stacked along a leading object axis.
        mixtures: one of each object, with spare components.
        points: where walkers stand.
        places: structures and coordinates of all of them, sweep after sweep.
    """
    visited = (np.concatenate(part, axis=1) for part in zip(*places, strict=True))
    mixtures = fit_spare(targets, mixtures, *visited)
    proposal = log_proposal_of(targets, mixtures, points.structure, points.z)
    return mixtures, eqx.tree_at(lambda p: p.log_proposal, points, proposal)


def _can_change(counts: MoveCounts) -> np.ndarray:
    """Objects that go on with changes, `[object]`, by what was accepted in warm-up.

    Those where they are of use, or more so than jumps that change the structure.
    """
    change, jump = MOVES.index("change"), MOVES.index("jump")
    proposed = counts.proposed[:, change].sum(axis=1)
    accepted = counts.accepted[:, change].sum(axis=1)
    is_frequent = accepted + 1 >= _LEAST_ACCEPTED * proposed
    is_rare_elsewhere = accepted > counts.accepted[:, jump, 1]
    return (is_frequent | is_rare_elsewhere) & (proposed > 0)


def _arrange(kept: list[Point], settings: PopulationSettings) -> ChainDraws:
    """Sweeps put together, walker after walker within each chain."""

    def whole(name: str) -> Array:
        parts = [np.asarray(getattr(points, name)) for points in kept]
        stacked = np.stack(parts, axis=2)
        num_objects = stacked.shape[0]
        shape = (num_objects, settings.num_chains, -1, *stacked.shape[3:])
        return on_device(stacked.reshape(shape), stacked.dtype)

    return ChainDraws(whole("structure"), whole("z"), whole("log_density"))
