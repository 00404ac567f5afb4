r"""From draws under a filter with fixed gains to draws with the noise inferred.

Gains that are fixed for a structure make a hypothesis cheap, but they take the ratios
of noises as known. Here each draw (k, z) is given noise $\eta$ from a proposal q that
is fitted to its structure and taken to $T_\eta(z)$, about where that noise has it
(`transport`), and all go from

$$p_0 = p_f(k, z \mid h)\,q(\eta \mid k) \quad\text{to}\quad
  p_1 \propto p(k, z')\,p(\eta)\,L(h \mid k, z', \eta)
  \left|\frac{\partial z'}{\partial z}\right|, \quad z' = T_\eta(z),$$

through $p_0^{1-\beta} p_1^\beta$, where p_f is the posterior with fixed gains and L the
marginal likelihood of the extended filter that uses $\eta$. Each step keeps the
effective sample size of its weights at a given share, resamples, and moves coordinates
and noise of every draw by Metropolis steps within its structure (Del Moral, Doucet and
Jasra 2006, Sequential Monte Carlo samplers). Where the fixed gains were right that is
one step; where they were far off the first one chooses among several noises for each
draw (`steps`). Structures change their probability by the mean weight of their
draws.

Where few lineages are left, their draws are moved on until they are worth enough
independent ones (`lineages`).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.fits.fit import Fits
from boomdp_jax.inference.fits.fit_noise import NoiseDensity
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.lineages import worth_of_draws
from boomdp_jax.inference.noise.moves import MoveKinds
from boomdp_jax.inference.noise.problem import NoiseDraws, NoiseProblem
from boomdp_jax.inference.noise.proposal import NoiseProposal, best_of_groups, groups_of
from boomdp_jax.inference.noise.steps import first_step, further_step
from boomdp_jax.inference.samplers.structure_evidence import (
    StructureEvidence,
    reweighed,
)

_MAX_STEPS = 20
_MOVES_BETWEEN, _LAST_MOVES = 1, 2
# Where the first weights count for this share of the draws one move will do.
_GOOD_SHARE = 0.5
# Independent draws that those of an object are to be worth, at most and as a share:
# they are moved on until they are, or so often. What is worth far less is doubted.
_ENOUGH, _ENOUGH_SHARE, _MOST_MOVES = 100.0, 0.05, 24
_TOO_FEW, _TOO_FEW_SHARE = 30.0, 0.015
# Distinct draws that are left of all, below which a result is doubted.
_LEAST_LEFT = 0.02
_STAGE = "inferring the noise"


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
    reasons: list[list[str]]


def infer_noise(
    rng: np.random.Generator,
    targets: StructureTarget,
    start: NoiseFit,
    structure: np.ndarray,
    z: np.ndarray,
    log_density: np.ndarray,
    evidence: StructureEvidence,
    report: Callable[[str], None] = lambda stage: None,
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
        report: called with how far it is before each resampling and each move.

    Returns:
        As many draws, in chains that never exchange any.
    """
    num_objects, num_chains, _ = structure.shape
    index = np.repeat(np.arange(num_objects), structure[0].size)
    problem, draws = NoiseProblem.start(
        rng, targets, index, _as_fits(index, structure, z, log_density), start
    )
    power, steps = np.zeros(num_objects), 0
    log_share = np.zeros((num_objects, num_chains))
    before = draws.structure
    is_good = np.zeros(num_objects, bool)
    kinds = MoveKinds(problem.num_groups)
    while steps == 0 or (np.any(power < 1.0) and steps < _MAX_STEPS):
        is_under_way = power < 1.0
        report(f"{_STAGE}, step {steps + 1}, power {power.min():.2g}")
        if steps == 0:
            known = problem, draws, index, num_chains
            found, size, problem = first_step(rng, *known)
            is_good = size > _GOOD_SHARE * structure[0].size
        else:
            found = further_step(rng, draws, power, num_chains)
        draws = found.draws
        log_share += found.log_mean
        power = np.where(found.step >= 1.0 - power, 1.0, power + found.step)
        steps += 1
        is_easy = (steps == 1) & is_good
        num_moves = np.where((power >= 1.0) & ~is_easy, _LAST_MOVES, _MOVES_BETWEEN)
        num_moves = np.where(is_under_way, num_moves, 0)
        for number in range(num_moves.max()):
            report(
                f"{_STAGE}, step {steps}, power {power.min():.2g}, "
                f"move {number + 1} of {num_moves.max()}"
            )
            rows = np.flatnonzero((number < num_moves)[index])
            draws = _moved(rng, problem, draws, rows, power, kinds)
    draws, worth = _spread(rng, problem, draws, index, power, kinds, report)
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
        too_few = min(_TOO_FEW, _TOO_FEW_SHARE * structure[0].size)
        if worth[i] < too_few:
            reasons[i].append(
                f"inferring the noise left draws that are worth {worth[i]:.0f} "
                f"independent ones, below {too_few:.0f}, after {_MOST_MOVES} moves"
            )
        if left[i] < _LEAST_LEFT * structure[0].size:
            reasons[i].append(
                f"inferring the noise left {left[i]} of {structure[0].size} draws"
            )
    return Corrected(
        structure=draws.structure.reshape(shape),
        z=draws.moved.reshape(*shape, -1),
        noise=NoiseFit.of_vector(draws.vector),
        log_density=(draws.log_last - draws.log_volume).reshape(shape),
        evidence=changed,
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
    fits = _as_fits(index, structure, z, log_density)
    names, group = groups_of(targets, fits)
    density = NoiseDensity(targets, best_of_groups(fits, group))
    proposal = NoiseProposal.fit(rng, density, start.take(names))
    if not is_drawn:
        return NoiseFit.of_vector(proposal.center[group, 0])
    return NoiseFit.of_vector(proposal.sample(rng, group))


def _as_fits(
    index: np.ndarray, structure: np.ndarray, z: np.ndarray, log_density: np.ndarray
) -> Fits:
    """Draws of any leading axes as one list."""
    return Fits(
        index,
        structure.reshape(-1),
        z.reshape(len(index), -1).astype(float),
        log_density.reshape(-1).astype(float),
        np.zeros((len(index), 0, 0)),
    )


def _spread(
    rng: np.random.Generator,
    problem: NoiseProblem,
    draws: NoiseDraws,
    index: np.ndarray,
    power: np.ndarray,
    kinds: MoveKinds,
    report: Callable[[str], None],
) -> tuple[NoiseDraws, np.ndarray]:
    """Move on the draws of objects that are worth too few independent ones.

    Args:
        rng: source of randomness.
        problem: of the draws.
        draws: the list.
        index: object of each draw.
        power: of each object.
        kinds: of moves.
        report: called with how far it is before each move.

    Returns:
        The draws, and what those of each object are worth.
    """
    worth = np.zeros(len(power))
    asked = np.arange(len(power))
    enough = min(_ENOUGH, _ENOUGH_SHARE * len(index) / len(power))
    for number in range(_MOST_MOVES + 1):
        offset = problem.offsets(draws)
        for i in asked:
            mine = index == i
            worth[i] = worth_of_draws(
                *(part[mine] for part in (draws.values, offset)),
                *(draws.root[mine], draws.group[mine]),
            )
        asked = np.flatnonzero(worth < enough)
        if not asked.size or number == _MOST_MOVES:
            break
        report(f"{_STAGE}, move {number + 1} of at most {_MOST_MOVES}")
        rows = np.flatnonzero(np.isin(index, asked))
        draws = _moved(rng, problem, draws, rows, power, kinds)
    return draws, worth


def _moved(
    rng: np.random.Generator,
    problem: NoiseProblem,
    draws: NoiseDraws,
    rows: np.ndarray,
    power: np.ndarray,
    kinds: MoveKinds,
) -> NoiseDraws:
    """One move of some of the draws, of the kind that suits their groups."""
    some = draws.take(rows)
    chosen = kinds.choose(some.values, some.group)
    after = problem.only(rows).move(rng, some, power, chosen)
    kinds.learn(chosen, some.values, after.values, some.group)
    joined = [np.array(part) for part in draws]
    for whole, part in zip(joined, after, strict=True):
        whole[rows] = part
    return NoiseDraws(*joined)
