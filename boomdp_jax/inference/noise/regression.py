r"""Smooth functions of the noise from their values at some draws of it.

Kernel ridge regression: a linear trend and, on what it leaves, a squared-exponential
kernel over all noises, scaled to the spread of the draws (Rasmussen and Williams 2006,
Gaussian Processes for Machine Learning, section 2.7). Beyond the draws it follows the
trend no further than to about their edge.
"""

from typing import NamedTuple

import numpy as np

# Length of the kernel for each number, in standard deviations of the draws; penalty
# relative to the kernel's height, and draws' farthest distance from their mean.
_LENGTH = 1.0
_PENALTY = 1e-3
_FARTHEST = 3.0


class NoiseRegression(NamedTuple):
    """Of one group."""

    mean: np.ndarray
    scale: np.ndarray
    known: np.ndarray
    """Draws that values were given for, scaled, `[known, number]`."""
    trend: np.ndarray
    """`[1 + number, value]`."""
    weight: np.ndarray
    """`[known, value]`."""

    @classmethod
    def fit(cls, vector: np.ndarray, value: np.ndarray) -> "NoiseRegression":
        """Take values `[draw, value]` at draws `[draw, number]`."""
        mean, scale = vector.mean(axis=0), np.maximum(vector.std(axis=0), 1e-6)
        empty = cls(mean, scale, vector, np.zeros(0), np.zeros(0))
        known = empty._scaled(vector)
        features = _linear(known)
        ridge = np.diag([0.0, *[_PENALTY * len(known)] * known.shape[1]])
        trend = np.linalg.solve(features.T @ features + ridge, features.T @ value)
        kernel = _kernel(known, known) + _PENALTY * np.eye(len(known))
        weight = np.linalg.solve(kernel, value - features @ trend)
        return cls(mean, scale, known, trend, weight)

    def __call__(self, vector: np.ndarray) -> np.ndarray:
        """Values `[draw, value]` at draws `[draw, number]`."""
        at = self._scaled(vector)
        return _linear(at) @ self.trend + _kernel(at, self.known) @ self.weight

    def _scaled(self, vector: np.ndarray) -> np.ndarray:
        return np.clip((vector - self.mean) / self.scale, -_FARTHEST, _FARTHEST)


def _linear(at: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(at), 1)), at], axis=1)


def _kernel(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    square = np.sum(one**2, axis=1)[:, None] + np.sum(two**2, axis=1)[None]
    square = np.maximum(square - 2.0 * one @ two.T, 0.0)
    return np.exp(-0.5 * square / (_LENGTH**2 * one.shape[1]))
