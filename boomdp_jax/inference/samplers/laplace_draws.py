r"""The posterior as normal bumps on its modes, and its single best hypothesis.

A structure's evidence is the sum over its modes of
$p(k, \hat z)\,(2\pi)^{d/2} |H|^{-1/2}$; draws come from the normal distributions. It
costs one batch of likelihoods beyond the fit, which serve to say how wrong it is: the
draws are weighed by target over bumps, and where the weighed odds or evidence differ,
diagnostics say so. Measured on pins with a wheel, Laplace's evidence is off by 4 to 7
nats; prefer `enumerate` wherever odds matter.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.fits.fit import Modes
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.chain_diagnostics import ChainDiagnostics
from boomdp_jax.inference.samplers.structure_draws import SampleSettings, StructureDraws
from boomdp_jax.inference.samplers.structure_evidence import (
    StructureEvidence,
    evidence_disagrees,
    odds_disagree,
)
from boomdp_jax.inference.samplers.weighing import evaluate_each

_MIN_SAMPLE_SIZE = 100.0


class _Bumps(NamedTuple):
    """Normal distributions of one object, weighed."""

    structure: np.ndarray
    mean: np.ndarray
    scale_tril: np.ndarray
    log_volume: np.ndarray
    log_weight: np.ndarray
    """Log of the Laplace evidence, structure prior included."""
    is_used: np.ndarray
    """Coordinates in use, `[mode, dim]`."""


def sample_laplace(
    key: Key,
    targets: StructureTarget,
    modes: Modes,
    settings: SampleSettings,
    evaluate: Callable[..., Array] = evaluate_each,
) -> StructureDraws:
    """Draw from normal bumps on the modes of a batch of objects.

    Args:
        key: random key.
        targets: stacked along a leading object axis.
        modes: fitted modes of every structure.
        settings: how much to draw.
        evaluate: from targets, structures `[object, point]` and coordinates `[object,
            point, dim]` to log-densities `[object, point]`.

    Returns:
        Independent draws, the Laplace evidence, and a verdict by importance weights.
    """
    rng = host_generator(key)
    num_objects = targets.structures.shape[0]
    bumps = [_bumps(targets, modes, i) for i in range(num_objects)]
    num = settings.num_chains * settings.num_samples
    drawn = [_draw(rng, targets, b, num, i) for i, b in enumerate(bumps)]
    structure = np.stack([d[0] for d in drawn])
    z = np.stack([d[1] for d in drawn])
    dtype = np.dtype(targets.log_prior.dtype)
    number = np.dtype(np.int32)
    value = evaluate(targets, on_device(structure, number), on_device(z, dtype))
    log_density = np.asarray(value, float)
    log_density = np.where(log_density < np.inf, log_density, -np.inf)
    evidence = _evidence(targets, bumps)
    verdicts = []
    for i in range(num_objects):
        log_weight = log_density[i] - drawn[i][2]
        weighed, size = _weigh(targets, structure[i], log_weight, i)
        reasons = []
        if not size >= _MIN_SAMPLE_SIZE:
            reasons.append(
                f"normal approximation: weighed by the posterior its draws count for "
                f"{size:.0f}, below {_MIN_SAMPLE_SIZE:.0f}"
            )
        names = ("the normal approximation", "its draws weighed by the posterior")
        own = StructureEvidence(*(part[i][None] for part in evidence))
        reasons += odds_disagree(own, weighed, 0, names)
        reasons += evidence_disagrees(own, weighed, 0, names)
        verdicts.append(
            ChainDiagnostics(not reasons, reasons, {}, {"weights": size}, {})
        )
    shape = (num_objects, settings.num_chains, settings.num_samples)
    return StructureDraws(
        structure=structure.reshape(shape),
        z=z.reshape(*shape, -1).astype(dtype),
        log_density=log_density.reshape(shape),
        evidence=evidence,
        diagnostics=verdicts,
    )


def best_hypothesis(
    key: Key,
    targets: StructureTarget,
    modes: Modes,
    settings: SampleSettings,
    evaluate: Callable[..., Array] = evaluate_each,
) -> StructureDraws:
    """The highest mode of the structure with most Laplace evidence, as a single draw.

    Args:
        key: not used.
        targets: stacked along a leading object axis.
        modes: fitted modes of every structure.
        settings: not used.
        evaluate: not used.

    Returns:
        One draw per object, and the Laplace evidence.
    """
    del key, settings, evaluate
    num_objects = targets.structures.shape[0]
    bumps = [_bumps(targets, modes, i) for i in range(num_objects)]
    evidence = _evidence(targets, bumps)
    best = evidence.probability.argmax(axis=-1)
    value = np.asarray(modes.log_density, float)
    value = np.where(np.asarray(modes.structure) == best[:, None], value, -np.inf)
    rows = np.arange(num_objects), value.argmax(axis=-1)
    verdict = ChainDiagnostics(True, [], {}, {}, {})
    return StructureDraws(
        structure=best[:, None, None].astype(np.int32),
        z=np.asarray(modes.z)[rows][:, None, None],
        log_density=value[rows][:, None, None],
        evidence=evidence,
        diagnostics=[verdict] * num_objects,
    )


def _bumps(targets: StructureTarget, modes: Modes, index: int) -> _Bumps:
    """Factors and Laplace evidence of every mode of one object."""
    structure = np.asarray(modes.structure[index])
    slot = np.asarray(targets.slot[index])
    active = np.asarray(targets.structures[index])
    always = np.ones((len(active), 1), bool)
    is_used = np.concatenate([active, always], axis=1)[:, slot][structure]
    precision = np.asarray(modes.precision[index], float)
    # An angle that the data leave open is as wide as its uniform prior.
    period = np.asarray(targets.period[index], float)
    floor = np.where(period > 0, 12.0 / np.where(period > 0, period, 1.0) ** 2, 0.0)
    dim = len(period)
    tril = np.zeros((len(structure), dim, dim))
    log_volume = np.zeros(len(structure))
    log_weight = np.asarray(modes.log_density[index], float).copy()
    for row, used in enumerate(is_used):
        block = precision[row][np.ix_(used, used)] + np.diag(floor[used])
        try:
            factor = np.linalg.cholesky(np.linalg.inv(block))
        except np.linalg.LinAlgError:
            log_weight[row] = -np.inf
            continue
        tril[row][np.ix_(used, used)] = factor
        log_volume[row] = np.log(np.diag(factor)).sum()
    constant = 0.5 * np.log(2.0 * np.pi) * is_used.sum(axis=1)
    log_weight = np.where(
        np.isfinite(log_weight), log_weight + constant + log_volume, -np.inf
    )
    z = np.asarray(modes.z[index], float)
    return _Bumps(structure, z, tril, log_volume, log_weight, is_used)


def _evidence(targets: StructureTarget, bumps: list[_Bumps]) -> StructureEvidence:
    """Sums over modes; what Laplace's method does not know is its error."""
    num_structures = targets.structures.shape[1]
    log_prior = np.asarray(targets.log_prior, float)
    joint = np.stack(
        [
            np.logaddexp.reduce(
                np.where(
                    b.structure == np.arange(num_structures)[:, None],
                    b.log_weight,
                    -np.inf,
                ),
                axis=1,
            )
            for b in bumps
        ]
    )
    total = np.logaddexp.reduce(joint, axis=1)
    unknown = np.full(joint.shape, np.nan)
    with np.errstate(invalid="ignore"):
        log_evidence = joint - np.where(log_prior > -np.inf, log_prior, 0.0)
    return StructureEvidence(
        log_evidence=log_evidence,
        error=unknown,
        probability=np.exp(joint - total[:, None]),
        probability_error=unknown,
        total=total,
        total_error=np.full(total.shape, np.nan),
    )


