"""From targets to draws: fit, propose from the fitted mixture, jump, check."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.chain_diagnostics import ChainDiagnostics, diagnose_chains
from boomdp_jax.inference.compile_ahead import CompileAhead, signature
from boomdp_jax.inference.evaluate import evaluate_points
from boomdp_jax.inference.find_modes import Found, find_modes
from boomdp_jax.inference.fit import FitSettings, Modes
from boomdp_jax.inference.fit_noise import NoiseFit, filter_points
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.mixture_building import (
    add_prior_components,
    add_slot_components,
    add_spare_components,
    laplace_mixture,
)
from boomdp_jax.inference.noise import host_generator
from boomdp_jax.inference.one_step import NOISE_SHAPE
from boomdp_jax.inference.population import (
    MoveCounts,
    Population,
    PopulationSettings,
    sample_population,
)
from boomdp_jax.inference.structure_chain import ChainDraws
from boomdp_jax.inference.target import StructureTarget

# Chains go on where an R-hat of any object exceeds this.
_R_HAT = 1.015


class SampleSettings(NamedTuple):
    """How much to draw."""

    num_chains: int = 4
    num_warmup: int = 200
    num_samples: int = 500
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


class BlockDraws(NamedTuple):
    """What sampling a batch of equal blocks gives; leading axis `object`, on the host.

    `[object, draw, ...]` unless a field says otherwise.
    """

    structure: np.ndarray
    z: np.ndarray
    """`[object, draw, dim]`."""
    log_density: np.ndarray
    noise_scale: np.ndarray
    """`[object, draw, body, 4]`."""
    log_evidence: np.ndarray
    """`[object]`."""
    importance_probability: Float[Array, "object structure"]
    """Structure probabilities by importance sampling, a cross-check."""
    importance_size: Float[Array, " object"]
    diagnostics: list[ChainDiagnostics]
    chain_index: np.ndarray
    """Index of each chain; draws lie chain after chain."""


@QuickCompile
def start_mixtures(targets: StructureTarget, modes: Modes) -> LaplaceMixture:
    """Proposal mixtures: fitted modes, modes times priors, and the prior."""

    def one(target, modes):
        mixture = laplace_mixture(
            target, modes.structure, modes.z, modes.precision, modes.log_density
        )
        mixture = add_slot_components(target, mixture, total_weight=0.4)
        mixture = add_prior_components(target, mixture, total_weight=0.02)
        return add_spare_components(target, mixture)

    return jax.vmap(one)(targets, modes)


def sample_blocks(
    key: Key,
    targets: StructureTarget,
    settings: SampleSettings,
    report: Callable[[str], None] = lambda stage: None,
) -> BlockDraws:
    """Posterior draws over structures and coordinates of a batch of equal blocks.

    Args:
        key: random key.
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        settings: how much to draw.
        report: called with the name of each stage as it begins.

    Returns:
        Draws of all chains one after the other, noise drawn given each.
    """
    fit_key, chain_key, noise_key = jax.random.split(key, 3)
    ahead = CompileAhead(
        lambda: _rehearse(chain_key, targets, settings), (signature(targets), settings)
    )
    with ahead:
        found: Found = find_modes(fit_key, targets, settings.fit, report)
    targets = found.targets
    report("jumping between structures")
    mixtures = start_mixtures(targets, found.modes)
    population = sample_population(
        chain_key,
        targets,
        mixtures,
        settings.population,
        is_mixed=lambda draws: _is_mixed(targets, draws),
    )
    draws, evidence = population.draws, population.evidence
    num_objects = targets.structures.shape[0]
    structure = np.asarray(draws.structure).reshape(num_objects, -1)
    z = np.asarray(draws.z).reshape(*structure.shape, -1)
    log_joint = np.asarray(evidence.log_evidence, float) + np.asarray(targets.log_prior)
    return BlockDraws(
        structure=structure,
        z=z,
        log_density=np.asarray(draws.log_density).reshape(structure.shape),
        noise_scale=draw_noise_scales(noise_key, targets, structure, z),
        log_evidence=np.logaddexp.reduce(log_joint, axis=-1),
        importance_probability=evidence.probability,
        importance_size=evidence.effective_sample_size,
        diagnostics=[_diagnose(targets, population, i) for i in range(num_objects)],
        chain_index=np.arange(settings.num_chains),
    )


def _rehearse(key: Key, targets: StructureTarget, settings: SampleSettings) -> None:
    """Go through all stages but the likelihood of many points, to compile them."""
    num_objects, num_structures = targets.structures.shape[:2]
    likelihood: Any = targets.log_likelihood
    reading = np.asarray(likelihood.reference, float)[:1]
    dim = targets.slot.shape[1]
    first = np.zeros(1, int)
    noise = NoiseFit(reading, reading[..., 2:])
    filter_points(targets, first, first, np.zeros((1, dim)), noise)
    num_modes = num_structures * settings.fit.num_modes
    dtype = targets.log_prior.dtype
    structure = np.repeat(np.arange(num_structures), settings.fit.num_modes)
    structure = np.broadcast_to(structure, (num_objects, num_modes))
    precision = np.broadcast_to(np.eye(dim), (num_objects, num_modes, dim, dim))
    modes = Modes(
        structure=on_device(structure, np.dtype(np.int32)),
        z=on_device(np.zeros((num_objects, num_modes, dim)), dtype),
        precision=on_device(precision, dtype),
        log_density=on_device(np.zeros((num_objects, num_modes)), dtype),
    )
    sample_population(
        key,
        targets,
        start_mixtures(targets, modes),
        settings.population._replace(num_warmup=1, num_sweeps=1),
        evaluate=lambda targets, structure, z: on_device(
            np.zeros(structure.shape), dtype
        ),
    )


def _is_mixed(targets: StructureTarget, draws: ChainDraws) -> bool:
    """Whether the chains of every object agree."""
    for index in range(targets.structures.shape[0]):
        verdict = diagnose_chains(*_pick((targets, draws), index))
        if max(verdict.r_hat.values(), default=1.0) > _R_HAT:
            return False
    return True


def _pick(tree, index: int):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


def _diagnose(
    targets: StructureTarget, population: Population, index: int
) -> ChainDiagnostics:
    """Judge one object."""
    counts = population.counts
    return diagnose_chains(
        *_pick((targets, population.draws), index),
        MoveCounts(counts.proposed[index][None], counts.accepted[index][None]),
    )


def draw_noise_scales(key: Key, targets: StructureTarget, structure, z) -> np.ndarray:
    """Noise scales given every draw, from their inverse-gamma distribution."""
    num_objects, num_draws = structure.shape
    index = np.repeat(np.arange(num_objects), num_draws)
    found = evaluate_points(
        targets,
        index,
        structure.reshape(-1),
        z.reshape(num_objects * num_draws, -1),
    )
    likelihood: Any = targets.log_likelihood
    reference = np.asarray(likelihood.reference, float)
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[:, None] / reference
    shape = NOISE_SHAPE + 0.5 * found.num
    rate = scale[index] ** 2 + 0.5 * found.square
    draws = host_generator(key).gamma(shape)
    sd = reference[index] * np.sqrt(rate / draws)
    return sd.astype(z.dtype).reshape(num_objects, num_draws, *sd.shape[1:])
