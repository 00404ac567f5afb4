r"""Draws under fixed gains taken to where their noise would have them.

How far and how widely coordinates z are spread depends on the noise $\eta$, and draws
under fixed gains know nothing of it: with six coordinates and a noise of half the size
not one of them in a hundred is any good. What the readings say little of, $z_w$, has a
spread much like the prior's under any noise, and often bends where the others lie, the
tight ones $z_t$. So these are taken to

$$z_t' = r(z_w) + m(\eta) - m_f + C(\eta) C_f^{-1} (z_t - r(z_w)),$$

where r is a regression of the draws' tight coordinates on the wide ones, and $m, C C^T$
are Laplace's mean and covariance of the tight ones given the wide ones at one place,
$m_f, C_f C_f^T$ under the fixed gains, $m(\eta), C(\eta) C(\eta)^T$ under the extended
filter. A draw counts $|C(\eta)| / |C_f|$ times as much. Whatever the approximations,
that is a change of variables and exact. (Parno and Marzouk 2018, Transport map
accelerated Markov chain Monte Carlo, has such triangular maps.)

m and C of any noise come from linearised tracks (`expansion`), and from some
hundred of them the map is learnt as a smooth function. Proposals of noise are fitted to
what is known of it with the coordinates integrated out: at a best fit alone noise looks
too small.
"""

import numpy as np

from boomdp_jax.inference.fits.fit import Fits, Host, climb, normal_equations
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.hypotheses.periods import wrapped
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.draw_ridge import DrawRidge
from boomdp_jax.inference.noise.expansion import Laplace, NoiseExpansion
from boomdp_jax.inference.noise.proposal import NoiseProposal, best_of_groups
from boomdp_jax.inference.noise.regression import NoiseRegression

# Iterations to the peak under fixed gains.
_NUM_CLIMBS = 4
# Coordinates are wide from this share of the prior's standard deviation on.
_WIDE = 0.4
# Draws of the noise of a group from which its map is learnt, but for those so many nats
# less likely than the middle one, and fewest that are enough.
_NUM_LEARNT, _UNLIKELY, _FEWEST = 512, 6.0, 32


