"""Evidence and odds of structures with their errors, and whether two methods agree."""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.samplers.importance_evidence import ImportanceEvidence

# Gaps that count as a disagreement: beyond so many standard errors, and large enough to
# matter to anyone, in probability and in nats.
_NUM_ERRORS, _LEAST_GAP, _LEAST_NATS = 5.0, 0.02, 0.1


class StructureEvidence(NamedTuple):
    """What a method says of every structure of a batch of objects; on the host.

    An error that the method does not know is NaN.
    """

    log_evidence: np.ndarray
    """Log of the likelihood averaged over a structure's prior, `[object, structure]`;
    minus infinity where the method has not seen the structure."""
    error: np.ndarray
    """Standard error of `log_evidence`."""
    probability: np.ndarray
    """`[object, structure]`."""
    probability_error: np.ndarray
    total: np.ndarray
    """Log-evidence of all structures together, prior included, `[object]`."""
    total_error: np.ndarray


def evidence_by_importance(
    evidence: ImportanceEvidence, log_prior: np.ndarray
) -> StructureEvidence:
    """What importance sampling says.

    Args:
        evidence: of a batch of objects, with a leading object axis.
        log_prior: of each structure, `[object, structure]`.
    """
    log_evidence = np.asarray(evidence.log_evidence, float)
    size = np.asarray(evidence.effective_sample_size, float)
    num_draws = evidence.log_weight.shape[-1]
    with np.errstate(divide="ignore"):
        variance = 1.0 / np.where(size > 0, size, 0.0) - 1.0 / num_draws
    return StructureEvidence(
        log_evidence=log_evidence,
        error=np.asarray(evidence.evidence_error, float),
        probability=np.asarray(evidence.probability, float),
        probability_error=np.asarray(evidence.probability_error, float),
        total=np.logaddexp.reduce(log_evidence + log_prior, axis=-1),
        total_error=np.sqrt(np.maximum(variance, 0.0)),
    )


