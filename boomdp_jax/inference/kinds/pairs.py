"""Which objects may well be of one kind, before any chain has run.

Kinds are split and merged by pairs of objects (`particles`). Most pairs have
nothing in common, and to ask whether their kinds are one is a waste. How often a pair
is asked about only matters for speed, but must not depend on where chains are: here it
follows labels, outlines and what the bumps of both say.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.kinds.coordinates import wrap
from boomdp_jax.inference.kinds.likelihood_bumps import (
    Bumps,
    log_mass,
    prior_variance,
    start_of_bumps,
)
from boomdp_jax.inference.kinds.state import KindData, label_base

# Share of anchors that are drawn evenly, whatever the evidence.
_EVEN_SHARE = 0.1
# Nats of evidence beyond which pairs are as probable, or improbable.
_MOST_FOR, _MOST_AGAINST = 3.0, 5.0


def log_pairs(data: KindData) -> np.ndarray:
    """How often another object is asked about with each object.

    Args:
        data: what is known of the objects.

    Returns:
        Logarithms, `[N, N]`; rows add up to one, nothing is paired with itself.
    """
    num = data.num_objects
    other = ~np.eye(num, dtype=bool)
    if num < 2:
        return np.full((num, num), -np.inf)
    evidence = _of_labels(data) + _of_features(data) + _of_readings(data)
    weight = np.exp(np.clip(evidence, -_MOST_AGAINST, _MOST_FOR)) * other
    weight /= weight.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        return np.log((1.0 - _EVEN_SHARE) * weight + _EVEN_SHARE * other / (num - 1))


def _of_labels(data: KindData) -> np.ndarray:
    """Log of how much more probable the labels are of one kind than of two."""
    base = np.append(label_base(data)[:-1], 1.0)
    has_both = (data.label[:, None] >= 0) & (data.label >= 0)
    is_same = data.label[:, None] == data.label
    total, own = data.prior.label_weight, base[data.label][None]
    ratio = np.log((is_same + own) / (1.0 + total)) - np.log(own / total)
    return np.where(has_both, ratio, 0.0)


def _of_features(data: KindData) -> np.ndarray:
    model = data.coordinates.part(data.dim, data.coordinates.dim)
    first, second = model.moments(data.feature)
    one = model.log_over_spreads(np.ones_like(first), first, second).sum(axis=-1)
    sums = (first[:, None] + first, second[:, None] + second)
    two = model.log_over_spreads(np.full_like(sums[0], 2.0), *sums).sum(axis=-1)
    return two - one[:, None] - one


class _Alone(NamedTuple):
    """One object's posterior under the ordinary prior; leading axis `bump`."""

    structure: np.ndarray
    log_share: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


def _of_readings(data: KindData) -> np.ndarray:
    """The same of the readings, as far as normal posteriors tell."""
    dim, num = data.dim, data.num_objects
    period = data.coordinates.period[:dim]
    alone = [None if b is None else _alone(data, b, period) for b in data.bumps]
    spread = data.coordinates.spread[:dim]
    variance = prior_variance(period)
    within = np.where(np.isfinite(spread), spread**2, variance[:, None])
    out = np.zeros((num, num))
    for i, one in enumerate(alone):
        for j, two in enumerate(alone[:i]):
            if one is not None and two is not None:
                out[i, j] = out[j, i] = _of_pair(data, one, two, within, variance)
    return out


def _alone(data: KindData, bumps: Bumps, period: np.ndarray) -> _Alone:
    prior = prior_variance(period)
    start = start_of_bumps(bumps, period, np.zeros((1, len(period))), prior[None])
    weight = log_mass(bumps, start, prior[None])[0][0]
    weight = weight + data.log_prior[bumps.structure]
    precision = np.einsum("mdr,mer->mde", bumps.factor, bumps.factor)
    covariance = np.linalg.inv(precision + np.diag(1.0 / prior))
    pull = np.einsum("mdr,mr->md", bumps.factor, bumps.residual) + start[0] / prior
    mean = bumps.centre + np.einsum("mde,me->md", covariance, pull)
    spread = np.einsum("mdd->md", covariance)
    total = np.logaddexp.reduce(weight)
    return _Alone(bumps.structure, weight - total, mean, spread)


def _of_pair(data: KindData, one: _Alone, two: _Alone, within, prior) -> float:
    """Sum over structures that both may have; a coordinate by itself each."""
    k, m = np.nonzero(one.structure[:, None] == two.structure)
    if not len(k):
        return -_MOST_AGAINST
    structure = one.structure[k]
    period = data.coordinates.period[: data.dim]
    square = wrap(one.mean[k] - two.mean[m], period) ** 2
    both = one.variance[k] + two.variance[m]
    shared = 2.0 * within + both[..., None]
    apart = 2.0 * prior
    log_shared = -0.5 * (square[..., None] / shared + np.log(shared))
    log_shared = log_shared + data.coordinates.log_weight[: data.dim]
    highest = log_shared.max(axis=-1)
    log_shared = highest + np.log(np.exp(log_shared - highest[..., None]).sum(axis=-1))
    log_apart = -0.5 * (square / apart + np.log(apart))
    gain = np.where(data.in_use[structure], log_shared - log_apart, 0.0).sum(axis=-1)
    gain += one.log_share[k] + two.log_share[m] - data.log_prior[structure]
    return float(max(np.logaddexp.reduce(gain), -_MOST_AGAINST))
