"""Proposals of noise fitted to each structure: a mixture about its peaks.

What a reading scatters by, noise of readings or of the motion may explain, and often
each of them could: the peak with the one is not the only one. Fits therefore start
anew where what a peak says is noise of velocity or spin readings is noise of the
motion, and each peak is covered by a narrow component and by a wide one; a few lie
where noise of one motion is too small to show. Of short
recordings the density is far from normal: draws are weighed a few times over, and a
component takes their mean and spread (adaptive importance sampling, Cappé et al. 2008).
"""

import math
from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.fits.fit import Fits
from boomdp_jax.inference.fits.fit_noise import Density, NoisePeaks, climb_noise
from boomdp_jax.inference.hypotheses.noise_level import NUM_EACH, NoiseFit
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.components import NUM_COMPONENTS, fit_components

# Students' t of so many degrees of freedom; widths in terms of the curvature at the
# peak, and the share of each.
_FREEDOM = 5.0
_WIDTHS, _SHARES = np.array([1.1, 2.5]), np.array([0.75, 0.25])
_NUM_ITERATIONS, _FEW_ITERATIONS = 8, 3
# Readings' noise of a start where the motion's takes over, by the peak's.
_LEFT_TO_READINGS = 0.2
# Rounds of weighing, draws of each, and share of the component that they fit. Its
# spread is a little widened, and above this share of the narrow component's variance.
_NUM_ROUNDS, _NUM_DRAWS, _FITTED_SHARE = 3, 256, 0.6
_WIDER, _LEAST_SPREAD = 1.3, 0.3
# Of what is fitted to many draws: how much wider than they have it, and its share of
# the proposal that it is mixed with.
_LITTLE_WIDER, _LARGE_SHARE = 1.15, 0.75
# Of a fit that begins near a peak.
_FEW_ROUNDS, _FEW_DRAWS = 2, 128
# How far below a peak, and how wide, in logarithms, a component for negligible noise of
# the motion is (the prior's standard deviation), and the share of all these.
_PLATEAU, _PLATEAU_SHARE = 2.0, 0.2
# Least share of a peak, and distance at which two are one, in logarithms.
_LEAST_SHARE, _SAME = 0.1, 0.5


