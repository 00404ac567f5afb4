r"""From draws under a filter with fixed gains to draws with the noise inferred.

Gains that are fixed for a structure make a hypothesis cheap, but they take the ratios
of noises as known. Here each draw (k, z) is given noise $\eta$ from a proposal q that
is fitted to its structure, and all go from

$$p_0 = p_f(k, z \mid h)\,q(\eta \mid k) \quad\text{to}\quad
  p_1 \propto p(k, z)\,p(\eta)\,L(h \mid k, z, \eta)$$

through $p_0^{1-\beta} p_1^\beta$, where p_f is the posterior with fixed gains and L the
marginal likelihood of the extended filter that uses $\eta$. Each step keeps the
effective sample size of its weights at a given share, resamples, and moves coordinates
and noise of every draw by Metropolis steps within its structure (Del Moral, Doucet and
Jasra 2006, Sequential Monte Carlo samplers). Where the fixed gains were right that is
one step. Structures change their probability by the mean weight of their draws.
"""

from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.inference.draw_moves import Proposed, about_means, by_differences
from boomdp_jax.inference.evaluate import evaluate_points, log_prior_density
from boomdp_jax.inference.filter_points import filter_densities
from boomdp_jax.inference.fit import Fits, Host
from boomdp_jax.inference.noise_level import NoiseFit, log_noise_prior
from boomdp_jax.inference.noise_proposal import NoiseProposal
from boomdp_jax.inference.resampling import systematic
from boomdp_jax.inference.structure_evidence import StructureEvidence, reweighed
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.tempered_smc import next_step, times

_KEPT_SHARE = 0.5
_MAX_STEPS = 20
_MOVES_BETWEEN, _LAST_MOVES = 1, 2
# Where the first weights count for this share of the draws one move will do.
_GOOD_SHARE = 0.5
# Kinds of moves, made in turn, and length of steps by differences.
_KINDS = ("mean", "difference")
_STEP_SIZE = 0.4
# Lineages below which draws are moved on, at most so often, until they are less like
# what they were than this; and likeness beyond which a result is doubted.
_FEW_LINEAGES, _MOST_MOVES, _MOST_ALIKE, _TOO_ALIKE = 50.0, 24, 0.5, 0.8
# Share of an object's draws that a structure has to have for that to count.
_COUNTED_SHARE = 0.05
# Distinct draws that are left of all, below which a result is doubted.
_LEAST_LEFT = 0.02


class Corrected(NamedTuple):
    """Draws of equal weight that follow the joint posterior; on the host."""

    structure: np.ndarray
    """`[object, chain, draw]`."""
    z: np.ndarray
    noise: NoiseFit
    """`[object * chain * draw, ...]`."""
    log_density: np.ndarray
    """Of structure, coordinates, noise and readings, `[object, chain, draw]`."""
    evidence: StructureEvidence
    sample_size: np.ndarray
    """Draws that the first weights count for, `[object]`."""
    reasons: list[list[str]]


class _Draws(NamedTuple):
    """A flat list, chain after chain, object after object."""

    structure: np.ndarray
    z: np.ndarray
    vector: np.ndarray
    group: np.ndarray
    log_first: np.ndarray
    log_last: np.ndarray
    root: np.ndarray
    """Which draw it comes from."""

    def take(self, rows: np.ndarray) -> "_Draws":
        """Some of them."""
        return _Draws(*(part[rows] for part in self))

    def where(self, condition: np.ndarray, other: "_Draws") -> "_Draws":
        """Those of this list where a condition holds, else of another."""
        return _Draws(
            *(
                np.where(condition.reshape(-1, *(1 for _ in a.shape[1:])), a, b)
                for a, b in zip(self, other, strict=True)
            )
        )


