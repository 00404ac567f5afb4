"""Noise of readings and motion at a hypothesis, and the gains that follow from it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.fits.fit import Fits
from boomdp_jax.inference.hypotheses.noise_level import (
    NUM_EACH,
    NoiseFit,
    log_noise_prior,
)
from boomdp_jax.inference.likelihoods.filter_points import (
    filter_densities,
    filter_points,
)
from boomdp_jax.inference.likelihoods.target import StructureTarget

# Steps of the differences, in logarithms of noise.
_DIFFERENCE = 0.2
_LONGEST_STEP = 1.5
_LENGTHS = np.array([1.0, 0.5, 0.2])
# A fit that gains less in an iteration has arrived.
_ARRIVED = 0.02
# Least curvature: the prior of an impulse has 0.25.
_LEAST_CURVATURE = 0.2


class NoisePeaks(NamedTuple):
    """Most probable noise at a list of hypotheses, and how well it is known."""

    noise: NoiseFit
    precision: np.ndarray
    """Minus the Hessian of the log-density in the logarithms, made positive, `[point,
    number, number]`."""
    log_density: np.ndarray
    """Of readings and noise, `[point]`."""


Density = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Of the noise at some of a list of hypotheses: from their places in the list and
logarithms `[point, try, number]` to log-densities `[point, try]`."""


def fit_noise(
    targets: StructureTarget, fits: Fits, start: NoiseFit, num_iterations: int = 12
) -> NoisePeaks:
    """Maximise likelihood times prior over the noise at hypotheses that stay fixed.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        fits: the hypotheses.
        start: where to start; better too high than too low.
        num_iterations: as `climb_noise` has it.

    Returns:
        The noise of each.
    """
    rows = np.arange(len(fits.z))
    return climb_noise(NoiseDensity(targets, fits), rows, start, num_iterations)


def climb_noise(
    density: Density, rows: np.ndarray, start: NoiseFit, num_iterations: int = 12
) -> NoisePeaks:
    """Maximise a density of noise.

    Newton's method on the logarithms by differences; directions in which the density
    curves upwards are followed as if it curved downwards as much, and three lengths of
    every step are tried.

    Args:
        density: what is maximised.
        rows: of which hypothesis of its list, `[point]`.
        start: of each point.
        num_iterations: most iterations; with 0 the curvature at the start is found.

    Returns:
        The noise of each point.
    """
    x = start.vector.copy()
    value = np.full(len(x), -np.inf)
    precision = np.zeros((*x.shape, x.shape[1]))
    left = np.arange(len(x))
    for iteration in range(num_iterations + 1):
        here, slope, matrix = _derivatives(density, rows[left], x[left])
        value[left], precision[left] = here, matrix
        if iteration == num_iterations:
            break
        step = np.linalg.solve(matrix, slope[..., None])[..., 0]
        longest = np.abs(step).max(axis=1, keepdims=True)
        step = step * np.minimum(1.0, _LONGEST_STEP / np.maximum(longest, 1e-12))
        tries = x[left][:, None] + _LENGTHS[None, :, None] * step[:, None]
        found = density(rows[left], tries)
        choice = np.argmax(found, axis=1)
        each = np.arange(len(left))
        is_better = found[each, choice] > here
        # Both may be minus infinity.
        gain = np.zeros(len(left))
        np.subtract(found[each, choice], here, out=gain, where=is_better)
        x[left] = np.where(is_better[:, None], tries[each, choice], x[left])
        left = left[gain > _ARRIVED]
        if not left.size:
            break
    return NoisePeaks(NoiseFit.of_vector(x), precision, value)


class NoiseDensity:
    """Log-density of noise at the hypotheses of a list."""

    def __init__(self, targets: StructureTarget, fits: Fits):
        likelihood: Any = targets.log_likelihood
        self._targets, self._fits = targets, fits
        self._scale = np.asarray(likelihood.coordinates.scales.noise, float)

    def __call__(self, rows: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Of `[point, try, number]` at some hypotheses, `[point, try]`."""
        fits = self._fits.take(np.repeat(rows, x.shape[1]))
        vector = x.reshape(-1, x.shape[-1])
        found = filter_densities(
            self._targets,
            fits.index,
            fits.structure,
            fits.z,
            NoiseFit.of_vector(vector),
        )
        found = found + log_noise_prior(self._scale[fits.index], vector)
        return found.reshape(x.shape[:2])


def _derivatives(density: Density, rows: np.ndarray, x: np.ndarray):
    """Value, gradient and minus the Hessian, made positive.

    Noises of different bodies are taken not to bend the density together, so that
    the work grows with the number of bodies and not with its square.
    """
    size = x.shape[1]
    first, second = np.triu_indices(size, 1)
    is_same = first // NUM_EACH == second // NUM_EACH
    first, second = first[is_same], second[is_same]
    unit = _DIFFERENCE * np.eye(size)
    shifts = np.concatenate(
        [np.zeros((1, size)), unit, -unit, unit[first] + unit[second]]
    )
    value = density(rows, x[:, None] + shifts[None])
    worst = np.where(np.isfinite(value), value, np.inf).min(axis=1, keepdims=True)
    is_known = np.isfinite(worst)
    value = np.where(np.isfinite(value), value, np.where(is_known, worst, 0.0))
    here, up, down = value[:, 0], value[:, 1 : size + 1], value[:, size + 1 :]
    down, both = down[:, :size], down[:, size:]
    slope = (up - down) / (2.0 * _DIFFERENCE)
    each = np.arange(size)
    hessian = np.zeros((len(x), size, size))
    hessian[:, each, each] = up - 2.0 * here[:, None] + down
    hessian[:, first, second] = both - up[:, first] - up[:, second] + here[:, None]
    hessian[:, second, first] = hessian[:, first, second]
    length, way = np.linalg.eigh(-hessian / _DIFFERENCE**2)
    length = np.maximum(np.abs(length), _LEAST_CURVATURE)
    matrix = (way * length[:, None]) @ np.swapaxes(way, 1, 2)
    return np.where(is_known[:, 0], here, -np.inf), slope, matrix


def with_gains(
    targets: StructureTarget, best: Fits, noise: NoiseFit
) -> StructureTarget:
    """Give every structure the gains of its own best fit with its own noise.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        best: one fit of every structure of every object; a structure without one keeps
            the gains that it has.
        noise: of each of them.

    Returns:
        Targets whose likelihood tracks with the new gains.
    """
    likelihood: Any = targets.log_likelihood
    found = filter_points(targets, best.index, best.structure, best.z, noise)
    dtype = targets.log_prior.dtype

    def arrange(new, old):
        whole = np.array(old, float)
        whole[best.index, best.structure] = new
        return on_device(whole, dtype)

    return eqx.tree_at(
        lambda t: (t.log_likelihood.gains, t.log_likelihood.reference),
        targets,
        (
            jax.tree.map(arrange, found.gains, likelihood.gains),
            arrange(noise.reading, likelihood.reference),
        ),
    )