class NoiseProposal(NamedTuple):
    """A mixture of multivariate t of the logarithms of noise for each group of draws.

    A group has the draws of one object and structure.
    """

    log_share: np.ndarray
    """`[group, component]`; minus infinity where a group has fewer."""
    center: np.ndarray
    """`[group, component, number]`."""
    lower: np.ndarray
    """Cholesky factor of the inverse scale matrix, `[group, component, number,
    number]`."""

    @classmethod
    def fit(
        cls,
        rng: np.random.Generator,
        density: Density,
        start: NoiseFit,
        *,
        is_near: bool = False,
    ) -> "NoiseProposal":
        """Cover a density of the noise of every group.

        Args:
            rng: source of randomness.
            density: of the noise of each group.
            start: of each group.
            is_near: whether the start is known to be near a peak, from which the
                others are then looked for at once and not for long.
        """
        num_groups = len(start.reading)
        names = np.arange(num_groups)
        if is_near:
            first, others = _few_peaks(density, start)
        else:
            first = climb_noise(density, names, start, _NUM_ITERATIONS)
            starts = _other_starts(first.noise.vector)
            rows = np.tile(names, len(starts))
            tries = NoiseFit.of_vector(starts.reshape(len(rows), -1))
            others = climb_noise(density, rows, tries, _NUM_ITERATIONS)
        peaks = cls.of_peaks(first, others)
        if not is_near:
            peaks = peaks._with_plateaus()
        proposal, num = peaks, _FEW_DRAWS if is_near else _NUM_DRAWS
        for _ in range(_FEW_ROUNDS if is_near else _NUM_ROUNDS):
            each = np.repeat(names, num)
            vector = proposal.sample(rng, each)
            log_weight = -proposal.log_density(vector, each)
            vector = vector.reshape(num_groups, num, -1)
            log_weight = log_weight.reshape(num_groups, -1) + density(names, vector)
            proposal = peaks.with_fitted(vector, log_weight)
        return proposal

    def with_fitted(
        self, vector: np.ndarray, log_weight: np.ndarray
    ) -> "NoiseProposal":
        """With one component more, fitted to weighed draws of each group.

        Args:
            vector: `[group, draw, number]`.
            log_weight: `[group, draw]`.
        """
        log_weight = np.where(np.isfinite(log_weight), log_weight, -np.inf)
        top = log_weight.max(axis=1, keepdims=True)
        weight = np.exp(log_weight - np.where(np.isfinite(top), top, 0.0))
        weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        mean = np.einsum("gn,gni->gi", weight, vector)
        offset = vector - mean[:, None]
        spread = np.einsum("gn,gni,gnj->gij", weight, offset, offset)
        spread = _WIDER * spread + _LEAST_SPREAD * self._first_spread
        lower = np.linalg.cholesky(np.linalg.inv(spread))
        is_found = np.isfinite(top[:, 0])
        center = np.where(is_found[:, None], mean, self.center[:, 0])
        whole = np.zeros((len(center), 1))
        fitted = NoiseProposal(whole, center[:, None], lower[:, None])
        return self.mixed_with(fitted, np.where(is_found, _FITTED_SHARE, 0.0))

    def refitted(
        self,
        rng: np.random.Generator,
        vector: np.ndarray,
        log_weight: np.ndarray,
        group: np.ndarray,
    ) -> "NoiseProposal":
        """Cover weighed draws, of which some groups may have none.

        Args:
            rng: source of randomness.
            vector: `[draw, number]`.
            log_weight: of each draw.
            group: of each draw.

        Returns:
            For groups with draws of any weight, what is fitted to them, mixed with what
            there was.
        """
        known = np.where(np.isfinite(log_weight), log_weight, -np.inf)
        least, num = self._first_spread, len(self.log_share)
        share = np.zeros(num)
        log_share = np.full((num, NUM_COMPONENTS), -np.log(NUM_COMPONENTS))
        center = np.repeat(self.center[:, :1], NUM_COMPONENTS, axis=1)
        lower = np.repeat(self.lower[:, :1], NUM_COMPONENTS, axis=1)
        for g in np.unique(group[np.isfinite(known)]):
            mine = group == g
            found = fit_components(rng, vector[mine], known[mine], least[g])
            share[g], log_share[g] = _LARGE_SHARE, np.log(found.share)
            center[g] = found.center
            wider = _LITTLE_WIDER * found.covariance
            lower[g] = np.linalg.cholesky(np.linalg.inv(wider))
        return self.mixed_with(NoiseProposal(log_share, center, lower), share)

    def mixed_with(self, other: "NoiseProposal", share: np.ndarray) -> "NoiseProposal":
        """What draws of two proposals follow, put together.

        Args:
            other: of the same groups.
            share: of the draws of each group that are of the other, below one,
                `[group]`.
        """
        share = share[:, None]
        with np.errstate(divide="ignore"):
            theirs = other.log_share + np.log(share)
        log_share = self.log_share + np.log1p(-share), theirs
        return NoiseProposal(
            np.concatenate(log_share, axis=1),
            np.concatenate([self.center, other.center], axis=1),
            np.concatenate([self.lower, other.lower], axis=1),
        )

    def _with_plateaus(self) -> "NoiseProposal":
        """With components for noise of the motion below anything that shows.

        There a density is about as flat as its prior, and may have more than at a
        peak; the other motion's noise then makes up for what this one was.
        """
        size = self.center.shape[-1]
        motion = np.arange(size) % NUM_EACH >= 4
        is_free = motion[:, None] | motion[None]
        flat = np.diag(np.where(motion, _PLATEAU**2, 1.0))
        spread = np.where(is_free, flat, self._first_spread)
        lower = np.linalg.cholesky(np.linalg.inv(spread))
        ways = [(4,), (5,), (4, 5)]
        fall = [_PLATEAU * np.isin(np.arange(size) % NUM_EACH, way) for way in ways]
        center = self.center[:, :1] - np.stack(fall)
        log_share = np.full(center.shape[:2], -np.log(len(ways)))
        lower = np.repeat(lower[:, None], len(ways), axis=1)
        others = NoiseProposal(log_share, center, lower)
        return self.mixed_with(others, np.full(len(center), _PLATEAU_SHARE))

    @property
    def _first_spread(self) -> np.ndarray:
        """Scale matrix of the first component, `[group, number, number]`."""
        first = self.lower[:, 0]
        return np.linalg.inv(first @ np.swapaxes(first, 1, 2))

    @classmethod
    def of_peaks(cls, first: NoisePeaks, others: NoisePeaks) -> "NoiseProposal":
        """Cover peaks, of which some may be the same.

        Args:
            first: one of each group.
            others: further ones, all groups after each other, any number of times.
        """
        num_groups = len(first.log_density)

        def join(one: np.ndarray, more: np.ndarray) -> np.ndarray:
            more = more.reshape(-1, num_groups, *one.shape[1:])
            return np.moveaxis(np.concatenate([one[None], more]), 0, 1)

        center = join(first.noise.vector, others.noise.vector)
        precision = join(first.precision, others.precision)
        value = join(first.log_density, others.log_density)
        lower = np.linalg.cholesky(precision)
        volume = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
        height = np.where(np.isfinite(value), value - volume, -np.inf)
        height[:, 0] = np.where(np.isfinite(height[:, 0]), height[:, 0], 0.0)
        for g, peak in np.ndindex(*height.shape):
            gap = np.abs(center[g, :peak] - center[g, peak]).max(axis=-1)
            if np.any((gap < _SAME) & np.isfinite(height[g, :peak])):
                height[g, peak] = -np.inf
        share = np.exp(height - height.max(axis=1, keepdims=True))
        share = share / share.sum(axis=1, keepdims=True)
        share = np.where(np.isfinite(height), np.maximum(share, _LEAST_SHARE), 0.0)
        share = share / share.sum(axis=1, keepdims=True)
        both = (share[:, :, None] * _SHARES).reshape(num_groups, -1)
        scaled = lower[:, :, None] / _WIDTHS[:, None, None]
        num = len(_WIDTHS)
        with np.errstate(divide="ignore"):
            return cls(
                np.log(both),
                np.repeat(center, num, axis=1),
                scaled.reshape(*both.shape, *lower.shape[-2:]),
            )

    def sample(self, rng: np.random.Generator, group: np.ndarray) -> np.ndarray:
        """Draw for each of a list of groups, `[draw, number]`."""
        cumulative = np.cumsum(np.exp(self.log_share), axis=1)[group]
        uniform = rng.random(len(group))[:, None] * cumulative[:, -1:]
        component = np.sum(cumulative <= uniform, axis=1)
        size = self.center.shape[-1]
        normal = rng.standard_normal((len(group), size))
        stretch = np.sqrt(rng.chisquare(_FREEDOM, len(group)) / _FREEDOM)
        spread = np.linalg.inv(np.swapaxes(self.lower, -1, -2))[group, component]
        offset = np.einsum("nij,nj->ni", spread, normal / stretch[:, None])
        return self.center[group, component] + offset

    def log_density(self, vector: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Of noise `[draw, number]` for each of a list of groups."""
        size = vector.shape[1]
        square = np.empty((len(vector), self.center.shape[1]))
        # Components one by one: factors of all, draw by draw, would be too much.
        for name in np.unique(group):
            rows = np.flatnonzero(group == name)
            mine = vector[rows]
            for c, (center, lower) in enumerate(
                zip(self.center[name], self.lower[name], strict=True)
            ):
                # lower lower^T is the precision.
                square[rows, c] = np.sum(((mine - center) @ lower) ** 2, axis=1)
        volume = np.log(np.diagonal(self.lower, axis1=-2, axis2=-1)).sum(axis=-1)
        half = 0.5 * (_FREEDOM + size)
        constant = math.lgamma(half) - math.lgamma(0.5 * _FREEDOM)
        constant -= 0.5 * size * math.log(_FREEDOM * math.pi)
        each = volume[group] + constant - half * np.log1p(square / _FREEDOM)
        return np.logaddexp.reduce(each + self.log_share[group], axis=1)


def groups_of(targets: StructureTarget, draws: Fits) -> tuple[np.ndarray, np.ndarray]:
    """Groups of draws that share object and structure.

    Returns:
        Place of each group among all structures of all objects, in order, and the group
        of each draw.
    """
    name = draws.index * targets.structures.shape[1] + draws.structure
    names, group = np.unique(name, return_inverse=True)
    return names, group


def best_of_groups(draws: Fits, group: np.ndarray) -> Fits:
    """The draw of the largest log-density of every group.

    Args:
        draws: with their log-densities.
        group: of each draw; every number from zero has some.
    """
    order = np.lexsort((-draws.value, group))
    names = np.arange(group.max() + 1)
    return draws.take(order[np.searchsorted(group[order], names)])


def _few_peaks(density: Density, start: NoiseFit) -> tuple[NoisePeaks, NoisePeaks]:
    """Peaks from starts and from the others about them, all at the same time."""
    num = len(start.reading)
    vector = np.concatenate([start.vector[None], _other_starts(start.vector)])
    rows = np.tile(np.arange(num), len(vector))
    starts = NoiseFit.of_vector(vector.reshape(len(rows), -1))
    found = climb_noise(density, rows, starts, _FEW_ITERATIONS)

    def part(rows: slice) -> NoisePeaks:
        noise = NoiseFit(*(leaf[rows] for leaf in found.noise))
        return NoisePeaks(noise, found.precision[rows], found.log_density[rows])

    return part(slice(0, num)), part(slice(num, None))


def _other_starts(vector: np.ndarray) -> np.ndarray:
    """Velocity noise, spin noise or both handed to the motion, `[way, group, n]`."""
    starts = []
    for channels in ((0,), (1,), (0, 1)):
        moved = vector.reshape(len(vector), -1, NUM_EACH).copy()
        for channel in channels:
            reading = moved[..., 2 + channel].copy()
            moved[..., 4 + channel] = np.maximum(moved[..., 4 + channel], reading)
            moved[..., 2 + channel] = reading + np.log(_LEFT_TO_READINGS)
        starts.append(moved.reshape(vector.shape))
    return np.stack(starts)
