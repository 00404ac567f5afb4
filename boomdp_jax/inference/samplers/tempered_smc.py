r"""Sequential Monte Carlo over structures: from the fitted mixture to the posterior.

Particles start as draws from the mixture q and go through the densities
$p_\beta \propto q^{1-\beta} p^\beta$. Each step of $\beta$ keeps the effective sample
size of the weights at a given share, resamples, and makes moves between and within
structures that leave $p_\beta$ as it is (`moves`: tempering acts on the ratio alone).
Del Moral, Doucet and Jasra (2006), Sequential Monte Carlo samplers; Zhou, Johansen and
Aston (2016), Toward automatic model comparison.

Particles live on islands that never exchange any. Each island's product of mean weights
is an unbiased estimate of every structure's prior times evidence, so that their spread
is an error one can trust. Where the mixture fits, one or two steps are enough; where it
does not, more of them repair what importance weights cannot.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.fits.fit import Modes
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.adapt_mixture import adapt_mixtures
from boomdp_jax.inference.samplers.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.samplers.importance_evidence import (
    draws_of_noise,
    spread_evenly,
)
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import Point
from boomdp_jax.inference.samplers.resampling import systematic
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from boomdp_jax.inference.samplers.structure_draws import (
    SampleSettings,
    StructureDraws,
    pick_object,
    start_mixtures,
)
from boomdp_jax.inference.samplers.structure_evidence import (
    evidence_by_importance,
    evidence_by_replicates,
    evidence_disagrees,
    odds_disagree,
)
from boomdp_jax.inference.samplers.walker_moves import (
    MoveCounts,
    count_moves,
    decide_all,
    no_moves,
    propose_all,
)
from boomdp_jax.inference.samplers.weighing import batch_noise, evaluate_each

_NUM_ISLANDS = 16
# Share of the particles that the weights of one step must count for.
_KEPT_SHARE = 0.6
_CYCLE = ("jump", "walk", "change", "walk")
_LAST_CYCLES = 3
# Share of the first particles that is spread evenly over structures.
_EVEN_SHARE = 0.5
# Importance sampling, on the side, is heard only with as many effective draws.
_MIN_SAMPLE_SIZE = 100.0
_MAX_STEPS = 200


class Particles(NamedTuple):
    """Particles of all objects, island after island."""

    points: Point
    """With the tempered log-density."""
    log_target: Float[Array, "object particle"]
    """Log-density of the target itself."""


class Tempered(NamedTuple):
    """Where tempering ended."""

    particles: Particles
    log_whole: np.ndarray
    """Log-estimate of the sum over structures of prior times evidence by each island,
    `[object, island]`."""
    counts: MoveCounts
    power: np.ndarray
    """Of the target that was reached, `[object]`; 1 unless it takes too many steps."""


def sample_tempered(
    key: Key,
    targets: StructureTarget,
    modes: Modes,
    settings: SampleSettings,
    evaluate: Callable[..., Array] = evaluate_each,
) -> StructureDraws:
    """Draw from the posteriors of a batch of objects.

    Args:
        key: random key.
        targets: stacked along a leading object axis.
        modes: fitted modes of every structure.
        settings: how much to draw; as many particles as draws of all chains.
        evaluate: as `weighing.evaluate_each`.

    Returns:
        Particles, with an island for a chain, and evidence from the islands.
        Diagnostics are not ok where islands disagree (R-hat), or where importance
        sampling from the mixture, done on the side, disagrees.
    """
    rng = host_generator(key)
    mixtures = start_mixtures(targets, modes)
    size = settings.num_importance
    mixtures, found = adapt_mixtures(rng, targets, mixtures, size, evaluate)
    num_particles = -(-settings.num_chains * settings.num_samples // _NUM_ISLANDS)
    particles, log_whole, counts, power = temper(
        rng, targets, mixtures, num_particles * _NUM_ISLANDS, evaluate
    )
    num_objects, num_structures = targets.structures.shape[:2]
    structure = np.asarray(particles.points.structure)
    structure = structure.reshape(num_objects, _NUM_ISLANDS, num_particles)
    with np.errstate(divide="ignore"):
        share = np.log((structure[..., None] == np.arange(num_structures)).mean(axis=2))
    log_prior = np.asarray(targets.log_prior, float)
    evidence = evidence_by_replicates(log_whole[..., None] + share, log_prior)
    aside = evidence_by_importance(found, log_prior)
    draws = _shuffled(rng, particles)
    verdicts = []
    for i in range(num_objects):
        move_counts = MoveCounts(counts.proposed[i][None], counts.accepted[i][None])
        verdict = diagnose_chains(
            pick_object(targets, i), pick_object(draws, i), move_counts
        )
        reasons = list(verdict.reasons)
        if power[i] < 1.0:
            reasons.append(f"tempering ended at a power of {power[i]:.3g}, not at 1")
        if float(found.effective_sample_size[i]) >= _MIN_SAMPLE_SIZE:
            names = ("tempering", "importance sampling")
            reasons += odds_disagree(evidence, aside, i, names)
            reasons += evidence_disagrees(evidence, aside, i, names)
        verdicts.append(verdict._replace(ok=not reasons, reasons=reasons))
    return StructureDraws(
        structure=np.asarray(draws.structure),
        z=np.asarray(draws.z),
        log_density=np.asarray(draws.log_density),
        evidence=evidence,
        diagnostics=verdicts,
    )


def temper(
    rng: np.random.Generator,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num_particles: int,
    evaluate: Callable[..., Array] = evaluate_each,
) -> Tempered:
    """Take draws of mixtures to the posteriors.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        mixtures: one of each object; half of the particles start evenly spread over
            structures.
        num_particles: of each object, a multiple of the 16 islands.
        evaluate: as in `sample_tempered`.
    """
    mixtures = _spread(targets, mixtures)
    particles = _start(rng, targets, mixtures, num_particles, evaluate)
    num_objects, num_each = targets.structures.shape[0], num_particles // _NUM_ISLANDS
    power = np.zeros(num_objects)
    log_whole = np.zeros((num_objects, _NUM_ISLANDS))
    counts = no_moves(num_objects)
    for _ in range(_MAX_STEPS):
        log_ratio = _log_ratio(particles)
        step = np.array(
            [
                next_step(r, 1.0 - b, _KEPT_SHARE)
                for r, b in zip(log_ratio, power, strict=True)
            ]
        )
        log_weight = times(step[:, None], log_ratio)
        by_island = log_weight.reshape(num_objects, _NUM_ISLANDS, num_each)
        log_whole += np.logaddexp.reduce(by_island, axis=-1) - np.log(num_each)
        power = np.where(step >= 1.0 - power, 1.0, power + step)
        rows = _resample(rng, by_island)
        particles = _take(particles, rows, power)
        is_last = bool(np.all(power >= 1.0))
        for move in _CYCLE * (_LAST_CYCLES if is_last else 1):
            particles, info = _move(
                move, rng, particles, targets, mixtures, power, evaluate
            )
            count_moves(counts, move, info)
        if is_last:
            break
    return Tempered(particles, log_whole, counts, power)


@QuickCompile
def _spread(targets: StructureTarget, mixtures: LaplaceMixture) -> LaplaceMixture:
    return jax.vmap(lambda t, m: spread_evenly(t, m, _EVEN_SHARE))(targets, mixtures)


@QuickCompile
def _draw(offset, noise, targets: StructureTarget, mixtures: LaplaceMixture):
    def one(offset, noise, target, mixture):
        return draws_of_noise(offset, noise, target, mixture, even_share=0.0)

    return jax.vmap(one)(offset, noise, targets, mixtures)


def _start(
    rng: np.random.Generator,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num: int,
    evaluate: Callable[..., Array],
) -> Particles:
    """Draws from the mixture, dealt out to islands so that each has its share."""
    noise = batch_noise(rng, targets, mixtures, num)
    offset = on_device(rng.random(targets.structures.shape[0]), noise.normal.dtype)
    draws = _draw(offset, noise, targets, mixtures)
    # Components are drawn in order; islands take every sixteenth draw.
    order = np.arange(num).reshape(-1, _NUM_ISLANDS).T.reshape(-1)
    draws = jax.tree.map(lambda leaf: leaf[:, order], draws)
    value = evaluate(targets, draws.structure, draws.z).astype(draws.z.dtype)
    is_possible = draws.is_inside & (value < jnp.inf)
    value = jnp.where(is_possible, value, -jnp.inf)
    points = Point(draws.structure, draws.z, draws.log_proposal, draws.log_proposal)
    return Particles(points, value)


def _log_ratio(particles: Particles) -> np.ndarray:
    """Log of target over mixture."""
    ratio = np.asarray(particles.log_target, float) - np.asarray(
        particles.points.log_proposal, float
    )
    return np.where(np.isnan(ratio), -np.inf, ratio)


def times(power: np.ndarray | float, log_ratio: np.ndarray) -> np.ndarray:
    """A power of a ratio; zero to any power stays zero."""
    return np.where(np.isfinite(log_ratio), power * log_ratio, -np.inf)


def next_step(log_ratio: np.ndarray, left: float, kept_share: float) -> float:
    """Largest step of the power that keeps the effective sample size, by bisection.

    Args:
        log_ratio: of the densities at powers one and zero, of each particle, or
            `[particle, choice]`: weights of the choices of a particle are added up.
        left: largest step that may be taken.
        kept_share: of the particles, that the weights must count for.
    """

    def size(step: float) -> float:
        log_weight = times(step, log_ratio)
        top = log_weight.max()
        if not np.isfinite(top):
            return float(len(log_ratio))
        weight = np.exp(log_weight - top)
        weight = weight.reshape(len(log_ratio), -1).sum(axis=1)
        return float(weight.sum() ** 2 / (weight**2).sum())

    # What fell outside the mixture's cells is lost at any step.
    is_there = np.isfinite(log_ratio).reshape(len(log_ratio), -1).any(axis=1)
    least = kept_share * is_there.sum()
    if left <= 0.0 or size(left) >= least:
        return left
    low, high = 0.0, left
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) >= least else (low, middle)
    return max(low, 1e-6 * left)


def _resample(rng: np.random.Generator, log_weight: np.ndarray) -> np.ndarray:
    """Places of the chosen particles, `[object, particle]`, island by island."""
    num_objects, num_islands, num = log_weight.shape
    top = log_weight.max(axis=-1, keepdims=True)
    weight = np.exp(log_weight - np.where(np.isfinite(top), top, 0.0))
    rows = [
        [num * i + systematic(rng, weight[o, i], num) for i in range(num_islands)]
        for o in range(num_objects)
    ]
    return np.asarray(rows).reshape(num_objects, -1)


@QuickCompile
def _take(particles: Particles, rows, power) -> Particles:
    """The chosen particles, at the next power."""
    chosen = jax.tree.map(
        lambda leaf: jax.vmap(lambda one, row: one[row])(leaf, rows), particles
    )
    log_density = _tempered(chosen.log_target, chosen.points.log_proposal, power)
    points = eqx.tree_at(lambda p: p.log_density, chosen.points, log_density)
    return Particles(points, chosen.log_target)


@QuickCompile
def _temper(log_target, log_proposal, power):
    return _tempered(log_target, log_proposal, power)


def _tempered(log_target: Array, log_proposal: Array, power: Array) -> Array:
    power = jnp.asarray(power, log_target.dtype)[:, None]
    mixed = power * log_target + (1.0 - power) * log_proposal
    return jnp.where(log_target > -jnp.inf, mixed, -jnp.inf)


def _move(
    move: str,
    rng: np.random.Generator,
    particles: Particles,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    power: np.ndarray,
    evaluate: Callable[..., Array],
):
    """One move of every particle under the tempered density."""
    points = particles.points
    batch = propose_all(move, rng, points, targets, mixtures)
    where = batch.proposal.structure, batch.proposal.z
    log_target = evaluate(targets, *where).astype(points.z.dtype)
    log_density = _temper(log_target, batch.log_proposal, power)
    points, info = decide_all(rng, points, batch, log_density)
    log_target = jnp.where(info.accepted, log_target, particles.log_target)
    return Particles(points, log_target), info


def _shuffled(rng: np.random.Generator, particles: Particles) -> ChainDraws:
    """Draws of each island in random order: resampling leaves twins side by side."""
    points = particles.points
    num = points.structure.shape[1] // _NUM_ISLANDS
    order = np.stack([i * num + rng.permutation(num) for i in range(_NUM_ISLANDS)])

    def arrange(leaf: Array) -> Array:
        return on_device(np.asarray(leaf)[:, order], leaf.dtype)

    return ChainDraws(
        arrange(points.structure), arrange(points.z), arrange(particles.log_target)
    )