def _draw(
    rng: np.random.Generator,
    targets: StructureTarget,
    bumps: _Bumps,
    num: int,
    index: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Structures, coordinates, and log-density of the bumps at them."""
    log_weight = bumps.log_weight - np.logaddexp.reduce(bumps.log_weight)
    row = rng.choice(len(log_weight), size=num, p=np.exp(log_weight))
    normal = rng.standard_normal((num, bumps.mean.shape[1]))
    z = bumps.mean[row] + np.einsum("nij,nj->ni", bumps.scale_tril[row], normal)
    period = np.asarray(targets.period[index], float)
    turn = np.where(period > 0, period, 1.0)
    z = np.where(period > 0, z - turn * np.floor(z / turn + 0.5), z)
    structure = bumps.structure[row]
    parts = np.full((num, len(log_weight)), -np.inf)
    for mode in np.flatnonzero(np.isfinite(log_weight)):
        mine = structure == bumps.structure[mode]
        used = bumps.is_used[mode]
        offset = z[mine] - bumps.mean[mode]
        offset -= np.where(period > 0, turn * np.round(offset / turn), 0.0)
        factor = bumps.scale_tril[mode][np.ix_(used, used)]
        white = np.linalg.solve(factor, offset[:, used].T)
        constant = 0.5 * used.sum() * np.log(2.0 * np.pi) + bumps.log_volume[mode]
        parts[mine, mode] = log_weight[mode] - 0.5 * np.sum(white**2, axis=0) - constant
    return structure.astype(np.int32), z, np.logaddexp.reduce(parts, axis=1)


def _weigh(
    targets: StructureTarget, structure: np.ndarray, log_weight: np.ndarray, index: int
) -> tuple[StructureEvidence, float]:
    """Evidence of one object from weighed draws, and their effective number."""
    num_structures = targets.structures.shape[1]
    total = np.logaddexp.reduce(log_weight)
    weight = np.exp(log_weight - total)
    is_of = structure == np.arange(num_structures)[:, None]
    probability = is_of @ weight
    deviation = weight * (is_of - probability[:, None])
    size = 1.0 / np.sum(weight**2)
    log_prior = np.asarray(targets.log_prior[index], float)
    whole = total - np.log(len(weight))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_evidence = np.log(probability) + whole - log_prior
    return (
        StructureEvidence(
            log_evidence=log_evidence[None],
            error=np.full((1, num_structures), np.nan),
            probability=probability[None],
            probability_error=np.sqrt(np.sum(deviation**2, axis=1))[None],
            total=np.array([whole]),
            total_error=np.array([np.sqrt(max(1.0 / size - 1.0 / len(weight), 0.0))]),
        ),
        float(size),
    )
