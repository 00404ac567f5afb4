r"""A few levels of noise for each structure, and gains for each: noise averaged over.

A filter's gains take the ratios of noises as known. So each structure k has some draws
$\eta_m$ of all noises, and a hypothesis is a structure, coordinates and one of these
levels. With $L_m$ the likelihood under the gains of level m, $\hat z_k$ the best fit,
$Z_k = \int p(\eta) L(h \mid k, \hat z_k, \eta)\,d\eta$ and weights $v_m$,

$$L(h \mid k, z, m) = Z_k \, v_m L_m(z) / L_m(\hat z_k),$$

whose mean over levels stands for the likelihood with the noise integrated out. At the
best fit alone noise would be taken for too small: the larger it is, the more hypotheses
agree with the readings. So what each of many draws leaves open is worked out
(`volume`), they are divided by it into as many parts as there are levels, and a
level stands for its part: $v_m$ is such that it has the part's Laplace evidence. (Drawn
at random by that evidence, eight levels gave standard deviations of a pinned box's mass
that differed by 22 % from key to key from those of all draws, against 3 % so.)

Which level a hypothesis has is one coordinate more, uniform over one period, of which
each level takes an equal part: samplers need to know nothing of it.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.fits.fit import Fits, Host, normal_equations
from boomdp_jax.inference.fits.fit_noise import NoiseDensity
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points, log_prior_density
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.likelihoods.kalman import Filtered
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.typical_noise import TypicalNoise
from boomdp_jax.inference.noise.volume import OpenVolumes, log_volume, open_volumes
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture, make_mixture

# Draws of the noise of each structure, from which levels are chosen.
_NUM_DRAWS = 256
# Power of what noises leave open by which they count more than by their mass where
# they are divided into parts: the rare ones that leave most open make half of a
# variance.
_TILT = 0.4


class Levelled(NamedTuple):
    """A target with levels, on the rows of a table, and the filters of all levels."""

    targets: StructureTarget
    champion: np.ndarray
    """Hypothesis of each level, `[level, dim]`."""
    noise: NoiseFit
    """Of each level."""
    filtered: Filtered
    """Of each level, on the host."""


def with_levels(
    rng: np.random.Generator, typical: TypicalNoise, num_levels: int
) -> Levelled:
    """Choose levels of noise for every structure of an object.

    Structures that are out of the question have one level, repeated.

    Args:
        rng: source of randomness.
        typical: modes of one object under gains of the mean noise.
        num_levels: of each structure.
    """
    targets, modes, middle = typical.found
    num_structures, dim = targets.structures.shape[1], modes.z.shape[-1]
    first = np.arange(num_structures) * (len(modes.z[0]) // num_structures)
    champion = np.asarray(modes.z, float)[0, first]
    value = np.asarray(modes.log_density, float)[0, first]
    each = np.arange(num_structures)
    if num_levels == 1:
        filtered = filter_points(targets, 0 * each, each, champion, middle)
        targets = _rowed(targets, each, middle, filtered)
        return evenly_levelled(targets, champion, middle, filtered, 1)
    chosen = typical.chosen
    precision = np.asarray(modes.precision, float).reshape(-1, dim, dim)[first]
    found = [
        _choose(rng, typical, place, champion[k], precision[k], num_levels)
        for place, k in enumerate(chosen)
    ]
    others = np.setdiff1d(each, chosen)
    # Rows of all that was filtered, for every structure and level.
    source = np.zeros((num_structures, num_levels), int)
    source[chosen] = np.arange(len(chosen) * num_levels).reshape(-1, num_levels)
    source[others] = len(chosen) * num_levels + np.arange(len(others))[:, None]
    rows = source.reshape(-1)
    parts = [(levels.noise, levels.filtered) for levels in found]
    if others.size:
        left = middle.take(others)
        filtered = filter_points(targets, 0 * others, others, champion[others], left)
        parts.append((left, filtered))
    noise, filtered = jax.tree.map(lambda *leaves: np.concatenate(leaves)[rows], *parts)
    best = chosen[:1]
    prior = log_prior_density(targets, 0 * best, best, champion[best])
    least = found[0].log_evidence - value[best] + prior
    offset = np.full(source.shape, least)
    offset[chosen] = [levels.offset for levels in found]
    offset = np.where(np.isfinite(offset), offset, -1e30)
    whole = np.repeat(each, num_levels)
    levelled = _rowed(targets, whole, noise, filtered)
    targets = eqx.tree_at(
        lambda t: (t.structures, t.log_prior),
        levelled,
        (targets.structures, targets.log_prior),
    )
    targets = _with_offset(targets, offset.reshape(-1))
    targets, whole = _with_coordinate(targets, champion[whole], num_levels)
    return Levelled(targets, whole, noise, filtered)


def evenly_levelled(
    targets: StructureTarget,
    champion: np.ndarray,
    noise: NoiseFit,
    filtered: Filtered,
    num_levels: int,
) -> Levelled:
    """Levels that are all the same, for a belief without a row.

    Args:
        targets: one object.
        champion: hypothesis of each structure.
        noise: of each structure.
        filtered: of each structure.
        num_levels: of each structure.
    """
    num = len(champion)
    rows = np.repeat(np.arange(num), num_levels)
    likelihood: Any = targets.log_likelihood
    dtype = targets.log_prior.dtype
    targets = eqx.tree_at(
        lambda t: (t.log_likelihood.gains, t.log_likelihood.reference),
        targets,
        jax.tree.map(
            lambda leaf: on_device(np.asarray(leaf)[:, rows], dtype),
            (likelihood.gains, likelihood.reference),
        ),
    )
    targets = _with_offset(targets, np.zeros(len(rows)))
    whole = champion[rows]
    if num_levels > 1:
        targets, whole = _with_coordinate(targets, whole, num_levels)
    filtered = jax.tree.map(lambda leaf: leaf[rows], filtered)
    return Levelled(targets, whole, noise.take(rows), filtered)


def without_levels(target: StructureTarget) -> StructureTarget:
    """The same without the coordinate that says which level a hypothesis has.

    Args:
        target: of one object. Its likelihood keeps its levels, and is of no more use.
    """
    likelihood: Any = target.log_likelihood
    if likelihood.reference.shape[0] == target.num_structures:
        return target
    return eqx.tree_at(
        lambda t: (t.slot, t.period), target, (target.slot[:-1], target.period[:-1])
    )


def _with_offset(targets: StructureTarget, offset: np.ndarray) -> StructureTarget:
    return eqx.tree_at(
        lambda t: t.log_likelihood.offset,
        targets,
        on_device(offset[None], targets.log_prior.dtype),
        is_leaf=lambda leaf: leaf is None,
    )


def _with_coordinate(
    targets: StructureTarget, champion: np.ndarray, num_levels: int
) -> tuple[StructureTarget, np.ndarray]:
    """With the coordinate that says which level a hypothesis has."""
    slot, period = np.asarray(targets.slot), np.asarray(targets.period)
    end = ((0, 0), (0, 1))
    targets = eqx.tree_at(
        lambda t: (t.slot, t.period),
        targets,
        (
            on_device(np.pad(slot, end, constant_values=-1), slot.dtype),
            on_device(np.pad(period, end, constant_values=1.0), period.dtype),
        ),
    )
    level = (np.arange(len(champion)) % num_levels + 0.5) / num_levels - 0.5
    return targets, np.concatenate([champion, level[:, None]], axis=1)


@QuickCompile
def mixtures_over_levels(
    targets: StructureTarget, mixtures: LaplaceMixture
) -> LaplaceMixture:
    """Mixtures made for a target without levels; levels are drawn evenly.

    Args:
        targets: with levels, stacked along a leading object axis.
        mixtures: one of each object.
    """
    if mixtures.mean.shape[-1] == targets.slot.shape[-1]:
        return mixtures

    def one(target: StructureTarget, mixture: LaplaceMixture) -> LaplaceMixture:
        corner = jnp.zeros_like(mixture.scale_tril, shape=(target.dim, target.dim))
        corner = corner.at[-1, -1].set(1.0)
        end = ((0, 0), (0, 1))
        return make_mixture(
            target,
            mixture.structure,
            jnp.pad(mixture.mean, end),
            jnp.pad(mixture.scale_tril, (*end, (0, 1))) + corner[None],
            mixture.log_weight,
            from_prior=jnp.pad(mixture.from_prior, end, constant_values=True),
            degrees_of_freedom=mixture.degrees_of_freedom,
            most_each=mixture.most_each,
        )

    return jax.vmap(one)(targets, mixtures)


class _Chosen(NamedTuple):
    """Levels of one structure."""

    noise: NoiseFit
    filtered: Filtered
    offset: np.ndarray
    log_evidence: float
    """Of the noise at the structure's best fit."""


