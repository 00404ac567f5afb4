"""Proposals of noise fitted to each structure: a t about the most probable noise."""

import math
from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.fit import Fits
from boomdp_jax.inference.fit_noise import fit_noise
from boomdp_jax.inference.noise_level import NoiseFit
from boomdp_jax.inference.target import StructureTarget

# Student's t of so many degrees of freedom, a little wider than the curvature says.
_FREEDOM, _WIDTH = 5.0, 1.1
_NUM_ITERATIONS = 8


class NoiseProposal(NamedTuple):
    """A multivariate t of the logarithms of noise for each group of draws.

    A group has the draws of one object and structure.
    """

    center: np.ndarray
    """`[group, number]`."""
    lower: np.ndarray
    """Cholesky factor of the inverse scale matrix, `[group, number, number]`."""

    @classmethod
    def fit(
        cls, targets: StructureTarget, draws: Fits, group: np.ndarray, start: NoiseFit
    ) -> "NoiseProposal":
        """Fit the noise at the best draw of every group.

        Args:
            targets: stacked along a leading object axis.
            draws: with their log-densities.
            group: of each draw.
            start: of each group.
        """
        num_groups = len(start.reading)
        order = np.lexsort((-draws.value, group))
        best = order[np.searchsorted(group[order], np.arange(num_groups))]
        peaks = fit_noise(targets, draws.take(best), start, _NUM_ITERATIONS)
        lower = np.linalg.cholesky(peaks.precision / _WIDTH**2)
        return cls(peaks.noise.vector, lower)

    def sample(self, rng: np.random.Generator, group: np.ndarray) -> np.ndarray:
        """Draw for each of a list of groups, `[draw, number]`."""
        size = self.center.shape[1]
        normal = rng.standard_normal((len(group), size))
        stretch = np.sqrt(rng.chisquare(_FREEDOM, len(group)) / _FREEDOM)
        spread = np.linalg.inv(np.swapaxes(self.lower, 1, 2))
        normal = normal / stretch[:, None]
        return self.center[group] + np.einsum("nij,nj->ni", spread[group], normal)

    def log_density(self, vector: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Of noise `[draw, number]` for each of a list of groups."""
        size = vector.shape[1]
        offset = vector - self.center[group]
        # lower lower^T is the precision.
        scaled = np.einsum("nji,nj->ni", self.lower[group], offset)
        square = np.sum(scaled**2, axis=1)
        volume = np.log(np.diagonal(self.lower, axis1=1, axis2=2)).sum(axis=1)
        half = 0.5 * (_FREEDOM + size)
        constant = math.lgamma(half) - math.lgamma(0.5 * _FREEDOM)
        constant -= 0.5 * size * math.log(_FREEDOM * math.pi)
        return volume[group] + constant - half * np.log1p(square / _FREEDOM)
