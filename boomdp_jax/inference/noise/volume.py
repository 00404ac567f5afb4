"""What each of many noises leaves open, by one linearised track for all of them.

How noise weighs readings decides how wide a posterior is.
"""

from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.inference.fits.fit import Host, with_prior
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.kalman import Filtered
from boomdp_jax.inference.likelihoods.one_step import NOISE_SHAPE
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.linear_track import LinearTracks


class OpenVolumes(NamedTuple):
    """Of each of a list of noises, on the host."""

    log_volume: np.ndarray
    """By how much a structure's evidence exceeds its density at a hypothesis near its
    best fit, but for a constant, `[noise]`; -1e30 for noises so far off that nothing
    sound comes out."""
    variance: np.ndarray
    """Of each coordinate, one where it is not in use, `[noise, dim]`."""


def open_volumes(
    targets: StructureTarget,
    structure: int,
    champion: np.ndarray,
    precision: np.ndarray,
    track: tuple[NoiseFit, Filtered],
    noise: NoiseFit,
) -> OpenVolumes:
    """Work out what noises leave open.

    Args:
        targets: with a `FilteredLikelihood`, of one object of one body.
        structure: which.
        champion: hypothesis near the best fit of all noises, `[dim]`.
        precision: about it, of some noise, `[dim, dim]`.
        track: a noise and the filter of the champion with it, leading axis of one.
        noise: those of which it is asked.
    """
    one, none = np.full(1, structure), np.zeros(1, int)
    tracks = LinearTracks.along(
        targets, none, one, champion[None], precision[None], *track
    )
    num = len(noise.reading)
    sums = tracks(np.zeros(num, int), noise)
    host = Host.of(targets)
    likelihood: Any = targets.log_likelihood
    # Of the prior of the factor by which this noise may be off.
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    rate = (scale / noise.reading) ** 2
    weight = (NOISE_SHAPE + 0.5 * sums.num) / (rate + 0.5 * sums.square)
    gradient, matrix = sums.weighed(weight)
    each, z = np.full(num, structure), np.tile(champion, (num, 1))
    gradient, matrix = with_prior(host, each, z, gradient, matrix)
    is_sound = sound(gradient, matrix)
    gradient = np.where(is_sound[:, None], gradient, 0.0)
    matrix = np.where(is_sound[:, None, None], matrix, np.eye(len(champion)))
    return OpenVolumes(
        np.where(is_sound, log_volume(gradient, matrix), -1e30),
        np.diagonal(np.linalg.inv(matrix), axis1=1, axis2=2),
    )


def sound(gradient: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Where an expansion is finite, and its matrix positive definite.

    That of a noise which weighs readings a million times too much is rounded until it
    is not.

    Args:
        gradient: `[point, dim]`.
        matrix: `[point, dim, dim]`.
    """
    is_finite = np.isfinite(gradient.sum(axis=1) + matrix.sum(axis=(1, 2)))
    safe = np.where(is_finite[:, None, None], matrix, np.eye(matrix.shape[-1]))
    # Of the same signs, but of entries that do not differ by many powers of ten.
    scale = np.sqrt(np.abs(np.diagonal(safe, axis1=1, axis2=2)))
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = safe / (scale[:, :, None] * scale[:, None, :])
    return is_finite & (np.linalg.eigvalsh(scaled)[:, 0] > 0.0)


def log_volume(gradient: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """By how much Laplace evidence exceeds the density where it was expanded.

    But for a constant.

    Args:
        gradient: of minus the log-density there, `[point, dim]`.
        matrix: its second derivatives, `[point, dim, dim]`.
    """
    step = np.linalg.solve(matrix, gradient[..., None])[..., 0]
    gain = 0.5 * np.sum(step * gradient, axis=1)
    return gain - 0.5 * np.linalg.slogdet(matrix)[1]