def infer_noise(
    rng: np.random.Generator,
    targets: StructureTarget,
    start: NoiseFit,
    structure: np.ndarray,
    z: np.ndarray,
    log_density: np.ndarray,
    evidence: StructureEvidence,
) -> Corrected:
    """Take draws under fixed gains to draws with the noise inferred.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        start: noise of every structure of every object, in order.
        structure: of each draw, `[object, chain, draw]`.
        z: coordinates of each.
        log_density: of each, under the targets.
        evidence: of every structure, under the targets.

    Returns:
        As many draws, in chains that never exchange any.
    """
    num_objects, num_chains, num_each = structure.shape
    problem = _Problem(targets, np.repeat(np.arange(num_objects), structure[0].size))
    draws = problem.start(rng, start, structure, z, log_density)
    power, steps = np.zeros(num_objects), 0
    log_share = np.zeros((num_objects, num_chains))
    before = draws.structure
    first_size = np.zeros(num_objects)
    while np.any(power < 1.0) and steps < _MAX_STEPS:
        ratio = _ratio(draws).reshape(num_objects, -1)
        step = np.array(
            [
                next_step(r, 1.0 - b, _KEPT_SHARE)
                for r, b in zip(ratio, power, strict=True)
            ]
        )
        if steps == 0:
            first_size = np.array([_size(each) for each in ratio])
        log_weight = times(step[:, None], ratio).reshape(num_objects, num_chains, -1)
        log_share += np.logaddexp.reduce(log_weight, axis=-1) - np.log(num_each)
        power = np.where(step >= 1.0 - power, 1.0, power + step)
        draws = draws.take(_resample(rng, log_weight))
        steps += 1
        is_last = np.all(power >= 1.0)
        is_easy = steps == 1 and np.all(first_size > _GOOD_SHARE * structure[0].size)
        num_moves = _LAST_MOVES if is_last and not is_easy else _MOVES_BETWEEN
        for number in range(num_moves):
            kind = _KINDS[(steps + number) % len(_KINDS)]
            draws = problem.move(rng, draws, power, kind)
    draws, likeness = problem.spread(rng, draws, power)
    shape = structure.shape
    changed = reweighed(
        evidence,
        before.reshape(shape),
        draws.structure.reshape(shape),
        log_share,
        np.asarray(targets.log_prior, float),
    )
    left = np.array([len(np.unique(r)) for r in draws.root.reshape(num_objects, -1)])
    reasons: list[list[str]] = [[] for _ in range(num_objects)]
    for i in range(num_objects):
        if power[i] < 1.0:
            reasons[i].append(
                f"inferring the noise ended at a power of {power[i]:.3g}, not at 1"
            )
        if likeness[i] > _TOO_ALIKE:
            reasons[i].append(
                f"inferring the noise left few lineages of draws, which {_MOST_MOVES} "
                f"moves did not part: a correlation of {likeness[i]:.2f} with where "
                "they were"
            )
        if left[i] < _LEAST_LEFT * structure[0].size:
            reasons[i].append(
                f"inferring the noise left {left[i]} of {structure[0].size} draws"
            )
    return Corrected(
        structure=draws.structure.reshape(shape),
        z=draws.z.reshape(*shape, -1),
        noise=NoiseFit.of_vector(draws.vector),
        log_density=draws.log_last.reshape(shape),
        evidence=changed,
        sample_size=first_size,
        reasons=reasons,
    )


def noise_about_peaks(
    rng: np.random.Generator,
    targets: StructureTarget,
    start: NoiseFit,
    structure: np.ndarray,
    z: np.ndarray,
    log_density: np.ndarray,
    *,
    is_drawn: bool,
) -> NoiseFit:
    """Noise for draws that are approximate themselves, not weighed by anything.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        start: noise of every structure of every object, in order.
        structure: of each draw, `[object, draw]`.
        z: coordinates of each.
        log_density: of each, under the targets.
        is_drawn: whether noise is drawn, or the most probable one of each structure.

    Returns:
        Noise with leading axis `object * draw`.
    """
    index = np.repeat(np.arange(len(structure)), structure.shape[1])
    flat = z.reshape(len(index), -1).astype(float)
    value = log_density.reshape(-1).astype(float)
    fits = Fits(index, structure.reshape(-1), flat, value, np.zeros((len(index), 0, 0)))
    proposal, group = _fit_proposal(rng, targets, fits, start)
    if not is_drawn:
        return NoiseFit.of_vector(proposal.center[group, 0])
    return NoiseFit.of_vector(proposal.sample(rng, group))


