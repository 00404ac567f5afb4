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
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.importance_evidence import ImportanceEvidence
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import Point
from boomdp_jax.inference.samplers.resampling import systematic
from boomdp_jax.inference.samplers.spare_fit import fit_spare
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
    refine,
    taken_over,
    weigh,
)

# Rounds end where every structure of such a probability has this many effective draws,
# and from the last number of rounds on where they are no more than so many times what
# they were.
_MATTERS, _ENOUGH, _GROWTH, _FEW_ROUNDS = 0.01, 300.0, 1.5, 3
_NUM_WALKERS, _NUM_WALKS = 512, 6
# The first few steps of a round take walkers apart; a component is fitted to the rest.
_NUM_PASSED_OVER = 2
# A structure gets walkers if its probability is above this; half of them are spread
# evenly over all that do.
_LEAST_PROBABILITY, _EVEN_SHARE = 1e-8, 0.5


class Adapted(NamedTuple):
    """Mixtures, and weighted draws of ones hardly different."""

    mixtures: LaplaceMixture
    evidence: ImportanceEvidence


class Walked(NamedTuple):
    """Where walkers ended and came by, and how their moves went."""

    points: Point
    counts: MoveCounts
    places: tuple[np.ndarray, ...]
    """Structures `[object, place]` and coordinates `[object, place, dim]` after each
    step but the first few, if they were asked for."""


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
        evaluate: as `weighing.evaluate_each`.
        max_rounds: rounds of walks, at least 1; fewer where draws are enough, or where
            there come to be no more of them.

    Returns:
        Mixtures with other weights and, where walkers were enough, with a component
        for each structure fitted to them; and the last round's weighted draws, from
        mixtures that did not depend on them.
    """
    found = weigh(rng, targets, mixtures, num_draws, evaluate)
    mixtures = refine(targets, mixtures, found)
    points = _walkers(rng, found, targets, mixtures)
    is_open = np.ones(targets.structures.shape[0], bool)
    most = np.zeros(targets.structures.shape[0])
    for number in range(max_rounds):
        known = points, targets, mixtures, evaluate
        walked = walk(rng, *known, _NUM_WALKS * is_open, with_places=True)
        points = walked.points
        fitted = fit_spare(targets, mixtures, *walked.places)
        again = weigh(rng, targets, fitted, num_draws, evaluate, is_open)
        fitted = refine(targets, fitted, again)
        mixtures = taken_over(is_open, fitted, mixtures)
        found = taken_over(is_open, again, found)
        size = _least_size(found)
        is_open = is_open & (size < _ENOUGH)
        if number + 1 >= _FEW_ROUNDS:
            is_open = is_open & (size > _GROWTH * most)
        if not np.any(is_open):
            break
        most = np.maximum(most, size)
    return Adapted(mixtures, found)


def walk(
    rng: np.random.Generator,
    points: Point,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    evaluate: Callable[..., Array],
    num_walks: np.ndarray,
    *,
    with_places: bool = False,
) -> Walked:
    """Some steps of every walker within its structure.

    Args:
        rng: source of randomness.
        points: where walkers stand.
        targets: stacked along a leading object axis.
        mixtures: one of each object.
        evaluate: as `weighing.evaluate_each`.
        num_walks: steps of the walkers of each object, `[object]`.
        with_places: whether to keep where they come by.
    """
    log_proposal = log_proposal_of(targets, mixtures, points.structure, points.z)
    points = eqx.tree_at(lambda p: p.log_proposal, points, log_proposal)
    counts = no_moves(targets.structures.shape[0])
    places = []
    for number in range(num_walks.max()):
        is_asked = number < num_walks
        batch = propose_all("walk", rng, points, targets, mixtures)
        where = batch.proposal.structure, batch.proposal.z
        log_density = evaluate_asked(evaluate, targets, *where, is_asked)
        points, info = decide_all(rng, points, batch, log_density)
        count_moves(counts, "walk", info, is_asked)
        if with_places and number >= _NUM_PASSED_OVER:
            places.append((np.asarray(points.structure), np.asarray(points.z)))
    joined = (np.concatenate(parts, axis=1) for parts in zip(*places, strict=True))
    return Walked(points, counts, tuple(joined))


def _least_size(evidence: ImportanceEvidence) -> np.ndarray:
    """Effective draws of the structure that has fewest of those that matter."""
    matters = np.asarray(evidence.probability) > _MATTERS
    size = np.asarray(evidence.structure_sample_size)
    return np.min(np.where(matters, size, np.inf), axis=1)


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
