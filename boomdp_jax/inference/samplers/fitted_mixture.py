"""From a target to the mixture that its jumps are drawn from, and the structures' odds.

Every structure is fitted from many starts; its modes become Laplace components, the
structures with one slot less and the prior fill the gaps, and walkers and importance
sampling set the weights.
"""

from typing import NamedTuple

import jax

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.adapt_mixture import adapt_mixtures
from boomdp_jax.inference.samplers.importance_evidence import ImportanceEvidence
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.structure_draws import start_mixtures
from boomdp_jax.inference.samplers.weighing import evaluate_each


class FittedMixture(NamedTuple):
    """A target with the gains of its fits, where to jump, and how odds stand."""

    target: StructureTarget
    mixture: LaplaceMixture
    evidence: ImportanceEvidence


def fitted_mixture(
    key: Key,
    target: StructureTarget,
    *,
    settings: FitSettings | None = None,
    num_importance: int = 2048,
) -> FittedMixture:
    """Fit every structure of one object and weigh what was found.

    Args:
        key: random key.
        target: with a `FilteredLikelihood`, as `make_block` gives it.
        settings: how hard to look for modes.
        num_importance: draws that weigh components and structures.

    Returns:
        The target with filters, a mixture with components for every structure, and the
        evidence.
    """
    fit_key, importance_key = jax.random.split(key)
    stacked = jax.tree.map(lambda leaf: leaf[None], target)
    settings = FitSettings() if settings is None else settings
    found = find_modes(fit_key, stacked, settings)
    mixtures = start_mixtures(found.targets, found.modes)
    mixtures, evidence = adapt_mixtures(
        host_generator(importance_key),
        found.targets,
        mixtures,
        num_importance,
        evaluate_each,
    )
    every = FittedMixture(found.targets, mixtures, evidence)
    return jax.tree.map(lambda leaf: leaf[0], every)
