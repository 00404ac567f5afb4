"""From targets to draws: fit, propose from the fitted mixture, jump, check."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import Key
from boomdp_jax.inference.chain_diagnostics import ChainDiagnostics, diagnose_chains
from boomdp_jax.inference.fit import FitSettings, evaluate_points, fit_modes
from boomdp_jax.inference.importance_evidence import importance_evidence
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.mixture_building import (
    add_prior_components,
    add_slot_components,
    laplace_mixture,
    refine_weights,
)
from boomdp_jax.inference.one_step import NoiseStatistics, draw_noise
from boomdp_jax.inference.structure_chain import ChainDraws, RunInfo, run_chains
from boomdp_jax.inference.target import StructureTarget


class SampleSettings(NamedTuple):
    """How much to draw."""

    num_chains: int = 4
    num_warmup: int = 200
    num_samples: int = 500
    num_importance: int = 2048
    fit: FitSettings = FitSettings()


class BlockDraws(NamedTuple):
    """What sampling a batch of equal blocks gives, leading axis `object`."""

    structure: Int[Array, "object draw"]
    z: Float[Array, "object draw dim"]
    log_density: Float[Array, "object draw"]
    noise_scale: Float[Array, "object draw body 4"]
    log_evidence: Float[Array, " object"]
    importance_probability: Float[Array, "object structure"]
    """Structure probabilities by importance sampling, a cross-check."""
    importance_size: Float[Array, " object"]
    diagnostics: list[ChainDiagnostics]
    chain_index: np.ndarray
    """Index of each chain; draws lie chain after chain."""


@eqx.filter_jit
def _mixtures(key: Key, targets: StructureTarget, modes, num_draws: int):
    """Proposal mixtures with importance-refined weights, and the evidence."""

    def one(key, target, modes):
        mixture = laplace_mixture(
            target, modes.structure, modes.z, modes.precision, modes.log_density
        )
        mixture = add_slot_components(target, mixture, total_weight=0.4)
        mixture = add_prior_components(target, mixture, total_weight=0.02)
        evidence = importance_evidence(key, target, mixture, num_draws)
        refined = refine_weights(
            target, mixture, evidence.structure, evidence.z, evidence.log_weight
        )
        return refined, evidence

    keys = jax.random.split(key, targets.structures.shape[0])
    return jax.vmap(one)(keys, targets, modes)


@eqx.filter_jit
def _chains(
    key: Key, targets: StructureTarget, mixtures: LaplaceMixture, settings: tuple
) -> tuple[ChainDraws, RunInfo]:
    num_chains, num_warmup, num_samples = settings
    keys = jax.random.split(key, targets.structures.shape[0])
    return jax.vmap(
        lambda key, target, mixture: run_chains(
            key,
            target,
            mixture,
            num_chains=num_chains,
            num_warmup=num_warmup,
            num_samples=num_samples,
        )
    )(keys, targets, mixtures)


def sample_blocks(
    key: Key,
    targets: StructureTarget,
    settings: SampleSettings,
    report: Callable[[str], None] = lambda stage: None,
) -> BlockDraws:
    """Posterior draws over structures and coordinates of a batch of equal blocks.

    Args:
        key: random key.
        targets: with a `OneStepLikelihood`, stacked along a leading object axis.
        settings: how much to draw.
        report: called with the name of each stage as it begins.

    Returns:
        Draws of all chains one after the other, noise drawn given each.
    """
    fit_key, importance_key, chain_key, noise_key = jax.random.split(key, 4)
    report("fitting every structure")
    modes = fit_modes(fit_key, targets, settings.fit)
    report("weighing structures")
    mixtures, evidence = _mixtures(
        importance_key, targets, modes, settings.num_importance
    )
    report("jumping between structures")
    draws, info = _chains(chain_key, targets, mixtures, settings[:3])
    num_objects = targets.structures.shape[0]
    structure = draws.structure.reshape(num_objects, -1)
    z = draws.z.reshape(*structure.shape, -1)
    noise_scale = _noise(noise_key, targets, structure, z, settings.fit)
    diagnostics = [
        diagnose_chains(
            jax.tree.map(lambda leaf, i=i: leaf[i], targets),
            jax.tree.map(lambda leaf, i=i: leaf[i], draws),
            jax.tree.map(lambda leaf, i=i: leaf[i], info),
        )
        for i in range(num_objects)
    ]
    log_prior = targets.log_prior
    return BlockDraws(
        structure=structure,
        z=z,
        log_density=draws.log_density.reshape(structure.shape),
        noise_scale=noise_scale,
        log_evidence=jax.nn.logsumexp(evidence.log_evidence + log_prior, axis=-1),
        importance_probability=evidence.probability,
        importance_size=evidence.effective_sample_size,
        diagnostics=diagnostics,
        chain_index=np.arange(settings.num_chains),
    )


def _noise(key, targets: StructureTarget, structure, z, settings: FitSettings):
    """Noise scales given every draw; in chunks that reuse the fit's program."""
    num_objects, num_draws = structure.shape
    chunk = targets.structures.shape[1] * settings.num_draws
    squares, counts = [], None
    for start in range(0, num_draws, chunk):
        rows = np.minimum(np.arange(start, start + chunk), num_draws - 1)
        _, statistics = evaluate_points(targets, structure[:, rows], z[:, rows])
        squares.append(statistics.square)
        counts = statistics.num[:, :1]
    square = jnp.concatenate(squares, axis=1)[:, :num_draws]
    likelihood: Any = targets.log_likelihood
    scale = likelihood.coordinates.scales.noise

    def draw(key, square, num, scale):
        keys = jax.random.split(key, square.shape[0])
        return jax.vmap(lambda k, s: draw_noise(k, NoiseStatistics(num[0], s), scale))(
            keys, square
        )

    return jax.vmap(draw)(jax.random.split(key, num_objects), square, counts, scale)
