r"""Proposals that move every draw of a list by what the others of its group say.

Groups are draws of one structure of one object. Two kinds:

- by the difference of two draws (ter Braak 2006, A Markov chain Monte Carlo version of
  differential evolution), which asks nothing of the shape of a posterior, and gets
  about slowly where there are many numbers;
- about the mean of the group, $x' = m + \sqrt{1 - b^2}\,(x - m) + b L \xi$ with $L L^T$
  its covariance (Neal 1999, Regression and classification using Gaussian process
  priors; Cotter et al. 2013, MCMC methods for functions). It leaves the normal density
  q of that mean and covariance as it is, so that a posterior p is left as it is by
  accepting with $p(x') q(x) / p(x) q(x')$: the nearer to normal a posterior, the
  further one such move goes, in however many dimensions.
"""

from typing import NamedTuple

import numpy as np

# Draws of a group from which its spread is taken.
_LEAST_GROUP = 4
# Draws of a group for each number, from which its covariance is taken.
_LEAST_FOR_EACH = 5
# Shares b of a move that are new, drawn evenly between these for each draw.
_SHARES = (0.2, 1.0)
# Added to the diagonal of correlations.
_RIDGE = 1e-6


class Proposed(NamedTuple):
    """Where draws might go; `[draw, ...]`."""

    values: np.ndarray
    log_ratio: np.ndarray
    """Density of the proposal back over that of the proposal."""


def by_differences(
    rng: np.random.Generator,
    values: np.ndarray,
    group: np.ndarray,
    period: np.ndarray,
    num_moved: np.ndarray,
    size: float,
) -> Proposed:
    """Steps along the difference of two draws of the group, stretched at random.

    Args:
        rng: source of randomness.
        values: where draws are, `[draw, number]`.
        group: of each, `[draw]`.
        period: of each number; zero: it has none.
        num_moved: how many numbers of each draw are free, `[draw]`.
        size: length relative to the best for a normal density.
    """
    order = np.argsort(group, kind="stable")
    num = np.bincount(group)[group]
    begin = np.searchsorted(group[order], group)
    pick = [order[begin + (rng.random(len(num)) * num).astype(int)] for _ in range(2)]
    step = wrapped(values[pick[0]] - values[pick[1]], period)
    length = size * 2.38 / np.sqrt(2.0 * num_moved)[:, None]
    stretch = length * np.exp(rng.standard_normal((len(num), 1)) * 0.5)
    step = np.where((num >= _LEAST_GROUP)[:, None], stretch * step, 0.0)
    return Proposed(wrapped(values + step, period), np.zeros(len(num)))


def about_means(
    rng: np.random.Generator,
    values: np.ndarray,
    group: np.ndarray,
    period: np.ndarray,
) -> Proposed:
    """Moves that would keep the normal density of each group's mean and covariance.

    Draws of small groups stay. A number with a period is one within half of it of its
    mean: where a move would leave that range it is ruled out.

    Args:
        rng: source of randomness.
        values: where draws are, `[draw, number]`.
        group: of each, `[draw]`.
        period: of each number; zero: it has none.
    """
    out, log_ratio = values.copy(), np.zeros(len(values))
    half = np.where(period > 0, 0.5 * period, np.inf)
    for name in np.unique(group):
        rows = np.flatnonzero(group == name)
        center = _mean(values[rows], period)
        offset = wrapped(values[rows] - center, period)
        sd = offset.std(axis=0)
        used = np.flatnonzero(sd > 1e-12 * np.maximum(np.abs(center), 1.0))
        if not used.size or len(rows) < _LEAST_FOR_EACH * used.size:
            continue
        offset, sd = offset[:, used], sd[used]
        correlation = np.corrcoef(offset.T).reshape(used.size, used.size)
        factor = np.linalg.cholesky(correlation + _RIDGE * np.eye(used.size))
        now = np.linalg.solve(factor, (offset / sd).T).T
        share = rng.uniform(*_SHARES, size=(len(rows), 1))
        new = np.sqrt(1.0 - share**2) * now
        new = new + share * rng.standard_normal(now.shape)
        moved = (new @ factor.T) * sd
        out[np.ix_(rows, used)] = wrapped(center[used] + moved, period[used])
        is_inside = np.all(np.abs(moved) < half[used], axis=1)
        gain = 0.5 * (np.sum(new**2, axis=1) - np.sum(now**2, axis=1))
        log_ratio[rows] = np.where(is_inside, gain, -np.inf)
    return Proposed(out, log_ratio)


def _mean(values: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Of each number; of one with a period, the direction of the mean vector."""
    turn = 2.0 * np.pi / np.where(period > 0, period, 1.0)
    sine, cosine = np.sin(turn * values), np.cos(turn * values)
    angle = np.arctan2(sine.mean(axis=0), cosine.mean(axis=0))
    return np.where(period > 0, angle / turn, values.mean(axis=0))


def wrapped(values: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Numbers with a period brought into half of it about zero.

    Args:
        values: `[*any, number]`.
        period: of each number; zero: it has none, and stays.
    """
    length = np.where(period > 0, period, 1.0)
    turned = values - length * np.floor(values / length + 0.5)
    return np.where(period > 0, turned, values)
