"""Evidence of structures by bridges from weighted draws to draws of the posterior."""

from typing import NamedTuple

import numpy as np
from numpyro.diagnostics import effective_sample_size

from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.bridge_sampling import Bridge, bridge_evidence
from boomdp_jax.inference.samplers.importance_evidence import ImportanceEvidence
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import Point
from boomdp_jax.inference.samplers.structure_draws import pick_object
from boomdp_jax.inference.samplers.structure_evidence import (
    StructureEvidence,
    evidence_by_importance,
)
from boomdp_jax.inference.samplers.walker_moves import log_proposal_of

# Structures of such a probability, with as many draws of both kinds, get a bridge.
_MATTERS, _LEAST_DRAWS = 0.005, 20
# A gap counts from so many errors, and nats. Errors of a probability, and of the whole
# evidence in nats, that are too large.
_NUM_ERRORS, _LEAST_NATS, _MOST_DOUBT, _MOST_NATS = 5.0, 0.2, 0.05, 0.5


class Bridged(NamedTuple):
    """Evidence of a batch of objects, and why to doubt it, object by object."""

    evidence: StructureEvidence
    reasons: list[list[str]]


def bridge_structures(
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    found: ImportanceEvidence,
    points: Point,
    num_chains: int,
) -> Bridged:
    """Evidence of every structure: by bridge where it matters, else by importance.

    Args:
        targets: stacked along a leading object axis.
        mixtures: that weighted draws come from, but for weights between structures.
        found: weighted draws of every object.
        points: draws of the posterior within each structure, chain after chain, those
            of a chain in an order in which like follows like.
        num_chains: of each object.

    Returns:
        Evidence with errors; reasons where an error is large, or where bridge and
        importance sampling disagree beyond their errors.
    """
    log_prior = np.asarray(targets.log_prior, float)
    direct = evidence_by_importance(found, log_prior)
    log_evidence, error = direct.log_evidence.copy(), direct.error.copy()
    log_proposal = log_proposal_of(targets, mixtures, found.structure, found.z)
    reasons: list[list[str]] = []
    for i in range(len(log_prior)):
        drawn = pick_object(found, i), np.asarray(log_proposal[i], float)
        one = pick_object((mixtures, points), i)
        reasons.append([])
        for k in np.flatnonzero(direct.probability[i] > _MATTERS):
            bridge = _bridge(*one, *drawn, int(k), num_chains)
            if bridge is None:
                continue
            value = bridge.log_evidence - log_prior[i, k]
            gap = abs(value - log_evidence[i, k])
            both = np.hypot(bridge.error, error[i, k])
            if gap > max(_NUM_ERRORS * both, _LEAST_NATS):
                reasons[i].append(
                    f"log-evidence of a structure of probability "
                    f"{direct.probability[i, k]:.2f}: importance sampling says "
                    f"{log_evidence[i, k]:.2f}, a bridge {value:.2f}, with a standard "
                    f"error of {both:.2f}"
                )
            log_evidence[i, k], error[i, k] = value, bridge.error
    evidence = _odds(log_evidence, error, log_prior)
    for i, mine in enumerate(reasons):
        worst = int(np.argmax(evidence.probability_error[i]))
        if not evidence.probability_error[i, worst] <= _MOST_DOUBT:
            mine.append(
                f"probability {evidence.probability[i, worst]:.2f} of a structure: "
                f"standard error is {evidence.probability_error[i, worst]:.2f}, above "
                f"{_MOST_DOUBT}"
            )
        if not evidence.total_error[i] <= _MOST_NATS:
            mine.append(
                f"log-evidence: standard error is {evidence.total_error[i]:.2f}, above "
                f"{_MOST_NATS}"
            )
    return Bridged(evidence, reasons)


def _bridge(
    mixture: LaplaceMixture,
    points: Point,
    found: ImportanceEvidence,
    log_proposal: np.ndarray,
    k: int,
    num_chains: int,
) -> Bridge | None:
    """Bridge of one structure; None with too few draws."""
    drawn, walked = found.structure == k, points.structure == k
    if min(np.sum(drawn), np.sum(walked)) < _LEAST_DRAWS:
        return None
    weight = np.asarray(mixture.log_weight, float)
    own = np.logaddexp.reduce(weight[np.asarray(mixture.structure) == k])
    # To the mixture within the structure; zero for draws that fell outside.
    first = np.asarray(found.log_density, float)[drawn] - log_proposal[drawn] + own
    second = np.asarray(points.log_density, float) - np.asarray(points.log_proposal)
    size = _effective_size(second.reshape(num_chains, -1), np.asarray(walked))
    return bridge_evidence(first, second[walked] + own, posterior_size=size)


def _effective_size(values: np.ndarray, is_mine: np.ndarray) -> float:
    """Effective number of draws of one structure.

    Descendants of one weighted draw lie together, and show as autocorrelation.
    """
    mine = is_mine.reshape(values.shape)
    length = int(mine.sum(axis=1).min())
    if length < _LEAST_DRAWS:
        return float(np.sum(is_mine)) / _LEAST_DRAWS
    rows = [v[m][:length] for v, m in zip(values, mine, strict=True)]
    return float(effective_sample_size(np.stack(rows)))


def _odds(
    log_evidence: np.ndarray, error: np.ndarray, log_prior: np.ndarray
) -> StructureEvidence:
    """Probabilities, with errors to first order, from evidence that errs on its own."""
    joint = log_evidence + log_prior
    total = np.logaddexp.reduce(joint, axis=1)
    probability = np.exp(joint - total[:, None])
    part = probability * np.where(np.isfinite(error), error, 0.0)
    whole = np.sum(part**2, axis=1)
    rest = np.maximum(whole[:, None] - part**2, 0.0)
    variance = (part * (1.0 - probability)) ** 2 + probability**2 * rest
    return StructureEvidence(
        log_evidence=log_evidence,
        error=error,
        probability=probability,
        probability_error=np.sqrt(variance),
        total=total,
        total_error=np.sqrt(whole),
    )
