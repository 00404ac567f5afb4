"""Bumps fitted to what sampling an object by itself has drawn."""

import numpy as np

from boomdp_jax.inference.kinds.coordinates import wrap
from boomdp_jax.inference.kinds.likelihood_bumps import (
    Bump,
    Bumps,
    bump_of_posterior,
    join_bumps,
)

# A structure less probable than the likeliest one by so many nats is left out: the gain
# of a kind's tight prior over the ordinary one is some two nats for each coordinate.
_MOST_NATS = 40.0
# Draws per coordinate in use from which moments are taken; with fewer, the fitted mode
# stands for the structure.
_DRAWS_PER_DIM = 8
# Importance draws whose effective number is under this say nothing of an evidence.
_LEAST_SIZE = 3.0


class StructureDraws:
    """Draws of one object that have one structure."""

    def __init__(self, z: np.ndarray, weight: np.ndarray):
        """Keep the draws that have any weight.

        Args:
            z: coordinates in use, `[draw, used]`.
            weight: of each draw; need not be normalised.
        """
        kept = weight > 0
        # By the largest first: of a structure all but impossible the sum is no number.
        weight = weight[kept] / weight[kept].max(initial=0.0)
        self.z, self.weight = z[kept], weight / max(weight.sum(), 1.0)

    @property
    def size(self) -> float:
        """Effective number of draws; repeated ones count once."""
        if len(self.weight) == 0:
            return 0.0
        _, which = np.unique(self.z, axis=0, return_inverse=True)
        merged = np.bincount(which.ravel(), self.weight)
        return float(1.0 / np.sum(merged**2))

    def moments(self, period: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance; of an angle about its mean direction."""
        turn = np.where(period > 0, 2.0 * np.pi / np.where(period > 0, period, 1.0), 0)
        sine = self.weight @ np.sin(turn * self.z)
        cosine = self.weight @ np.cos(turn * self.z)
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = np.where(turn > 0, np.arctan2(sine, cosine) / turn, 0.0)
        offset = wrap(self.z - centre, period)
        mean = self.weight @ offset
        offset = offset - mean
        covariance = (offset * self.weight[:, None]).T @ offset
        return wrap(centre + mean, period), covariance


def fit_bumps(
    in_use: np.ndarray,
    period: np.ndarray,
    log_prior: np.ndarray,
    log_evidence: np.ndarray,
    chain: tuple[np.ndarray, np.ndarray],
    weighed: tuple[np.ndarray, np.ndarray, np.ndarray],
    modes: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> Bumps:
    """A bump for every structure that is not out of the question.

    Args:
        in_use: coordinates that each structure uses, `[structure, dim]`.
        period: of angles, else 0, `[dim]`.
        log_prior: of the structures.
        log_evidence: of the structures, by importance sampling.
        chain: structures and coordinates of the draws of chains.
        weighed: structures, coordinates and weights of importance draws.
        modes: structures, coordinates, precisions and log-densities of fitted modes.

    Returns:
        The bumps, at least one.
    """
    found: list[tuple[float, Bump]] = []
    for k, used in enumerate(in_use):
        if log_prior[k] == -np.inf:
            continue
        bump = _of_structure(
            k, used, period, float(log_prior[k]), log_evidence[k], chain, weighed, modes
        )
        if bump is not None:
            found.append(bump)
    best = max(weight for weight, _ in found)
    return join_bumps([bump for weight, bump in found if weight > best - _MOST_NATS])


def _of_structure(
    k: int, used, period, log_prior: float, log_evidence: float, chain, weighed, modes
) -> tuple[float, Bump] | None:
    """Log-weight under the ordinary prior, and the bump."""
    columns = np.flatnonzero(used)
    part = period[columns]
    mine = chain[0] == k
    draws = StructureDraws(chain[1][mine][:, columns], np.ones(int(mine.sum())))
    among = weighed[0] == k
    other = StructureDraws(weighed[1][among][:, columns], weighed[2][among])
    if draws.size < _DRAWS_PER_DIM * len(columns):
        draws = other
    mode = _best_mode(k, modes)
    dim = len(used)
    mean, covariance = np.zeros(dim), np.eye(dim)
    inner = np.ix_(columns, columns)
    if draws.size >= _DRAWS_PER_DIM * len(columns):
        middle, spread = draws.moments(part)
        mean[columns], covariance[inner] = middle, spread
        covariance[inner] += np.diag(1e-9 * np.diag(spread) + 1e-16)
    elif mode is not None:
        z, precision, _ = mode
        mean[columns] = z[columns]
        floor = np.where(part > 0, 12.0 / np.where(part > 0, part, 1.0) ** 2, 1e-6)
        try:
            np.linalg.cholesky(precision[inner] + np.diag(floor))
        except np.linalg.LinAlgError:
            return None
        covariance[inner] = np.linalg.inv(precision[inner] + np.diag(floor))
    else:
        return None
    if other.size < _LEAST_SIZE or not np.isfinite(log_evidence):
        if mode is None:
            return None
        _, _, log_density = mode
        volume = np.linalg.slogdet(2.0 * np.pi * covariance[inner])[1]
        log_evidence = log_density - log_prior + 0.5 * volume
    bump = bump_of_posterior(k, used, period, mean, covariance, float(log_evidence))
    return float(log_evidence) + log_prior, bump


def _best_mode(k: int, modes) -> tuple[np.ndarray, np.ndarray, float] | None:
    structure, z, precision, log_density = modes
    height = np.where(structure == k, log_density, -np.inf)
    best = int(np.argmax(height))
    if not np.isfinite(height[best]):
        return None
    return z[best], precision[best], float(height[best])
