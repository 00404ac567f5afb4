"""From weighted draws to walkers of equal weight."""

import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.importance_evidence import ImportanceEvidence
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import Point
from boomdp_jax.inference.samplers.walker_moves import log_proposal_of


def resample_walkers(
    evidence: ImportanceEvidence,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num_chains: int,
    num_walkers: int,
) -> Point:
    """Resample walkers of each chain from its own share of the weighed draws.

    Draws are dealt out in turn, so that systematically drawn components are shared
    evenly. Resampling is systematic about the middle of each interval.

    Args:
        evidence: draws of a batch of objects with their weights.
        targets: stacked along a leading object axis.
        mixtures: one of each object.
        num_chains: of each object.
        num_walkers: of each chain.

    Returns:
        Walkers `[object, chain x walker]`, those of one chain after the other.
    """
    num_objects, num_draws = evidence.log_weight.shape
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
        log_proposal=log_proposal_of(targets, mixtures, structure, z),
    )


def systematic(rng: np.random.Generator, weight: np.ndarray, num: int) -> np.ndarray:
    """Choose places by weight, systematically; Kitagawa (1996), Monte Carlo filter.

    Args:
        rng: source of randomness.
        weight: of each place, need not be normalised; all zero counts as all equal.
        num: how many to choose.

    Returns:
        Ascending places, each about `num` times its share.
    """
    weight = np.where(np.isfinite(weight), weight, 0.0)
    if not weight.sum() > 0:
        weight = np.ones_like(weight)
    total = np.cumsum(weight / weight.sum())
    level = (np.arange(num) + rng.random()) / num
    return np.minimum(np.searchsorted(total, level, side="right"), len(weight) - 1)
