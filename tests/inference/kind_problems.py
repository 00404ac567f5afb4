"""Objects with known Gaussian likelihoods, and every partition of them."""

from collections.abc import Iterator

import numpy as np
from scipy import stats

from boomdp_jax.inference.kinds.coordinates import CoordinateModel
from boomdp_jax.inference.kinds.likelihood_bumps import bump_of_posterior, join_bumps
from boomdp_jax.inference.kinds.prior import KindPrior
from boomdp_jax.inference.kinds.state import KindData

SPREADS, WEIGHTS = (0.15, 0.6, 1.0), (0.5, 0.3, 0.2)
NOISE = 0.3
STRUCTURES = np.array([[True, False], [True, True]])
STRUCTURE_PRIOR = np.array([0.6, 0.4])


def plain_model(num: int, spreads=SPREADS, weights=WEIGHTS) -> CoordinateModel:
    """Coordinates without a period."""
    return CoordinateModel(
        period=np.zeros(num),
        spread=np.tile(spreads, (num, 1)),
        log_weight=np.tile(np.log(weights), (num, 1)),
    )


def gaussian_problem(
    reading: np.ndarray,
    structure_evidence: np.ndarray,
    *,
    prior: KindPrior | None = None,
    label: np.ndarray | None = None,
    feature: np.ndarray | None = None,
    shift: float = 0.0,
    widening: float = 1.0,
) -> KindData:
    """Objects with y = z + e for each coordinate that their structure uses.

    Args:
        reading: `[object, 2]`; NaN: nothing is known of this object.
        structure_evidence: further log-likelihood of each structure, `[object, 2]`.
        prior: of kinds.
        label: of objects.
        feature: of objects.
        shift: by how much bumps are off, in posterior sd.
        widening: by how much they are too wide.
    """
    num_objects, dim = reading.shape
    feature = np.zeros((num_objects, 0)) if feature is None else feature
    label = np.full(num_objects, -1) if label is None else label

    def log_likelihood(index, structure, z):
        residual = (reading[index] - z) / NOISE
        each = -0.5 * residual**2 - np.log(NOISE) - 0.5 * np.log(2 * np.pi)
        used = np.where(STRUCTURES[structure], each, 0.0).sum(axis=1)
        return used + structure_evidence[index, structure]

    bumps = []
    for i in range(num_objects):
        if np.isnan(reading[i, 0]):
            bumps.append(None)
            continue
        several = []
        for k, used in enumerate(STRUCTURES):
            variance = np.where(used, 1 / (1 + NOISE**-2), 1.0)
            mean = np.where(used, variance * reading[i] / NOISE**2, 0.0)
            evidence = stats.norm.logpdf(reading[i], 0, np.sqrt(1 + NOISE**2))
            several.append(
                bump_of_posterior(
                    k,
                    used,
                    np.zeros(dim),
                    mean + shift * np.sqrt(variance) * used,
                    np.diag(widening**2 * variance),
                    float(evidence[used].sum() + structure_evidence[i, k]),
                )
            )
        bumps.append(join_bumps(several))
    return KindData(
        coordinates=plain_model(dim + feature.shape[1]),
        in_use=STRUCTURES,
        log_prior=np.log(STRUCTURE_PRIOR),
        bumps=tuple(bumps),
        label=label,
        num_labels=int(label.max()) + 1,
        feature=feature,
        log_likelihood=log_likelihood,
        prior=KindPrior() if prior is None else prior,
    )


def partitions(num: int) -> Iterator[tuple[int, ...]]:
    """Every partition of so many objects, kinds numbered by first appearance."""

    def extend(labels: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        if len(labels) == num:
            yield labels
            return
        for next_label in range(max(labels, default=-1) + 2):
            yield from extend((*labels, next_label))

    return extend(())


def canonical(kind: np.ndarray) -> tuple[int, ...]:
    """Kinds numbered by first appearance."""
    names: dict[int, int] = {}
    return tuple(names.setdefault(int(k), len(names)) for k in kind)


def log_restaurant(partition: tuple[int, ...], concentration: float) -> float:
    """Chinese-restaurant probability, customer by customer."""
    out, counts = 0.0, {}
    for number, kind in enumerate(partition):
        weight = counts.get(kind, concentration)
        out += np.log(weight / (number + concentration))
        counts[kind] = counts.get(kind, 0) + 1
    return out


def log_group(values: np.ndarray, noise: float) -> float:
    """Density of one coordinate's readings of a kind, over spreads, by SciPy."""
    n = len(values)
    each = []
    for spread, weight in zip(SPREADS, WEIGHTS, strict=True):
        covariance = (spread**2 + noise**2) * np.eye(n) + (1 - spread**2)
        density = stats.multivariate_normal(np.zeros(n), covariance).logpdf(values)
        each.append(np.log(weight) + density)
    return float(np.logaddexp.reduce(each))


def log_counts(chosen: list[int], base: np.ndarray) -> float:
    """Dirichlet-categorical probability of a list of choices, one by one."""
    out, count = 0.0, np.zeros(len(base))
    for choice in chosen:
        out += np.log((base[choice] + count[choice]) / (base.sum() + count.sum()))
        count[choice] += 1
    return out