def _choose(
    rng: np.random.Generator,
    typical: TypicalNoise,
    place: int,
    champion: np.ndarray,
    precision: np.ndarray,
    num_levels: int,
) -> _Chosen:
    """Choose levels of a structure from draws of its noise, each for a part of them."""
    targets = typical.found.targets
    k = int(typical.chosen[place])
    vector, log_weight, log_evidence = _draws(rng, typical, place, champion)

    def filters(noise: NoiseFit) -> Filtered:
        each = np.full(len(noise.reading), k)
        z = np.tile(champion, (len(each), 1))
        return filter_points(targets, 0 * each, each, z, noise)

    middle = typical.found.noise.take(np.array([k]))
    track = middle, filters(middle)
    noise = NoiseFit.of_vector(vector)
    volumes = open_volumes(targets, k, champion, precision, track, noise)
    log_mass = log_weight + volumes.log_volume
    rows, log_share = _parts(log_mass, volumes, num_levels)
    noise = noise.take(rows)
    filtered = filters(noise)
    rowed = _rowed(targets, np.full(num_levels, k), noise, filtered)
    # So that each comes to have what its part has.
    offset = log_evidence + log_share + math.log(num_levels)
    offset = offset - _volume(rowed, champion, precision)
    offset = offset - _log_likelihood(rowed, champion)
    return _Chosen(noise, filtered, offset, log_evidence)


