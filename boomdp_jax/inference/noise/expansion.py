r"""What each of many noises makes of the hypotheses of a group of draws.

Linearised tracks of each group (`linear_track`) tell of any noise Laplace's mean and
covariance of the coordinates, and how probable it is with those integrated out. One
track is not enough where friction holds and lets go: of a box on a floor, what is known
of the motion's noise below a tenth of its likeliest value was wrong by six nats along
the track of that. So tracks are added where the best fits of likely noises are far from
the others'; and a noise goes by the one whose hypothesis it finds most probable.
"""

from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.inference.fits.fit import Fits, Host, with_prior
from boomdp_jax.inference.fits.fit_noise import climb_noise
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit, log_noise_prior
from boomdp_jax.inference.likelihoods.evaluate import log_prior_density
from boomdp_jax.inference.likelihoods.filter_points import filter_densities
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.linear_track import LinearTracks

# How often the peak of the noise is looked for, iterations of that search, and steps
# to the best fit of a noise, of which the first knows of no width but this.
_NUM_ROUNDS = 2
_NUM_ITERATIONS = 6
_NUM_STEPS, _FIRST_WIDTH = 3, 1e-2
# Tracks of a group, and how far from all of them, in standard deviations, a noise has
# its best fit that gets a further one, if it is so many nats from the likeliest of some
# that are tried.
_MOST_TRACKS, _FAR = 3, 2.0
_LIKELY, _NUM_TRIED, _TRIED_SPREAD = 8.0, 128, 2.0
# Longest shift of a mean, in its own standard deviations: all that is linear ends.
_FARTHEST = 3.0
_SHARES = (1.0, 0.5, 0.25)
# Added to the diagonal of matrices scaled to one there: single precision loses as much.
_RIDGE = 1e-6


class Laplace(NamedTuple):
    """Approximations of a list of noises; tight coordinates in their group's order."""

    mean: np.ndarray
    factor: np.ndarray
    """Lower Cholesky factor of the covariance, `[noise, place, place]`."""
    log_marginal: np.ndarray
    """Of readings and noise with all coordinates integrated out, but for a constant."""


class _Tracks(NamedTuple):
    """Tracks of some groups, a row for each."""

    tracks: LinearTracks
    group: np.ndarray
    """Which groups, in order."""


class _Expanded(NamedTuple):
    """Log-densities about the champions of a list of noises, the priors included."""

    champion: np.ndarray
    value: np.ndarray
    """At the champion; minus infinity where a noise is too far off."""
    gradient: np.ndarray
    """Of minus the log-density."""
    matrix: np.ndarray


