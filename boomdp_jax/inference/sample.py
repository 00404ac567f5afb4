"""From targets to draws: fit, draw by one of several methods, check."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.compile_ahead import CompileAhead, signature
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.core.spread import is_spread
from boomdp_jax.inference.fits.find_modes import (
    Found,
    find_modes,
    find_modes_of_exact_starts,
)
from boomdp_jax.inference.fits.fit import Host, Modes
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.exact_starts import ExactStarts
from boomdp_jax.inference.likelihoods.filter_points import (
    filter_densities,
    filter_points,
)
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.correction import infer_noise, noise_about_peaks
from boomdp_jax.inference.noise.linear_track import LinearTracks
from boomdp_jax.inference.noise.scales import draw_noise_scales
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.inference.samplers.chain_diagnostics import (
    ChainDiagnostics,
    diagnose_chains,
)
from boomdp_jax.inference.samplers.enumerate_structures import enumerate_structures
from boomdp_jax.inference.samplers.laplace_draws import best_hypothesis, sample_laplace
from boomdp_jax.inference.samplers.population import Population, sample_population
from boomdp_jax.inference.samplers.structure_draws import (
    SampleSettings,
    StructureDraws,
    chains_agree,
    pick_object,
    start_mixtures,
)
from boomdp_jax.inference.samplers.structure_evidence import (
    StructureEvidence,
    VisitedShares,
    evidence_by_importance,
    odds_disagree,
    visited_shares,
)
from boomdp_jax.inference.samplers.tempered_smc import sample_tempered
from boomdp_jax.inference.samplers.walker_moves import MoveCounts
from boomdp_jax.inference.samplers.weighing import evaluate_each

# Importance sampling is heard only with as many effective draws.
_MIN_SAMPLE_SIZE = 100.0


def sample_blocks(
    key: Key,
    targets: StructureTarget,
    settings: SampleSettings,
    report: Callable[[str], None] = lambda stage: None,
    *,
    method: str = "rj",
    starts: ExactStarts | None = None,
) -> BlockDraws:
    """Posterior draws over structures and coordinates of a batch of equal blocks.

    Args:
        key: random key.
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        settings: how much to draw.
        report: called with the name of each stage as it begins.
        method: one of `SAMPLERS`.
        starts: where predictions start, from readings that are taken as exact; None:
            states are latent, and noise of the motion is inferred as well.

    Returns:
        Draws of all chains one after the other, noise drawn given each.
    """
    fit_key, draw_key, noise_key = jax.random.split(key, 3)
    draw = SAMPLERS[method]
    with_filters = starts is None and not is_spread()
    ahead = CompileAhead(
        lambda: _rehearse(draw_key, targets, settings, draw, with_filters),
        (signature(targets), settings, method, with_filters),
    )
    if starts is not None:
        with ahead:
            targets, modes = find_modes_of_exact_starts(
                fit_key, targets, starts, settings.fit, report
            )
        report(_STAGES[method])
        drawn = draw(draw_key, targets, modes, settings, evaluate_each)
        return _with_integrated_noise(
            noise_key, targets, drawn, is_drawn=method != "map"
        )
    with ahead:
        found: Found = find_modes(fit_key, targets, settings.fit, report)
    targets = found.targets
    report(_STAGES[method])
    drawn = draw(draw_key, targets, found.modes, settings, evaluate_each)
    report("inferring the noise")
    rng = host_generator(noise_key)
    if method in ("laplace", "map"):
        return _with_noise_about_peaks(
            rng, targets, found.noise, drawn, is_drawn=method == "laplace"
        )
    corrected = infer_noise(
        rng,
        targets,
        found.noise,
        drawn.structure,
        drawn.z,
        drawn.log_density,
        drawn.evidence,
        report,
    )
    shape = (corrected.structure.shape[0], corrected.structure[0].size)
    return BlockDraws(
        structure=corrected.structure.reshape(shape),
        z=corrected.z.reshape(*shape, -1).astype(drawn.z.dtype),
        log_density=corrected.log_density.reshape(shape),
        noise_scale=corrected.noise.reading.reshape(*shape, -1, 4),
        impulse_scale=corrected.noise.impulse.reshape(*shape, -1, 2),
        log_evidence=corrected.evidence.total,
        evidence=corrected.evidence,
        diagnostics=[
            _with_reasons(verdict, reasons)
            for verdict, reasons in zip(
                drawn.diagnostics, corrected.reasons, strict=True
            )
        ],
        chain_index=np.arange(drawn.structure.shape[1]),
    )


def _with_reasons(verdict: ChainDiagnostics, reasons: list[str]) -> ChainDiagnostics:
    reasons = [*verdict.reasons, *reasons]
    return verdict._replace(ok=not reasons, reasons=reasons)


def _with_noise_about_peaks(
    rng: np.random.Generator,
    targets: StructureTarget,
    noise: NoiseFit,
    drawn: StructureDraws,
    *,
    is_drawn: bool,
) -> BlockDraws:
    """Draws of an approximate method with noise that is no better."""
    structure = drawn.structure.reshape(len(drawn.structure), -1)
    z = drawn.z.reshape(*structure.shape, -1)
    log_density = drawn.log_density.reshape(structure.shape)
    own = noise_about_peaks(
        rng, targets, noise, structure, z, log_density, is_drawn=is_drawn
    )
    return BlockDraws(
        structure=structure,
        z=z,
        log_density=log_density,
        noise_scale=own.reading.reshape(*structure.shape, -1, 4),
        impulse_scale=own.impulse.reshape(*structure.shape, -1, 2),
        log_evidence=drawn.evidence.total,
        evidence=drawn.evidence,
        diagnostics=drawn.diagnostics,
        chain_index=np.arange(drawn.structure.shape[1]),
    )


def _with_integrated_noise(
    key: Key, targets: StructureTarget, drawn: StructureDraws, *, is_drawn: bool
) -> BlockDraws:
    """Draws of a likelihood that noise was integrated out of, with noise given each."""
    structure = drawn.structure.reshape(len(drawn.structure), -1)
    z = drawn.z.reshape(*structure.shape, -1)
    return BlockDraws(
        structure=structure,
        z=z,
        log_density=drawn.log_density.reshape(structure.shape),
        noise_scale=draw_noise_scales(key, targets, structure, z, is_drawn=is_drawn),
        impulse_scale=None,
        log_evidence=drawn.evidence.total,
        evidence=drawn.evidence,
        diagnostics=drawn.diagnostics,
        chain_index=np.arange(drawn.structure.shape[1]),
    )


def sample_by_jumps(
    key: Key,
    targets: StructureTarget,
    modes: Modes,
    settings: SampleSettings,
    evaluate: Callable[..., Array] = evaluate_each,
) -> StructureDraws:
    """Draw by reversible jumps of a population of walkers; see `population`.

    Args:
        key: random key.
        targets: stacked along a leading object axis.
        modes: fitted modes of every structure.
        settings: how much to draw.
        evaluate: as `weighing.evaluate_each`.

    Returns:
        Draws of all chains; evidence by importance sampling, whose odds the visits of
        the chains must agree with.
    """
    population = sample_population(
        key,
        targets,
        start_mixtures(targets, modes),
        settings.population,
        evaluate=evaluate,
        is_mixed=lambda draws: chains_agree(targets, draws),
    )
    draws = population.draws
    evidence = evidence_by_importance(
        population.evidence, np.asarray(targets.log_prior, float)
    )
    structure = np.asarray(draws.structure)
    shares = visited_shares(
        structure,
        targets.structures.shape[1],
        settings.num_chains * settings.population.num_walkers,
    )
    return StructureDraws(
        structure=structure,
        z=np.asarray(draws.z),
        log_density=np.asarray(draws.log_density),
        evidence=evidence,
        diagnostics=[
            _diagnose(targets, population, evidence, shares, index)
            for index in range(len(structure))
        ],
    )


SAMPLERS: dict[str, Callable[..., StructureDraws]] = {
    "rj": sample_by_jumps,
    "enumerate": enumerate_structures,
    "smc": sample_tempered,
    "laplace": sample_laplace,
    "map": best_hypothesis,
}
"""Samplers over structures by method."""

_STAGES = {
    "rj": "jumping between structures",
    "enumerate": "weighing structures",
    "smc": "tempering",
    "laplace": "drawing from the modes",
    "map": "choosing the best mode",
}


def _rehearse(
    key: Key,
    targets: StructureTarget,
    settings: SampleSettings,
    draw: Callable[..., StructureDraws],
    with_filters: bool,
) -> None:
    """Go through all stages but the likelihood of many points, to compile them.

    Programs of a mesh are left out: they run in the same order in all its processes.
    """
    num_objects, num_structures = targets.structures.shape[:2]
    likelihood: Any = targets.log_likelihood
    reading = np.asarray(likelihood.reference, float)[:1, 0]
    dim = targets.slot.shape[1]
    first = np.zeros(1, int)
    noise = NoiseFit(reading, reading[..., 2:])
    if with_filters:
        for run in (filter_points, filter_densities):
            run(targets, first, first, np.zeros((1, dim)), noise)
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
    draw(
        key,
        targets,
        modes,
        # One sweep of warm-up and one that counts.
        settings._replace(num_warmup=1, num_samples=settings.population.num_walkers)
        if draw is sample_by_jumps
        else settings,
        lambda targets, structure, z, *_: -0.5 * (z**2).sum(axis=-1),
    )
    if with_filters:
        # One of the sizes that tracks have; each is a program, if a small one. The
        # likelihood, which they need, is compiled by now.
        middle = np.argsort(Host.of(targets).in_use.sum(axis=1))[[num_structures // 2]]
        known = targets, first, middle, np.zeros((1, dim)), np.eye(dim)[None]
        LinearTracks.along(*known, noise)(first, noise)


def _diagnose(
    targets: StructureTarget,
    population: Population,
    evidence: StructureEvidence,
    shares: VisitedShares,
    index: int,
) -> ChainDiagnostics:
    """Judge one object."""
    counts = population.counts
    verdict = diagnose_chains(
        *pick_object((targets, population.draws), index),
        MoveCounts(counts.proposed[index][None], counts.accepted[index][None]),
    )
    reasons = list(verdict.reasons)
    if float(population.evidence.effective_sample_size[index]) >= _MIN_SAMPLE_SIZE:
        names = ("the chains' visits", "importance sampling")
        reasons += odds_disagree(shares, evidence, index, names)
    return verdict._replace(ok=not reasons, reasons=reasons)
