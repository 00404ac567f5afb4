"""From a target to the mixture that its jumps are drawn from, and the structures' odds.

Every structure is fitted from many starts; its modes become Laplace components, the
structures with one slot less and the prior fill the gaps, and importance sampling sets
the weights.
"""

import equinox as eqx
import jax

from boomdp_jax.core.arrays import Key
from boomdp_jax.inference.fit import FitSettings, Modes, fit_modes
from boomdp_jax.inference.importance_evidence import (
    ImportanceEvidence,
    importance_evidence,
)
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.mixture_building import (
    add_prior_components,
    add_slot_components,
    laplace_mixture,
    refine_weights,
)
from boomdp_jax.inference.target import StructureTarget


def fitted_mixture(
    key: Key,
    target: StructureTarget,
    *,
    settings: FitSettings | None = None,
    num_importance: int = 2048,
) -> tuple[LaplaceMixture, ImportanceEvidence]:
    """Fit every structure of one object and weigh what was found.

    Args:
        key: random key.
        target: with a `OneStepLikelihood`.
        settings: how hard to look for modes.
        num_importance: draws that weigh components and structures.

    Returns:
        A mixture with components for every structure, and the evidence.
    """
    fit_key, importance_key = jax.random.split(key)
    stacked = jax.tree.map(lambda leaf: leaf[None], target)
    modes = fit_modes(fit_key, stacked, settings)
    modes = jax.tree.map(lambda leaf: leaf[0], modes)
    return _weighed(importance_key, target, modes, num_importance)


@eqx.filter_jit
def _weighed(
    key: Key, target: StructureTarget, modes: Modes, num_importance: int
) -> tuple[LaplaceMixture, ImportanceEvidence]:
    mixture = laplace_mixture(
        target, modes.structure, modes.z, modes.precision, modes.log_density
    )
    mixture = add_slot_components(target, mixture, total_weight=0.4)
    mixture = add_prior_components(target, mixture, total_weight=0.02)
    evidence = importance_evidence(key, target, mixture, num_importance)
    mixture = refine_weights(
        target, mixture, evidence.structure, evidence.z, evidence.log_weight
    )
    return mixture, evidence
