"""A better mixture to propose from: fitted to walkers instead of to modes alone.

Weighted draws of a poor mixture are few in effect, and a component fitted to them is
too narrow. So they are resampled, structure by structure, and walk a little within
their structures, which spreads them over ridges that the modes' bumps leave out; a
component per structure is fitted to where they stand, with which they walk on.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.importance_evidence import ImportanceEvidence
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.moves import Point
from boomdp_jax.inference.resampling import systematic
from boomdp_jax.inference.spare_fit import fit_spare
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.walker_moves import (
    MoveCounts,
    count_moves,
    decide_all,
    log_proposal_of,
    no_moves,
    propose_all,
)
from boomdp_jax.inference.weighing import refine, weigh

# Rounds end where every structure of such a probability has this many effective draws.
_MATTERS, _ENOUGH = 0.01, 300.0
_NUM_WALKERS, _NUM_WALKS = 512, 6
# A structure gets walkers if its probability is above this; half of them are spread
# evenly over all that do.
_LEAST_PROBABILITY, _EVEN_SHARE = 1e-8, 0.5
_WALK_STEP, _WALK_ACCEPT = 0.5, 0.4


class Adapted(NamedTuple):
    """Mixtures, and weighted draws of ones hardly different."""

    mixtures: LaplaceMixture
    evidence: ImportanceEvidence


class Walked(NamedTuple):
    """Where walkers ended, and how their moves went."""

    points: Point
    counts: MoveCounts


def adapt_mixtures(
    rng: np.random.Generator,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num_draws: int,
    evaluate: Callable[..., Array],
    *,
    max_rounds: int = 6,
) -> Adapted:
    """Adapt mixtures to their posteriors, in rounds.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        mixtures: one of each object, with spare components.
        num_draws: of each round and object.
        evaluate: log-densities of as many points of every object.
        max_rounds: rounds of walks, at least 1; fewer where draws are enough.

    Returns:
        Mixtures with other weights and, where walkers were enough, with a component
        for each structure fitted to them; and the last round's weighted draws, from
        mixtures that did not depend on them.
    """
    found = weigh(rng, targets, mixtures, num_draws, evaluate)
    mixtures = refine(targets, mixtures, found)
    points = _walkers(rng, found, targets, mixtures)
    for _ in range(max_rounds):
        points = walk(rng, points, targets, mixtures, evaluate, _NUM_WALKS).points
        places = np.asarray(points.structure), np.asarray(points.z)
        mixtures = fit_spare(targets, mixtures, *places)
        found = weigh(rng, targets, mixtures, num_draws, evaluate)
        mixtures = refine(targets, mixtures, found)
        if _is_enough(found):
            break
    return Adapted(mixtures, found)


def walk(
    rng: np.random.Generator,
    points: Point,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    evaluate: Callable[..., Array],
    num_walks: int,
) -> Walked:
    """Some steps of every walker within its structure.

    Args:
        rng: source of randomness.
        points: where walkers stand.
        targets: stacked along a leading object axis.
        mixtures: one of each object.
        evaluate: log-densities of as many points of every object.
        num_walks: steps; their size adapts to the acceptance of the one before.
    """
    log_proposal = log_proposal_of(targets, mixtures, points.structure, points.z)
    points = eqx.tree_at(lambda p: p.log_proposal, points, log_proposal)
    num_objects = targets.structures.shape[0]
    counts, step_size = no_moves(num_objects), np.full(num_objects, _WALK_STEP)
    for _ in range(num_walks):
        batch = propose_all("walk", rng, points, targets, mixtures, step_size)
        where = batch.proposal.structure, batch.proposal.z
        points, info = decide_all(rng, points, batch, evaluate(targets, *where))
        count_moves(counts, "walk", info)
        rate = np.mean(np.asarray(info.accept_probability, float), axis=1)
        step_size = np.clip(step_size * np.exp(rate - _WALK_ACCEPT), 0.02, 0.98)
    return Walked(points, counts)


def _is_enough(evidence: ImportanceEvidence) -> bool:
    """Whether every structure that matters has draws enough, for every object."""
    size = np.asarray(evidence.structure_sample_size)
    return not np.any(size[np.asarray(evidence.probability) > _MATTERS] < _ENOUGH)


def _walkers(
    rng: np.random.Generator,
    found: ImportanceEvidence,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
) -> Point:
    """Walkers by weight within each structure, with improbable structures raised."""
    weight = np.exp(np.asarray(found.log_weight, float))
    structure = np.asarray(found.structure)
    probability = np.asarray(found.probability, float)
    is_possible = probability > _LEAST_PROBABILITY
    even = is_possible / np.maximum(is_possible.sum(axis=1, keepdims=True), 1)
    share = (1.0 - _EVEN_SHARE) * probability + _EVEN_SHARE * even
    factor = np.where(is_possible, share / np.where(is_possible, probability, 1.0), 0.0)
    each = np.arange(len(structure))[:, None]
    raised = weight * factor[each, structure]
    rows = np.stack([systematic(rng, w, _NUM_WALKERS) for w in raised])

    def pick_rows(leaf: Array) -> Array:
        return on_device(np.asarray(leaf)[each, rows], leaf.dtype)

    picked = pick_rows(found.structure), pick_rows(found.z)
    return Point(
        structure=picked[0],
        z=picked[1],
        log_density=pick_rows(found.log_density),
        log_proposal=log_proposal_of(targets, mixtures, *picked),
    )
