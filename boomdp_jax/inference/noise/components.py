"""Mixtures of normals fitted to draws that are weighed.

A few weights may have nearly all: where a proposal missed something, the one draw that
came upon it. So weights are cut off (Ionides 2008, Truncated importance sampling), and
what a component has few draws for is made up by the spread of all.
"""

from typing import NamedTuple

import numpy as np

NUM_COMPONENTS, _NUM_ITERATIONS = 4, 12
# Variance of components that nothing is known of, and added to that of each; both
# relative to the variance of all.
_UNKNOWN, _ADDED = 0.5, 0.02


class Components(NamedTuple):
    """A mixture of normal densities."""

    share: np.ndarray
    """`[component]`."""
    center: np.ndarray
    """`[component, number]`."""
    covariance: np.ndarray
    """`[component, number, number]`."""


def fit_components(
    rng: np.random.Generator,
    values: np.ndarray,
    log_weight: np.ndarray,
    least: np.ndarray,
) -> Components:
    """Fit a mixture by expectation and maximisation (Dempster et al. 1977).

    Args:
        rng: source of randomness, for where it starts.
        values: draws, `[draw, number]`.
        log_weight: of each; one at least is finite.
        least: covariance, of which a little is added to those of components too.
    """
    weight = truncated(log_weight)
    mean = weight @ values
    offset = values - mean
    whole = (offset.T * weight) @ offset + _ADDED * least
    unknown, added = _UNKNOWN * whole, _ADDED * (whole + least)
    share = np.full(NUM_COMPONENTS, 1.0 / NUM_COMPONENTS)
    center = values[_starts(rng, values, weight, whole)]
    covariance = np.tile(unknown, (NUM_COMPONENTS, 1, 1))
    for _ in range(_NUM_ITERATIONS):
        part = weight[:, None] * _shares_of_draws(values, share, center, covariance)
        total = np.maximum(part.sum(axis=0), 1e-12)
        share, center = total / total.sum(), (part.T @ values) / total[:, None]
        gap = values[:, None] - center
        covariance = np.einsum("nk,nki,nkj->kij", part, gap, gap) / total[:, None, None]
        num = total**2 / np.maximum(np.sum(part**2, axis=0), 1e-300)
        lack = values.shape[1] + 2.0
        known = (num / (num + lack))[:, None, None]
        covariance = known * covariance + (1.0 - known) * unknown + added
    return Components(share, center, covariance)


def truncated(log_weight: np.ndarray) -> np.ndarray:
    """Weights that sum to one, none above so many means as the root of their number.

    Args:
        log_weight: not all minus infinity.
    """
    weight = np.exp(log_weight - np.max(log_weight))
    weight = np.minimum(weight, np.sqrt(len(weight)) * weight.mean())
    return weight / weight.sum()


def _starts(
    rng: np.random.Generator, values: np.ndarray, weight: np.ndarray, whole: np.ndarray
) -> list[int]:
    """Draws far from each other (Arthur and Vassilvitskii 2007, k-means++)."""
    white = np.linalg.solve(np.linalg.cholesky(whole), values.T).T
    chosen = [int(rng.choice(len(values), p=weight))]
    for _ in range(NUM_COMPONENTS - 1):
        gap = np.sum((white[:, None] - white[chosen]) ** 2, axis=-1).min(axis=1)
        chance = weight * gap
        # All draws with any weight may be the same one.
        chance = chance / chance.sum() if chance.sum() > 0 else weight
        chosen.append(int(rng.choice(len(values), p=chance)))
    return chosen


def _shares_of_draws(
    values: np.ndarray, share: np.ndarray, center: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """How probably each draw is of each component, `[draw, component]`."""
    lower = np.linalg.cholesky(covariance)
    gap = np.moveaxis(values[:, None] - center, 0, -1)
    square = np.sum(np.linalg.solve(lower, gap) ** 2, axis=1).T
    volume = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    height = np.log(np.maximum(share, 1e-300)) - volume - 0.5 * square
    found = np.exp(height - height.max(axis=1, keepdims=True))
    return found / found.sum(axis=1, keepdims=True)
