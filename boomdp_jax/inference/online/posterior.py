"""An online belief as a `Posterior`: particles decoded, with noise drawn for each."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.assemble import assemble_posterior, merge_params
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import ResidualCheck
from boomdp_jax.inference.hypotheses.decode import decode
from boomdp_jax.inference.likelihoods.one_step import NOISE_SHAPE
from boomdp_jax.inference.noise.levels import without_levels
from boomdp_jax.inference.online.likelihood import levels_of, log_likelihoods
from boomdp_jax.inference.online.moves import distinct_sample_size
from boomdp_jax.inference.online.state import BlockBelief
from boomdp_jax.inference.posteriors.contact_numbers import (
    untouched_notes,
    with_contact_numbers,
)
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.inference.samplers.chain_diagnostics import ChainDiagnostics
from boomdp_jax.inference.samplers.resampling import systematic
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec

# Fewer particles in effect than this share are reason for doubt.
_LEAST_SHARE = 0.05


def online_posterior(
    key: Key,
    spec: SceneSpec,
    parts: list[tuple[Block, BlockBelief]],
    check: Callable[[Block, BlockBelief, BlockDraws], ResidualCheck] | None = None,
) -> Posterior:
    """Put the particles of independent blocks side by side.

    Args:
        key: random key.
        spec: the scene.
        parts: its blocks, and what is believed of each.
        check: what looks for laws that the model lacks; None: nothing does.

    Returns:
        Draws; their weights are those of the particles where there is one block.
    """
    pair_key, assemble_key = jax.random.split(key)
    rng = host_generator(pair_key)
    results, log_weight = [], None
    for block, belief in parts:
        particles = belief.particles
        weight = np.exp(np.asarray(particles.log_weight, float))
        rows = np.arange(len(weight))
        if len(parts) == 1:
            log_weight = np.log(weight / weight.sum())
        else:
            rows = rng.permutation(systematic(rng, weight, len(weight)))
        result = _result(rng, spec, block, belief, rows)
        if check is not None:
            residual = check(block, belief, result.draws)
            result = result._replace(residual=residual)
        results.append(result)
    posterior = assemble_posterior(
        assemble_key,
        spec,
        results,
        seconds={},
        notes=untouched_notes(spec),
        method="online",
    )
    if log_weight is None:
        return posterior
    weights = on_device(log_weight, posterior.log_weight.dtype)
    return dataclasses.replace(posterior, log_weight=weights)


def online_params(
    key: Key, spec: SceneSpec, parts: list[tuple[Block, BlockBelief]], num_draws: int
) -> Params:
    """Hypotheses drawn systematically from the particles, and nothing else.

    Args:
        key: random key.
        spec: the scene.
        parts: its blocks, and what is believed of each.
        num_draws: how many hypotheses.

    Returns:
        Φ, leading axis `num_draws`; in random order.
    """
    rng = host_generator(key)
    blocks, decoded = [], []
    for block, belief in parts:
        target, particles = belief.target, belief.particles
        likelihood: Any = target.log_likelihood
        weight = np.exp(np.asarray(particles.log_weight, float))
        rows = rng.permutation(systematic(rng, weight, num_draws))
        active = np.asarray(target.structures)[np.asarray(particles.structure)[rows]]
        z = np.asarray(particles.z)[rows]
        blocks.append(block._replace(target=target))
        decoded.append(decode(likelihood.coordinates, z, active, num_draws))
    params, _ = merge_params(spec, blocks, decoded)
    return with_contact_numbers(rng, spec, blocks, decoded, params)


def best_params(spec: SceneSpec, parts: list[tuple[Block, BlockBelief]]) -> Params:
    """The most probable hypothesis: of the likeliest structure, the highest density.

    Densities of structures with other numbers of coordinates do not compare, so that
    the structure is chosen by what its particles weigh together.

    Args:
        spec: the scene.
        parts: its blocks, and what is believed of each.

    Returns:
        Φ, without a leading axis.
    """
    blocks, decoded = [], []
    for block, belief in parts:
        target, particles = belief.target, belief.particles
        likelihood: Any = target.log_likelihood
        level = levels_of(target, particles.structure, particles.z)
        value = log_likelihoods(target, belief.tally, level, particles.square)
        prior = jax.vmap(target.log_prior_density)(particles.structure, particles.z)
        density = np.asarray(value + prior, float)
        weight = np.exp(np.asarray(particles.log_weight, float))
        structure = np.asarray(particles.structure)
        likeliest = int(np.argmax(np.bincount(structure, weight)))
        is_candidate = (structure == likeliest) & (weight > 0)
        row = int(np.argmax(np.where(is_candidate, density, -np.inf)))
        active = np.asarray(target.structures)[[likeliest]]
        z = np.asarray(particles.z)[[row]]
        blocks.append(block._replace(target=target))
        decoded.append(decode(likelihood.coordinates, z, active, 1))
    params, _ = merge_params(spec, blocks, decoded)
    rng = np.random.default_rng(0)  # One draw is in one order.
    whole = with_contact_numbers(rng, spec, blocks, decoded, params)
    return jax.tree.map(lambda leaf: leaf[0], whole)


def structure_share(parts: list[tuple[Block, BlockBelief]]) -> float:
    """What the particles of the likeliest structure weigh, the least over blocks."""
    shares = []
    for _, belief in parts:
        weight = np.exp(np.asarray(belief.particles.log_weight, float))
        by_structure = np.bincount(np.asarray(belief.particles.structure), weight)
        shares.append(by_structure.max() / weight.sum())
    return float(min(shares))


def _result(
    rng: np.random.Generator,
    spec: SceneSpec,
    block: Block,
    belief: BlockBelief,
    rows: np.ndarray,
) -> BlockResult:
    """Chosen particles of a block, as a sampler would hand them over."""
    target, particles, tally = belief.target, belief.particles, belief.tally
    likelihood: Any = target.log_likelihood
    structure, z = np.asarray(particles.structure), np.asarray(particles.z)
    level = levels_of(target, particles.structure, particles.z)
    value = log_likelihoods(target, tally, level, particles.square)
    prior = jax.vmap(target.log_prior_density)(particles.structure, particles.z)
    log_density = np.asarray(value + prior, float)
    own = np.asarray(level)
    reference = np.asarray(likelihood.reference, float)[own]
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[None] / reference
    num = np.asarray(tally.num, float)[own]
    rate = scale**2 + 0.5 * np.asarray(particles.square, float)
    noise = reference * np.sqrt(rate / rng.gamma(NOISE_SHAPE + 0.5 * num))
    # Between refits the noise of the motion is one of a few.
    impulse = np.asarray(belief.champions.noise.impulse)
    num_all, size = len(level), float(distinct_sample_size(particles))
    reasons = []
    if size < _LEAST_SHARE * num_all:
        reasons.append(f"{size:.0f} of {num_all} particles are left in effect")
    if int(belief.fit.num_rows) == 0 and np.any(num > 0):
        reasons.append("nothing has been fitted yet: particles are draws of the prior")
    verdict = ChainDiagnostics(
        ok=not reasons,
        reasons=reasons,
        r_hat={},
        effective_sample_size={"weights": size},
        acceptance={},
    )
    draws = BlockDraws(
        structure=structure[rows][None],
        z=z[rows, : block.layout.dim][None],
        log_density=log_density[rows][None],
        noise_scale=noise[rows].astype(z.dtype)[None],
        impulse_scale=impulse[own[rows]][None],
        log_evidence=np.array([np.nan]),
        evidence=None,
        diagnostics=[verdict],
        chain_index=np.arange(1),
    )
    return BlockResult(block._replace(target=without_levels(target)), draws, 0)