class NoiseExpansion:
    """Of the noise of a list of groups, each of one object and structure."""

    def __init__(
        self,
        targets: StructureTarget,
        fits: Fits,
        place: np.ndarray,
        start: NoiseFit,
    ):
        """Find the most probable noise of each group, and its track.

        Args:
            targets: with a `FilteredLikelihood`, stacked along a leading object axis.
            fits: the best fit of each group under fixed gains, precision included.
            place: which coordinates of each group are tight, in the order in which
                they are to be given; `dim` where none is left.
            start: noise of each group, with which those gains were made.
        """
        likelihood: Any = targets.log_likelihood
        self._targets, self._fits, self._place = targets, fits, place
        self._host = Host.of(targets)
        self._scale = np.asarray(likelihood.coordinates.scales.noise, float)
        self._peak, groups = start, np.arange(len(fits.z))
        first = self._along(groups, fits.z, fits.precision, start)
        self._tracks = [_Tracks(first, groups)]
        for _ in range(_NUM_ROUNDS):
            peaks = climb_noise(self, groups, self._peak, _NUM_ITERATIONS)
            self._peak = peaks.noise
            curvature = np.diagonal(peaks.precision, axis1=1, axis2=2)
            self._spread = _TRIED_SPREAD / np.sqrt(curvature)
            champion = self._tracks[0].tracks.champion
            tracks = self._best_fit(groups, champion, self._peak)
            self._tracks = [_Tracks(tracks, groups)]

    @property
    def peak(self) -> NoiseFit:
        """The most probable noise of each group."""
        return self._peak

    def __call__(self, rows: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Log-density of noise with the coordinates integrated out; a `Density`."""
        vector = x.reshape(-1, x.shape[-1])
        found = self.laplace(np.repeat(rows, x.shape[1]), vector)
        return found.log_marginal.reshape(x.shape[:2])

    def reach_out(self, rng: np.random.Generator) -> None:
        """Add tracks where noise has best fits that are far from those of the others.

        Args:
            rng: source of randomness.
        """
        left = np.arange(len(self._fits.z))
        for _ in range(_MOST_TRACKS - 1):
            each = np.repeat(left, _NUM_TRIED)
            vector = self._peak.vector[each]
            size = (len(each), vector.shape[1])
            vector = vector + self._spread[each] * rng.standard_normal(size)
            found = self._expanded(each, vector)
            log_marginal = self._laplace(each, vector, found).log_marginal
            value = log_marginal.reshape(len(left), -1)
            is_likely = value > value.max(axis=1, keepdims=True) - _LIKELY
            _, size, _, _ = _newton(found.matrix, found.gradient, np.inf)
            size = np.where(is_likely, size.reshape(value.shape), 0.0)
            farthest = np.argmax(size, axis=1)
            rows = np.arange(len(left)) * _NUM_TRIED + farthest
            is_far = size.max(axis=1, initial=0.0) > _FAR
            if not np.any(is_far):
                return
            left, rows = left[is_far], rows[is_far]
            noise = NoiseFit.of_vector(vector[rows])
            tracks = self._best_fit(left, found.champion[rows], noise)
            self._tracks.append(_Tracks(tracks, left))

    def laplace(self, group: np.ndarray, vector: np.ndarray) -> Laplace:
        """Approximate the coordinates of groups, with a noise of each.

        Args:
            group: of each noise.
            vector: logarithms of each.
        """
        return self._laplace(group, vector, self._expanded(group, vector))

    def _laplace(
        self, group: np.ndarray, vector: np.ndarray, expanded: _Expanded
    ) -> Laplace:
        index = self._fits.index[group]
        z, value, gradient, matrix = expanded
        mean, factor = self.tight(group, z, gradient, matrix)
        _, size, unit, length = _newton(matrix, gradient)
        value = value + 0.5 * size**2 - np.log(length).sum(axis=1)
        value = value - 0.5 * np.linalg.slogdet(unit)[1]
        return Laplace(
            mean, factor, value + log_noise_prior(self._scale[index], vector)
        )

    def _expanded(self, group: np.ndarray, vector: np.ndarray) -> _Expanded:
        """Along the best track of the group for each noise."""
        noise = NoiseFit.of_vector(vector)
        dim = self._fits.z.shape[1]
        out = _Expanded(
            np.zeros((len(group), dim)),
            np.full(len(group), -np.inf),
            np.zeros((len(group), dim)),
            np.tile(np.eye(dim), (len(group), 1, 1)),
        )
        for tracks, names in self._tracks:
            own = np.flatnonzero(np.isin(group, names))
            if not own.size:
                continue
            row = np.searchsorted(names, group[own])
            here = self._expand(tracks, row, group[own], noise.take(own))
            is_better = here.value > out.value[own]
            for whole, part in zip(out, here, strict=True):
                whole[own[is_better]] = part[is_better]
        return out

    def _expand(
        self, tracks: LinearTracks, row: np.ndarray, group: np.ndarray, noise: NoiseFit
    ) -> _Expanded:
        """Along one track each."""
        structure, index = self._fits.structure[group], self._fits.index[group]
        z = tracks.champion[row]
        sums = tracks(row, noise)
        gradient, matrix = sums.weighed(np.ones_like(sums.square))
        value = sums.log_scale - 0.5 * sums.square.sum(axis=(1, 2))
        is_known = np.isfinite(value + gradient.sum(axis=1) + matrix.sum(axis=(1, 2)))
        gradient = np.where(is_known[:, None], gradient, 0.0)
        matrix = np.where(is_known[:, None, None], matrix, 0.0)
        gradient, matrix = with_prior(self._host, structure, z, gradient, matrix)
        value = value + log_prior_density(self._targets, index, structure, z)
        return _Expanded(z, np.where(is_known, value, -np.inf), gradient, matrix)

    def _along(self, group, z, matrix, noise: NoiseFit) -> LinearTracks:
        index, structure = self._fits.index[group], self._fits.structure[group]
        return LinearTracks.along(self._targets, index, structure, z, matrix, noise)

    def _best_fit(
        self, group: np.ndarray, z: np.ndarray, noise: NoiseFit
    ) -> LinearTracks:
        """Tracks of some groups about the best fits of a noise of each.

        Args:
            group: the groups.
            z: where to start, `[group, dim]`.
            noise: of each.
        """
        index, structure = self._fits.index[group], self._fits.structure[group]
        here, dim = np.arange(len(group)), z.shape[1]
        shares = np.array([0.0, *_SHARES])
        each = np.repeat(here, len(shares))
        matrix = np.tile(np.eye(dim) / _FIRST_WIDTH**2, (len(group), 1, 1))
        for _ in range(_NUM_STEPS):
            tracks = self._along(group, z, matrix, noise)
            found = self._expand(tracks, here, group, noise)
            matrix = found.matrix
            mean, _ = self.tight(group, z, found.gradient, matrix)
            goal = np.pad(z, ((0, 0), (0, 1)))
            goal[here[:, None], self._place[group]] = mean
            tries = z[:, None] + shares[:, None] * (goal[:, :-1] - z)[:, None]
            tries = self._host.wrap(tries.reshape(len(each), -1))
            where = index[each], structure[each], tries
            value = filter_densities(self._targets, *where, noise.take(each))
            value = value + log_prior_density(self._targets, *where)
            choice = np.argmax(value.reshape(len(group), -1), axis=1)
            z = tries.reshape(len(group), len(shares), -1)[here, choice]
        return self._along(group, z, matrix, noise)

    def tight(
        self,
        group: np.ndarray,
        z: np.ndarray,
        gradient: np.ndarray,
        matrix: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and factor of the tight coordinates with the wide ones as they are.

        Args:
            group: of each expansion.
            z: about which it is, `[expansion, dim]`.
            gradient: of minus the log-density there.
            matrix: its second derivatives.

        Returns:
            As `Laplace` has them.
        """
        place, here = self._place[group], np.arange(len(group))[:, None]
        is_tight = place < z.shape[1]
        both = is_tight[:, :, None] & is_tight[:, None, :]
        grown = np.pad(matrix, ((0, 0), (0, 1), (0, 1)))
        small = grown[here[..., None], place[:, :, None], place[:, None, :]]
        small = np.where(both, small, np.eye(place.shape[1])[None])
        slope = np.pad(gradient, ((0, 0), (0, 1)))[here, place]
        step, _, unit, length = _newton(small, np.where(is_tight, slope, 0.0))
        factor = _inverse_factor(unit) / length[:, :, None]
        start = np.pad(z, ((0, 0), (0, 1)))[here, place]
        return np.where(is_tight, start - step, 0.0), factor


def _newton(matrix: np.ndarray, gradient: np.ndarray, most: float = _FARTHEST):
    """Newton's step of each, its length in standard deviations, both limited.

    Args:
        matrix: second derivatives of each.
        gradient: of each.
        most: longest step.

    Returns:
        Steps and lengths, and each matrix scaled to ones on the diagonal, made surely
        positive, by the square roots of what was there.
    """
    length = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    unit = matrix / (length[:, :, None] * length[:, None, :])
    unit = _positive(unit)
    step = np.linalg.solve(unit, (gradient / length)[..., None])[..., 0] / length
    size = np.sqrt(np.maximum(np.sum(step * gradient, axis=1), 0.0))
    short = np.minimum(1.0, most / np.maximum(size, 1e-12))
    return step * short[:, None], size * short, unit, length


def _positive(unit: np.ndarray) -> np.ndarray:
    """Matrices with ones on the diagonal, made positive definite despite rounding."""
    unit = unit + _RIDGE * np.eye(unit.shape[1])
    try:
        np.linalg.cholesky(unit)
    except np.linalg.LinAlgError:
        length, way = np.linalg.eigh(unit)
        length = np.maximum(length, _RIDGE)
        return (way * length[:, None]) @ np.swapaxes(way, 1, 2)
    return unit


def _inverse_factor(matrix: np.ndarray) -> np.ndarray:
    """Lower Cholesky factors of the inverses of matrices.

    Of the matrix with rows and columns the other way round the factor is, the other way
    round again, an upper one, whose inverse transposed is what is asked for. Inverses
    have rounding errors and need not have a factor.
    """
    turned = np.linalg.cholesky(matrix[:, ::-1, ::-1])[:, ::-1, ::-1]
    return np.swapaxes(np.linalg.inv(turned), 1, 2)