def _fit_proposal(
    rng: np.random.Generator, targets: StructureTarget, draws: Fits, start: NoiseFit
) -> tuple[NoiseProposal, np.ndarray]:
    """Proposals for the structures that draws have, and the group of each draw."""
    name = draws.index * targets.structures.shape[1] + draws.structure
    names, group = np.unique(name, return_inverse=True)
    return NoiseProposal.fit(rng, targets, draws, group, start.take(names)), group


class _Problem:
    """Densities and moves of a list of draws."""

    def __init__(self, targets: StructureTarget, index: np.ndarray):
        likelihood: Any = targets.log_likelihood
        self._targets, self._index = targets, index
        scale = np.asarray(likelihood.coordinates.scales.noise, float)
        self._scale = scale[index]
        self._host = Host.of(targets)
        self._proposal: NoiseProposal

    def start(self, rng, start: NoiseFit, structure, z, log_density) -> _Draws:
        """Draws with noise from the proposals, which are fitted first."""
        structure = structure.reshape(-1)
        z = z.reshape(len(structure), -1).astype(float)
        value = log_density.reshape(-1).astype(float)
        fits = Fits(self._index, structure, z, value, np.zeros((len(z), 0, 0)))
        self._proposal, group = _fit_proposal(rng, self._targets, fits, start)
        vector = self._proposal.sample(rng, group)
        first = value + self._proposal.log_density(vector, group)
        last = self._log_last(structure, z, vector)
        root = np.arange(len(z))
        return _Draws(structure, z, vector, group, first, last, root)

    def move(self, rng, draws: _Draws, power: np.ndarray, kind: str) -> _Draws:
        """One Metropolis step of every draw, along the spread of its group."""
        power = power[self._index]
        proposed = self._propose(rng, draws, kind)
        dim = draws.z.shape[1]
        z, vector = proposed.values[:, :dim], proposed.values[:, dim:]
        last = self._log_last(draws.structure, z, vector)
        first = np.zeros_like(last)
        if np.any(power < 1.0):
            found = evaluate_points(self._targets, self._index, draws.structure, z)
            first = found.log_density
            first = first + self._proposal.log_density(vector, draws.group)
        trial = draws._replace(z=z, vector=vector, log_first=first, log_last=last)
        gain = _tempered(trial, power) - _tempered(draws, power) + proposed.log_ratio
        is_accepted = np.log(rng.random(len(gain))) < gain
        return trial.where(is_accepted, draws)

    def _propose(self, rng, draws: _Draws, kind: str) -> Proposed:
        values = np.concatenate([draws.z, draws.vector], axis=1)
        num_noise = draws.vector.shape[1]
        period = np.concatenate([self._host.period, np.zeros(num_noise)])
        if kind == "mean":
            return about_means(rng, values, draws.group, period)
        num_moved = self._host.in_use.sum(axis=1)[draws.structure] + num_noise
        return by_differences(rng, values, draws.group, period, num_moved, _STEP_SIZE)

    def spread(
        self, rng, draws: _Draws, power: np.ndarray
    ) -> tuple[_Draws, np.ndarray]:
        """Move on the draws of objects of which few lineages are left.

        Draws of one lineage are alike, those of a few cover less than the posterior.
        They are moved until little is left of where they were.

        Returns:
            The draws, and the largest correlation of any number before and after, of
            each object; zero where there was no need.
        """
        likeness = np.zeros(len(power))
        num_objects = len(power)
        size = _lineages(draws.root.reshape(num_objects, -1))
        asked = np.flatnonzero(size < _FEW_LINEAGES)
        if not asked.size:
            return draws, likeness
        rows = np.flatnonzero(np.isin(self._index, asked))
        few, index = draws.take(rows), self._index[rows]
        problem = _Problem(self._targets, index)
        problem._proposal = self._proposal
        begin = here = np.concatenate([few.z, few.vector], axis=1)
        reach = dict.fromkeys(_KINDS, np.inf)
        for number in range(_MOST_MOVES):
            # The kind that goes farther, and now and then the other, which may by now.
            kind = (min if number % 4 == 3 else max)(reach, key=lambda k: reach[k])
            few = problem.move(rng, few, power, kind)
            last, here = here, np.concatenate([few.z, few.vector], axis=1)
            reach[kind] = _reach(last, here)
            for i in asked:
                own = index == i
                likeness[i] = _likeness(begin[own], here[own], few.group[own])
            if np.all(likeness < _MOST_ALIKE):
                break
        joined = [np.array(part) for part in draws]
        for whole, part in zip(joined, few, strict=True):
            whole[rows] = part
        return _Draws(*joined), likeness

    def _log_last(self, structure, z, vector) -> np.ndarray:
        noise = NoiseFit.of_vector(vector)
        value = filter_densities(self._targets, self._index, structure, z, noise)
        value = value + log_prior_density(self._targets, self._index, structure, z)
        return value + log_noise_prior(self._scale, vector)