def evidence_by_replicates(
    log_joint: np.ndarray, log_prior: np.ndarray
) -> StructureEvidence:
    """What independent, unbiased replicates say together.

    Args:
        log_joint: log of prior times evidence of each structure by each replicate,
            `[object, replicate, structure]`.
        log_prior: of each structure, `[object, structure]`.

    Returns:
        Means over replicates, and errors from their spread.
    """
    num = log_joint.shape[1]
    top = np.max(log_joint, axis=(1, 2), keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    share = np.exp(log_joint - top)
    mean, whole = share.mean(1), share.sum(2).mean(1)
    safe = np.where(whole > 0, whole, 1.0)[:, None]
    probability = mean / safe
    # A ratio of means, to first order in the errors of both.
    residual = share - probability[:, None] * share.sum(2, keepdims=True)
    root = np.sqrt(max(num - 1, 1) * num)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(np.sum((share - mean[:, None]) ** 2, axis=1)) / root
        error = np.where(mean > 0, spread / mean, np.inf)
        log_mean = np.log(mean) + top[:, 0]
        total = np.log(whole) + top[:, 0, 0]
        log_evidence = log_mean - np.where(log_prior > -np.inf, log_prior, 0.0)
    each = share.sum(2) - whole[:, None]
    return StructureEvidence(
        log_evidence=log_evidence,
        error=error,
        probability=probability,
        probability_error=np.sqrt(np.sum(residual**2, axis=1)) / (root * safe),
        total=total,
        total_error=np.sqrt(np.sum(each**2, axis=1)) / (root * safe[:, 0]),
    )


class VisitedShares(NamedTuple):
    """Share of draws in every structure, `[object, structure]`."""

    probability: np.ndarray
    probability_error: np.ndarray


def visited_shares(
    structure: np.ndarray, num_structures: int, num_independent: int
) -> VisitedShares:
    """Odds by counting draws.

    Args:
        structure: of each draw, `[object, chain, draw]`.
        num_structures: of each object.
        num_independent: walkers that never met, of all chains together.

    Returns:
        Shares, with the larger of two errors: that from the spread of the chains, and
        that of one independent draw a walker.
    """
    is_of = structure[..., None] == np.arange(num_structures)
    by_chain = is_of.mean(axis=2)
    share = by_chain.mean(axis=1)
    num_chains = by_chain.shape[1]
    between = by_chain.var(axis=1, ddof=1) / num_chains if num_chains > 1 else 0.0
    binomial = share * (1.0 - share) / num_independent
    return VisitedShares(share, np.sqrt(np.maximum(between, binomial)))


def odds_disagree(
    first: StructureEvidence | VisitedShares,
    second: StructureEvidence | VisitedShares,
    index: int,
    names: tuple[str, str],
) -> list[str]:
    """Reasons to doubt two methods' odds of one object's structures."""
    gap = np.abs(first.probability[index] - second.probability[index])
    error = _both(first.probability_error[index], second.probability_error[index])
    limit = np.maximum(_NUM_ERRORS * error, _LEAST_GAP)
    if not np.any(gap > limit):
        return []
    worst = int(np.argmax(gap - limit))
    return [
        f"probability of a structure: {names[0]} says "
        f"{first.probability[index, worst]:.3f}, {names[1]} "
        f"{second.probability[index, worst]:.3f}, with a standard error of "
        f"{error[worst]:.3f}"
    ]


def evidence_disagrees(
    first: StructureEvidence,
    second: StructureEvidence,
    index: int,
    names: tuple[str, str],
) -> list[str]:
    """Reasons to doubt two methods' evidence of one object."""
    gap = abs(first.total[index] - second.total[index])
    rows = slice(index, index + 1)
    error = float(_both(first.total_error[rows], second.total_error[rows])[0])
    if gap <= max(_NUM_ERRORS * error, _LEAST_NATS):
        return []
    return [
        f"log-evidence: {names[0]} says {first.total[index]:.2f}, {names[1]} "
        f"{second.total[index]:.2f}, with a standard error of {error:.2f}"
    ]


def _both(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Error of a difference; what is not known is left out."""
    return np.hypot(np.nan_to_num(first), np.nan_to_num(second))


def reweighed(
    evidence: StructureEvidence,
    before: np.ndarray,
    after: np.ndarray,
    log_share: np.ndarray,
    log_prior: np.ndarray,
) -> StructureEvidence:
    """Evidence times the mean weight of each structure's draws.

    Args:
        evidence: with fixed gains.
        before: structure of each draw, `[object, chain, draw]`.
        after: the same at the end.
        log_share: log of the product of mean weights, `[object, chain]`.
        log_prior: of each structure, `[object, structure]`.

    Returns:
        The same of the filter with inferred noise. Structures without draws keep
        their odds against all others together; their errors are not known.
    """
    num = evidence.probability.shape[1]
    names = np.arange(num)
    share = np.mean(before[..., None] == names, axis=2)
    mass = np.mean(after[..., None] == names, axis=2)
    # Chains start with draws of their own, which the ratio makes up for.
    top = log_share.max(axis=1, keepdims=True)
    mass = mass * np.exp(log_share - top)[..., None]
    pooled = share.mean(axis=1)
    has_draws = pooled > 0
    factor = mass.mean(axis=1) / np.where(has_draws, pooled, 1.0)
    residual = mass - factor[:, None] * share
    num_chains = before.shape[1]
    spread = np.sqrt((residual**2).sum(axis=1) / (num_chains * max(num_chains - 1, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        own = spread / np.where(has_draws, pooled, np.nan) / factor
        whole = np.log(np.sum(evidence.probability * factor, axis=1)) - np.log(
            np.sum(evidence.probability * has_draws, axis=1)
        )
        log_factor = np.where(has_draws, np.log(factor), whole[:, None]) + top
    log_evidence = evidence.log_evidence + log_factor
    joint = log_evidence + log_prior
    total = np.logaddexp.reduce(joint, axis=1)
    probability = np.exp(joint - total[:, None])
    error = np.hypot(evidence.error, own)
    # To first order, errors of structures independent of each other.
    each = np.nan_to_num(probability * own)
    rest = np.sqrt(np.sum(each**2, axis=1, keepdims=True))
    return StructureEvidence(
        log_evidence=log_evidence,
        error=error,
        probability=probability,
        probability_error=np.sqrt(
            evidence.probability_error**2
            + ((1.0 - 2.0 * probability) * each**2 + probability**2 * rest**2)
        ),
        total=total,
        total_error=np.hypot(evidence.total_error, rest[:, 0]),
    )
