r"""Draws on their way from fixed gains to noise of their own: densities and moves.

A draw is a structure, coordinates z as the fixed gains have them, and noise $\eta$;
what it stands for is the hypothesis $T_\eta(z)$ (`transport`). A structure whose
map makes the weights of a few draws more uneven instead, as with several modes far from
each other, does without.
"""

from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.inference.fits.fit import Fits, Host
from boomdp_jax.inference.fits.fit_noise import NoiseDensity
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit, log_noise_prior
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points, log_prior_density
from boomdp_jax.inference.likelihoods.filter_points import filter_densities
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.proposal import NoiseProposal, best_of_groups, groups_of
from boomdp_jax.inference.noise.rounds import NoiseRounds
from boomdp_jax.inference.noise.transport import NoiseTransport
from boomdp_jax.inference.samplers.draw_moves import (
    Proposed,
    about_means,
    by_differences,
    from_means,
)
from boomdp_jax.inference.samplers.tempered_smc import times

# Length of steps by differences.
_STEP_SIZE = 0.4
# Draws of each group with which maps are tried.
_NUM_TRIED = 64


class NoiseDraws(NamedTuple):
    """A flat list, chain after chain, object after object."""

    structure: np.ndarray
    z: np.ndarray
    """Coordinates as the fixed gains have them, `[draw, dim]`."""
    moved: np.ndarray
    """Coordinates of the hypothesis, `[draw, dim]`."""
    vector: np.ndarray
    """Logarithms of the noise, `[draw, number]`."""
    group: np.ndarray
    log_first: np.ndarray
    log_last: np.ndarray
    """Of structure, coordinates, noise and readings, times `exp(log_volume)`."""
    log_volume: np.ndarray
    """Of what a unit of volume in z becomes."""
    root: np.ndarray
    """Which draw it comes from."""
    family: np.ndarray
    """Which draw it was copied from since it moved about a mean."""

    @property
    def ratio(self) -> np.ndarray:
        """By how much the last density exceeds the first; of logarithms."""
        ratio = self.log_last - self.log_first
        return np.where(np.isfinite(ratio), ratio, -np.inf)

    @property
    def values(self) -> np.ndarray:
        """All that a move changes, `[draw, number]`."""
        return np.concatenate([self.z, self.vector], axis=1)

    def take(self, rows: np.ndarray) -> "NoiseDraws":
        """Some of them."""
        return NoiseDraws(*(part[rows] for part in self))

    def where(self, condition: np.ndarray, other: "NoiseDraws") -> "NoiseDraws":
        """Those of this list where a condition holds, else of another."""
        return NoiseDraws(
            *(
                np.where(condition.reshape(-1, *(1 for _ in a.shape[1:])), a, b)
                for a, b in zip(self, other, strict=True)
            )
        )