class NoiseTransport:
    """Maps of the draws of a list of groups, each of one object and structure."""

    def __init__(
        self,
        rng: np.random.Generator,
        targets: StructureTarget,
        draws: Fits,
        group: np.ndarray,
        start: NoiseFit,
    ):
        """Fit proposals of the noise, and learn the maps.

        Args:
            rng: source of randomness.
            targets: with a `FilteredLikelihood`, stacked along a leading object axis.
            draws: under fixed gains, with their log-densities.
            group: of each draw; every number from zero has some.
            start: noise of each group, with which those gains were made.
        """
        self._host = Host.of(targets)
        best = best_of_groups(draws, group)
        eye = np.eye(best.z.shape[1])
        best = best._replace(precision=np.tile(eye, (len(best.z), 1, 1)))
        fits = climb(targets, best, _NUM_CLIMBS)
        gradient, matrix = normal_equations(targets, self._host, fits)
        fits = fits._replace(precision=matrix)
        is_wide = self._is_wide(draws, group, fits)
        self._place = self._places(is_wide, fits)
        self._ridges = [
            DrawRidge.fit(
                draws.z[group == name],
                self._place[name],
                np.flatnonzero(is_wide[name]),
                fits.z[name],
                self._host.period,
            )
            for name in range(len(fits.z))
        ]
        self._expansion = expansion = NoiseExpansion(targets, fits, self._place, start)
        expansion.reach_out(rng)
        known = np.arange(len(fits.z)), fits.z, gradient, matrix
        center, self._factor = expansion.tight(*known)
        proposal = NoiseProposal.fit(rng, expansion, expansion.peak)
        each = np.repeat(np.arange(len(center)), _NUM_LEARNT)
        vector = proposal.sample(rng, each)
        found = expansion.laplace(each, vector)
        log_weight = found.log_marginal - proposal.log_density(vector, each)
        self._proposal = proposal.refitted(rng, vector, log_weight, each)
        self._maps = self._learnt(center, each, vector, found, log_weight)

    @property
    def proposal(self) -> NoiseProposal:
        """Of the noise of each group."""
        return self._proposal

    def log_marginal(self, vector: np.ndarray, group: np.ndarray) -> np.ndarray:
        """About how probable noises are, but for a constant of each group.

        Args:
            vector: logarithms of each.
            group: of each.
        """
        return self._expansion.laplace(group, vector).log_marginal

    def move(
        self, group: np.ndarray, z: np.ndarray, vector: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take draws to where their noise would have them.

        Args:
            group: of each draw.
            z: coordinates of each under fixed gains.
            vector: logarithms of the noise of each.

        Returns:
            Coordinates, and the logarithms of the volume that each unit of volume
            becomes.
        """
        place, here = self._place[group], np.arange(len(z))[:, None]
        num = place.shape[1]
        padded = np.pad(z, ((0, 0), (0, 1)))
        ridge, value = np.empty(place.shape), np.empty((len(z), num * (num + 3) // 2))
        for name in np.unique(group):
            own = group == name
            ridge[own] = self._ridges[name](z[own])
            value[own] = self._maps[name](vector[own])
        shift, diagonal, below = np.split(value, [num, 2 * num], axis=1)
        stretch = np.zeros((len(z), num, num))
        stretch[:, *np.diag_indices(num)] = np.exp(diagonal)
        stretch[:, *np.tril_indices(num, -1)] = below
        period = np.pad(self._host.period, (0, 1))[place]
        offset = wrapped(padded[here, place] - ridge, period)
        factor = self._factor[group]
        white = np.linalg.solve(factor, offset[..., None])
        white = shift[..., None] + stretch @ white
        moved = ridge + (factor @ white)[..., 0]
        padded[here, place] = np.where(place < z.shape[1], moved, 0.0)
        return self._host.wrap(padded[:, :-1]), diagonal.sum(axis=1)

    def _learnt(
        self,
        center: np.ndarray,
        each: np.ndarray,
        vector: np.ndarray,
        found: Laplace,
        log_weight: np.ndarray,
    ) -> list[NoiseRegression]:
        """The map of each group as a function of its noise.

        Args:
            center: mean of the tight coordinates of each group under fixed gains.
            each: groups of noises, `_NUM_LEARNT` of each, one after the other.
            vector: logarithms of each noise.
            found: what each makes of its group.
            log_weight: of each.
        """
        factor = self._factor[each]
        shift = np.linalg.solve(factor, (found.mean - center[each])[..., None])
        stretch = np.linalg.solve(factor, found.factor)
        diagonal = np.log(np.diagonal(stretch, axis1=1, axis2=2))
        below = stretch[:, *np.tril_indices(factor.shape[1], -1)]
        value = np.concatenate([shift[..., 0], diagonal, below], axis=1)
        maps = []
        for rows in np.arange(len(each)).reshape(-1, _NUM_LEARNT):
            is_likely = log_weight[rows] > np.median(log_weight[rows]) - _UNLIKELY
            if is_likely.sum() < _FEWEST:
                # Nothing is known: a map that leaves draws where they are.
                maps.append(
                    NoiseRegression.fit(vector[rows], np.zeros(value[rows].shape))
                )
            else:
                rows = rows[is_likely]
                maps.append(NoiseRegression.fit(vector[rows], value[rows]))
        return maps

    def _is_wide(self, draws: Fits, group: np.ndarray, fits: Fits) -> np.ndarray:
        """Which coordinates of each group the readings say little of."""
        host = self._host
        prior = np.where(host.period > 0, host.period / np.sqrt(12.0), 1.0)
        width = 1.0 / np.sqrt(np.diagonal(fits.precision, axis1=1, axis2=2))
        for name, center in enumerate(fits.z):
            spread = host.wrap(draws.z[group == name] - center[None]).std(axis=0)
            width[name] = np.maximum(width[name], spread)
        return host.in_use[fits.structure] & (width > _WIDE * prior)

    def _places(self, is_wide: np.ndarray, fits: Fits) -> np.ndarray:
        """Tight coordinates, the widest first; `dim` where none is left."""
        dim = fits.z.shape[1]
        width = 1.0 / np.sqrt(np.diagonal(fits.precision, axis1=1, axis2=2))
        is_tight = self._host.in_use[fits.structure] & ~is_wide
        order = np.argsort(np.where(is_tight, -width, np.inf), axis=1)
        order = order[:, : max(int(is_tight.sum(axis=1).max()), 1)]
        return np.where(np.take_along_axis(is_tight, order, axis=1), order, dim)