def _parts(
    log_mass: np.ndarray, volumes: OpenVolumes, num_levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Divide noises by how much they leave open, and choose one of each part.

    A noise may lie in several parts.

    Args:
        log_mass: of each noise, all the posterior that it has.
        volumes: of each noise.
        num_levels: how many parts.

    Returns:
        For each part, the noise whose variances are most like its mean ones, and the
        logarithm of its mass.
    """
    order = np.argsort(volumes.log_volume)
    mass = np.exp(log_mass[order] - log_mass.max())
    open_ = volumes.log_volume[order]
    variance = volumes.variance[order]
    tilted = mass * np.exp(_TILT * (open_ - open_[-1]))
    end = np.cumsum(tilted) / tilted.sum()
    begin = np.concatenate([[0.0], end[:-1]])
    bounds = np.arange(num_levels + 1)[:, None] / num_levels
    within = np.minimum(end, bounds[1:]) - np.maximum(begin, bounds[:-1])
    share = np.maximum(within, 0.0) / np.maximum(end - begin, 1e-300)
    share = share * mass
    total = share.sum(axis=1)
    mean = (share / total[:, None]) @ variance
    gap = np.log(variance)[None] - np.log(mean)[:, None]
    gap = np.where(share > 0.0, np.sum(gap**2, axis=-1), np.inf)
    log_total = np.log(total) + log_mass.max()
    return order[np.argmin(gap, axis=1)], log_total


def _draws(
    rng: np.random.Generator, typical: TypicalNoise, place: int, champion: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Noises of a structure at its best fit, their log-weights and their evidence."""
    group = np.full(_NUM_DRAWS, place)
    vector = typical.proposal.sample(rng, group)
    k, none = typical.chosen[[place]], np.zeros(1, int)
    fits = Fits(none, k, champion[None], np.zeros(1), np.zeros((1, 0, 0)))
    log_weight = NoiseDensity(typical.found.targets, fits)(none, vector[None])[0]
    log_weight = log_weight - typical.proposal.log_density(vector, group)
    log_weight = np.where(np.isfinite(log_weight), log_weight, -1e30)
    total = float(np.logaddexp.reduce(log_weight))
    return vector, log_weight - total, total - math.log(_NUM_DRAWS)


def _rowed(
    targets: StructureTarget, structure: np.ndarray, noise: NoiseFit, filtered: Filtered
) -> StructureTarget:
    """A target in which each of a list of filters counts as a structure of its own."""
    dtype = targets.log_prior.dtype
    return eqx.tree_at(
        lambda t: (
            t.structures,
            t.log_prior,
            t.log_likelihood.gains,
            t.log_likelihood.reference,
        ),
        targets,
        (
            on_device(np.asarray(targets.structures)[:, structure], bool),
            on_device(np.asarray(targets.log_prior)[:, structure], dtype),
            jax.tree.map(lambda leaf: on_device(leaf[None], dtype), filtered.gains),
            on_device(noise.reading[None], dtype),
        ),
    )


def _volume(
    rowed: StructureTarget, champion: np.ndarray, precision: np.ndarray
) -> np.ndarray:
    """By how much a structure's evidence exceeds its density at a champion, by rows.

    Args:
        rowed: filters of one structure.
        champion: of the structure.
        precision: about it, of some gains.
    """
    rows = np.arange(rowed.structures.shape[1])
    none, z = 0 * rows, np.tile(champion, (len(rows), 1))
    fits = Fits(none, rows, z, 0.0 * none, np.tile(precision, (len(rows), 1, 1)))
    return np.nan_to_num(log_volume(*normal_equations(rowed, Host.of(rowed), fits)))


def _log_likelihood(rowed: StructureTarget, champion: np.ndarray) -> np.ndarray:
    """Of a champion by all filters of one structure."""
    rows = np.arange(rowed.structures.shape[1])
    none, z = 0 * rows, np.tile(champion, (len(rows), 1))
    found = evaluate_points(rowed, none, rows, z).log_density
    return found - log_prior_density(rowed, none, rows, z)