def _lineages(root: np.ndarray) -> np.ndarray:
    """How many lineages of equal size would be as uneven, `[object]`."""
    counts = [np.unique(each, return_counts=True)[1] for each in root]
    return np.array([num.sum() ** 2 / (num**2).sum() for num in counts], float)


def _reach(before: np.ndarray, after: np.ndarray) -> float:
    """Mean square of a move over the variance, of the middle one of all numbers.

    Zero where no number varies, as with a single draw.
    """
    spread = after.var(axis=0)
    seen = spread > 0
    if not np.any(seen):
        return 0.0
    square = np.mean((after - before)[:, seen] ** 2, axis=0)
    return float(np.median(square / spread[seen]))


def _likeness(before: np.ndarray, after: np.ndarray, group: np.ndarray) -> float:
    """Largest correlation of any number, `[draw, number]` before and after moves.

    Within groups, which moves do not leave; those of a few draws are passed over.
    """
    largest = 0.0
    for name, num in zip(*np.unique(group, return_counts=True), strict=True):
        if num < _COUNTED_SHARE * len(group):
            continue
        a, b = (
            x[group == name] - x[group == name].mean(axis=0) for x in (before, after)
        )
        length = np.sqrt(np.sum(a**2, axis=0) * np.sum(b**2, axis=0))
        seen = length > 0
        each = np.sum(a * b, axis=0)[seen] / length[seen]
        largest = float(np.max(each, initial=largest))
    return largest


def _ratio(draws: _Draws) -> np.ndarray:
    ratio = draws.log_last - draws.log_first
    return np.where(np.isfinite(ratio), ratio, -np.inf)


def _tempered(draws: _Draws, power: np.ndarray) -> np.ndarray:
    first = np.where(power < 1.0, (1.0 - power) * draws.log_first, 0.0)
    value = first + times(power, draws.log_last)
    return np.where(np.isnan(value), -np.inf, value)


def _resample(rng: np.random.Generator, log_weight: np.ndarray) -> np.ndarray:
    """Rows of the chosen draws, chain by chain, in random order."""
    num_objects, num_chains, num = log_weight.shape
    top = log_weight.max(axis=-1, keepdims=True)
    is_lost = ~np.isfinite(top)
    weight = np.where(is_lost, 1.0, np.exp(log_weight - np.where(is_lost, 0.0, top)))
    rows = []
    for i, c in np.ndindex(num_objects, num_chains):
        begin = (i * num_chains + c) * num
        rows.append(begin + rng.permutation(systematic(rng, weight[i, c], num)))
    return np.concatenate(rows)


def _size(log_weight: np.ndarray) -> float:
    """Draws that weights count for."""
    top = log_weight.max()
    if not np.isfinite(top):
        return 0.0
    weight = np.exp(log_weight - top)
    return float(weight.sum() ** 2 / (weight**2).sum())