class NoiseProblem:
    """Densities and moves of a list of draws."""

    def __init__(
        self,
        targets: StructureTarget,
        index: np.ndarray,
        rounds: NoiseRounds,
        transport: NoiseTransport | None,
        is_moved: np.ndarray,
    ):
        """Keep what is known of the groups.

        Args:
            targets: stacked along a leading object axis.
            index: object of each draw.
            rounds: proposals of the noise of each group.
            transport: of each group; None: no group has any.
            is_moved: whether a group makes use of it.
        """
        likelihood: Any = targets.log_likelihood
        self._targets, self._index = targets, index
        scale = np.asarray(likelihood.coordinates.scales.noise, float)
        self._scale = scale[index]
        self._host = Host.of(targets)
        self._rounds, self._transport = rounds, transport
        self._is_moved = is_moved

    @classmethod
    def start(
        cls,
        rng: np.random.Generator,
        targets: StructureTarget,
        index: np.ndarray,
        draws: Fits,
        start: NoiseFit,
    ) -> tuple["NoiseProblem", NoiseDraws]:
        """Fit maps and proposals, and give every draw its noise.

        Args:
            rng: source of randomness.
            targets: stacked along a leading object axis.
            index: object of each draw.
            draws: under fixed gains, with their log-densities.
            start: noise of every structure of every object, with which the gains were
                made, in order.
        """
        names, group = groups_of(targets, draws)
        begin = start.take(names)
        likelihood: Any = targets.log_likelihood
        if likelihood.data.freedom is None:
            transport = NoiseTransport(rng, targets, draws, group, begin)
            proposal = transport.proposal
        else:
            # Linearised tracks know of normal noise only.
            transport = None
            density = NoiseDensity(targets, best_of_groups(draws, group))
            proposal = NoiseProposal.fit(rng, density, begin)
        vector = proposal.sample(rng, group)
        rounds = NoiseRounds.of(proposal)
        is_moved = np.zeros(len(names), bool)
        if transport is not None:
            rows = _some_of_each(rng, group)
            # How good noises are is the same in both, and would hide the difference.
            noise = vector[rows], group[rows]
            known = transport.log_marginal(*noise) - proposal.log_density(*noise)
            known = np.where(np.isfinite(known), known, 0.0)
            sizes = []
            for choice in (is_moved, ~is_moved):
                tried = cls(targets, index, rounds, transport, choice)
                found = tried._given(draws, vector, group, rows)
                sizes.append(_sizes(found.ratio - known, group[rows]))
            plain, moved = sizes
            is_moved = moved >= plain
        problem = cls(targets, index, rounds, transport, is_moved)
        return problem, problem._given(draws, vector, group, np.arange(len(group)))

    @property
    def num_groups(self) -> int:
        """Groups of draws there are."""
        return len(self._is_moved)

    def offsets(self, draws: NoiseDraws) -> np.ndarray:
        """By how much what moves change differs from the mean of the group."""
        return from_means(draws.values, draws.group, self._period(draws))

    def only(self, rows: np.ndarray) -> "NoiseProblem":
        """The same for some of the draws."""
        return NoiseProblem(
            self._targets,
            self._index[rows],
            self._rounds,
            self._transport,
            self._is_moved,
        )

    def with_further_round(
        self, rng: np.random.Generator, draws: NoiseDraws
    ) -> "NoiseProblem":
        """The same with a proposal more, fitted to draws of some groups.

        Args:
            rng: source of randomness.
            draws: with all the noises that these were given.
        """
        known = draws.vector, draws.ratio, draws.group
        return NoiseProblem(
            self._targets,
            self._index,
            self._rounds.further(rng, *known),
            self._transport,
            self._is_moved,
        )

    def of_rounds(self, draws: NoiseDraws, before: "NoiseProblem") -> NoiseDraws:
        """Draws of an earlier round as what all rounds make of them.

        Args:
            draws: the list, none of which has moved.
            before: what they were given their noise by.
        """
        known = draws.vector, draws.group
        gain = self._log_proposal(*known) - before._log_proposal(*known)
        return draws._replace(log_first=draws.log_first + gain)

    def move(
        self,
        rng: np.random.Generator,
        draws: NoiseDraws,
        power: np.ndarray,
        is_about_mean: np.ndarray,
    ) -> NoiseDraws:
        """One Metropolis step of every draw, along the spread of its group.

        Args:
            rng: source of randomness.
            draws: the list.
            power: how far from the first density to the last, of each object.
            is_about_mean: of which of the two kinds (`draw_moves`) the move of each
                group is.
        """
        power = power[self._index]
        proposed = self._propose(rng, draws, is_about_mean[draws.group])
        dim = draws.z.shape[1]
        z, vector = proposed.values[:, :dim], proposed.values[:, dim:]
        trial = self._with_last(draws._replace(z=z, vector=vector))
        alone = draws.family.max(initial=0) + 1 + np.arange(len(z))
        # Draws for which there were too few others stay, and are copies still.
        has_moved = np.any(proposed.values != draws.values, axis=1)
        is_far = is_about_mean[draws.group] & has_moved
        trial = trial._replace(family=np.where(is_far, alone, draws.family))
        first = np.zeros_like(trial.log_last)
        if np.any(power < 1.0):
            found = evaluate_points(self._targets, self._index, draws.structure, z)
            first = found.log_density
            first = first + self._log_proposal(vector, draws.group)
        trial = trial._replace(log_first=first)
        gain = _tempered(trial, power) - _tempered(draws, power) + proposed.log_ratio
        is_accepted = np.log(rng.random(len(gain))) < gain
        return trial.where(is_accepted, draws)

    def with_other_noise(
        self, rng: np.random.Generator, draws: NoiseDraws
    ) -> NoiseDraws:
        """The same draws under fixed gains, of the same lineages, with other noise.

        Args:
            rng: source of randomness.
            draws: the list, none of which has moved.
        """
        vector = self._rounds.latest.sample(rng, draws.group)
        first = draws.log_first - self._log_proposal(draws.vector, draws.group)
        first = first + self._log_proposal(vector, draws.group)
        return self._with_last(draws._replace(vector=vector, log_first=first))

    def _given(
        self, draws: Fits, vector: np.ndarray, group: np.ndarray, rows: np.ndarray
    ) -> NoiseDraws:
        """Some draws with noise given them."""
        vector, group, draws = vector[rows], group[rows], draws.take(rows)
        none = np.zeros(len(rows))
        first = draws.value + self._log_proposal(vector, group)
        z = draws.z.astype(float)
        fresh = NoiseDraws(
            draws.structure, z, z, vector, group, first, none, none, rows, rows
        )
        return self.only(rows)._with_last(fresh)

    def _log_proposal(self, vector: np.ndarray, group: np.ndarray) -> np.ndarray:
        return self._rounds.whole.log_density(vector, group)

    def _with_last(self, draws: NoiseDraws) -> NoiseDraws:
        """With what follows from structure, coordinates and noise."""
        z, log_volume = draws.z, np.zeros(len(draws.z))
        rows = np.flatnonzero(self._is_moved[draws.group])
        if self._transport is not None and rows.size:
            z = z.copy()
            z[rows], log_volume[rows] = self._transport.move(
                draws.group[rows], draws.z[rows], draws.vector[rows]
            )
        noise = NoiseFit.of_vector(draws.vector)
        known = self._targets, self._index, draws.structure, z
        value = filter_densities(*known, noise) + log_prior_density(*known)
        value = value + log_noise_prior(self._scale, draws.vector) + log_volume
        return draws._replace(moved=z, log_last=value, log_volume=log_volume)

    def _propose(self, rng, draws: NoiseDraws, is_about_mean: np.ndarray) -> Proposed:
        values, period, group = draws.values, self._period(draws), draws.group
        num_moved = self._host.in_use.sum(axis=1)[draws.structure]
        num_moved = num_moved + draws.vector.shape[1]
        near = by_differences(rng, values, group, period, num_moved, _STEP_SIZE)
        if not np.any(is_about_mean):
            return near
        far = about_means(rng, values, group, period, draws.family)
        return Proposed(
            np.where(is_about_mean[:, None], far.values, near.values),
            np.where(is_about_mean, far.log_ratio, near.log_ratio),
        )

    def _period(self, draws: NoiseDraws) -> np.ndarray:
        return np.concatenate([self._host.period, np.zeros(draws.vector.shape[1])])


def effective_size(log_weight: np.ndarray) -> float:
    """Draws that weights count for."""
    top = log_weight.max()
    if not np.isfinite(top):
        return 0.0
    weight = np.exp(log_weight - top)
    return float(weight.sum() ** 2 / (weight**2).sum())


def _sizes(log_weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Effective sizes of groups, `[group]`; every number from zero has some draws."""
    names = range(group.max() + 1)
    return np.array([effective_size(log_weight[group == name]) for name in names])


def _some_of_each(rng: np.random.Generator, group: np.ndarray) -> np.ndarray:
    """Rows of a few draws of every group, picked at random."""
    mixed = rng.permutation(len(group))
    order = mixed[np.argsort(group[mixed], kind="stable")]
    begin = np.searchsorted(group[order], group[order])
    return order[np.arange(len(order)) - begin < _NUM_TRIED]


def _tempered(draws: NoiseDraws, power: np.ndarray) -> np.ndarray:
    first = np.where(power < 1.0, (1.0 - power) * draws.log_first, 0.0)
    value = first + times(power, draws.log_last)
    return np.where(np.isnan(value), -np.inf, value)
