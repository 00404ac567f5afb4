"""What every sampler over structures is asked for, and what it gives."""

from typing import NamedTuple

import jax
import numpy as np

from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.fits.fit import FitSettings, Modes
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.chain_diagnostics import (
    ChainDiagnostics,
    diagnose_chains,
)
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.mixture_building import (
    add_prior_components,
    add_slot_components,
    add_spare_components,
    laplace_mixture,
)
from boomdp_jax.inference.samplers.population import PopulationSettings
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from boomdp_jax.inference.samplers.structure_evidence import StructureEvidence

# Chains of an object go on where an R-hat exceeds this.
_R_HAT = 1.015


class SampleSettings(NamedTuple):
    """How much to draw."""

    num_chains: int = 4
    num_warmup: int = 200
    num_samples: int = 500
    """Draws of each chain."""
    num_importance: int = 2048
    num_walkers: int = 64
    """Of each chain, at most as many as draws."""
    fit: FitSettings = FitSettings()

    @property
    def population(self) -> PopulationSettings:
        """The same in sweeps of all walkers; at least as many draws as asked for."""
        num_walkers = min(self.num_walkers, self.num_samples)
        return PopulationSettings(
            num_chains=self.num_chains,
            num_walkers=num_walkers,
            num_warmup=-(-self.num_warmup // num_walkers),
            num_sweeps=-(-self.num_samples // num_walkers),
            num_importance=max(self.num_importance, self.num_chains * num_walkers),
        )


class StructureDraws(NamedTuple):
    """Draws of a batch of objects, all of equal weight; on the host."""

    structure: np.ndarray
    """`[object, chain, draw]`."""
    z: np.ndarray
    """`[object, chain, draw, dim]`."""
    log_density: np.ndarray
    """`[object, chain, draw]`."""
    evidence: StructureEvidence
    diagnostics: list[ChainDiagnostics]
    """One of each object."""


@QuickCompile
def start_mixtures(targets: StructureTarget, modes: Modes) -> LaplaceMixture:
    """Proposal mixtures: fitted modes, modes times priors, and the prior."""

    def one(target: StructureTarget, modes: Modes) -> LaplaceMixture:
        mixture = laplace_mixture(
            target,
            modes.structure,
            modes.z,
            modes.precision,
            modes.log_density,
            most_each=len(modes.structure) // target.num_structures,
        )
        mixture = add_slot_components(target, mixture, total_weight=0.4)
        mixture = add_prior_components(target, mixture, total_weight=0.02)
        return add_spare_components(target, mixture)

    return jax.vmap(one)(targets, modes)


def pick_object(tree, index: int):
    """One object of a batch, on the host."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


def chains_agree(targets: StructureTarget, draws: ChainDraws) -> np.ndarray:
    """Whether the chains of each object may end, `[object]`.

    Args:
        targets: stacked along a leading object axis.
        draws: `[object, chain, draw]`.
    """
    verdicts = [
        diagnose_chains(*pick_object((targets, draws), index))
        for index in range(targets.structures.shape[0])
    ]
    largest = [max(verdict.r_hat.values(), default=1.0) for verdict in verdicts]
    # Too few draws to tell count as agreeing: more would be as few.
    return ~(np.array(largest) > _R_HAT)
