"""Every structure weighed by importance sampling, and checked by a bridge.

The mixture of fitted modes is adapted until every structure that matters has draws
enough (Bugallo et al. 2017, Adaptive importance sampling), then draws of their own give
the evidence of each. Draws are resampled and
walk a few steps within their structures; a bridge between the two sets gives the
evidence of each structure that matters, which heavy tails of the weights do not upset.

No chain has to find its way between structures: prefer it where structures are few, or
where the odds of an improbable one matter.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.fits.fit import Modes
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.adapt_mixture import adapt_mixtures, walk
from boomdp_jax.inference.samplers.bridge_structures import bridge_structures
from boomdp_jax.inference.samplers.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.samplers.moves import Point
from boomdp_jax.inference.samplers.resampling import resample_walkers, systematic
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from boomdp_jax.inference.samplers.structure_draws import (
    SampleSettings,
    StructureDraws,
    pick_object,
    start_mixtures,
)
from boomdp_jax.inference.samplers.walker_moves import (
    MoveCounts,
)
from boomdp_jax.inference.samplers.weighing import evaluate_each, weigh

# The round that counts is so many times larger than those that adapt the mixture.
_LAST_ROUND = 2
# Steps of resampled draws where weights leave this share of a round's draws, and where
# they leave fewer.
_GOOD_SHARE, _NUM_WALKS = 0.25, (3, 20)


def enumerate_structures(
    key: Key,
    targets: StructureTarget,
    modes: Modes,
    settings: SampleSettings,
    evaluate: Callable[..., Array] = evaluate_each,
) -> StructureDraws:
    """Evidence of every structure of a batch of objects, and draws by their odds.

    Args:
        key: random key.
        targets: stacked along a leading object axis.
        modes: fitted modes of every structure.
        settings: how much to draw.
        evaluate: as `weighing.evaluate_each`.

    Returns:
        Draws in chains that share nothing but the mixture, and the evidence.
        Diagnostics are not ok where the evidence of a structure that matters is not
        known well, where importance sampling and the bridge disagree beyond their
        errors, and where chains disagree.
    """
    rng = host_generator(key)
    mixtures = start_mixtures(targets, modes)
    size = settings.num_importance
    mixtures = adapt_mixtures(rng, targets, mixtures, size, evaluate).mixtures
    found = weigh(rng, targets, mixtures, _LAST_ROUND * size, evaluate)
    points = resample_walkers(
        found, targets, mixtures, settings.num_chains, settings.num_samples
    )
    # Few effective draws are repeated often, and have to walk apart.
    is_poor = np.asarray(found.effective_sample_size) < _GOOD_SHARE * size
    num_walks = np.where(is_poor, *_NUM_WALKS[::-1])
    points, counts, _ = walk(rng, points, targets, mixtures, evaluate, num_walks)
    bridged = bridge_structures(targets, mixtures, found, points, settings.num_chains)
    draws = _in_chains(rng, points, bridged.evidence.probability, settings.num_chains)
    verdicts = []
    for index, reasons in enumerate(bridged.reasons):
        move_counts = MoveCounts(
            counts.proposed[index][None], counts.accepted[index][None]
        )
        verdict = diagnose_chains(*pick_object((targets, draws), index), move_counts)
        sizes = verdict.effective_sample_size | {
            "importance weights": float(found.effective_sample_size[index])
        }
        reasons = [*verdict.reasons, *reasons]
        verdicts.append(
            verdict._replace(
                ok=not reasons, reasons=reasons, effective_sample_size=sizes
            )
        )
    return StructureDraws(
        structure=np.asarray(draws.structure),
        z=np.asarray(draws.z),
        log_density=np.asarray(draws.log_density),
        evidence=bridged.evidence,
        diagnostics=verdicts,
    )


def _in_chains(
    rng: np.random.Generator, points: Point, probability: np.ndarray, num_chains: int
) -> ChainDraws:
    """Draws of each chain in random order, structures by their final probability."""
    structure = np.asarray(points.structure)
    num_objects, num = structure.shape[0], structure.shape[1] // num_chains
    order = np.zeros((num_objects, num_chains, num), int)
    for i, c in np.ndindex(num_objects, num_chains):
        mine = structure[i, c * num : (c + 1) * num]
        rows = np.argsort(mine, kind="stable")
        share = np.bincount(mine, minlength=probability.shape[1]) / num
        weight = (probability[i] / np.where(share > 0, share, 1.0))[mine[rows]]
        chosen = rows[systematic(rng, weight, num)]
        order[i, c] = c * num + rng.permutation(chosen)
    each = np.arange(num_objects)[:, None, None]

    def arrange(leaf: Array) -> Array:
        return on_device(np.asarray(leaf)[each, order], leaf.dtype)

    return ChainDraws(
        arrange(points.structure), arrange(points.z), arrange(points.log_density)
    )
