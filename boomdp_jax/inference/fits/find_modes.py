"""Modes of every structure of noisy recordings, and the filter that they belong to.

A filter's gains follow from a hypothesis and from the noise; the best hypothesis
follows from the gains. So: fit single steps; then, a few times over, fit the noise at
the best hypothesis, give every structure the gains of its own best fit, and fit again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.fits.fit import (
    Fits,
    FitSettings,
    Modes,
    best_of_each,
    climb,
    collect_modes,
    join_fits,
    make_fits,
)
from boomdp_jax.inference.fits.fit_noise import (
    Density,
    NoiseDensity,
    NoisePeaks,
    fit_noise,
    with_gains,
)
from boomdp_jax.inference.fits.fit_search import search_further
from boomdp_jax.inference.fits.fit_starts import Guesses, first_fits, grown_fits
from boomdp_jax.inference.fits.floor_starts import with_other_floors
from boomdp_jax.inference.fits.read_velocities import with_read_velocities
from boomdp_jax.inference.hypotheses.noise_level import NUM_EACH, NoiseFit
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from boomdp_jax.inference.likelihoods.exact_starts import ExactStarts, with_open_loop
from boomdp_jax.inference.likelihoods.target import StructureTarget

# Rounds of noise, gains and fit, at least and at most: until no structure that may
# count gains so much by noise of where its fit is now. With poses alone first fits are
# poor, and what they miss passes for noise of the motion. Two structures of one motion
# (a pin's friction, and a wheel's) were told apart by six nats after two rounds, which
# nothing later mends, as the one got no draws; after three by a tenth.
_FEWEST_ROUNDS, _MOST_ROUNDS = 2, 6
_SETTLED, _MAY_COUNT = 0.5, 20.0
# Noise starts too high rather than too low: readings at so many times the residuals of
# single steps, impulses at those residuals.
_START_NOISE = 3.0
# Structures of a lone body whose noise is fitted, the most probable ones; the work
# grows with the square of the number of channels.
_MOST_FITTED = 8
# So many nats below the best a structure is out of the question.
_HOPELESS = 40.0
# So many nats for each reading below the best single steps of another, a structure gets
# no filter of its own. Where one is wrong, noise of starts may pass for what it lacks:
# a velocity whose readings are all noise is best predicted by none, which gains half of
# the logarithm of two for each.
_LACK = 0.5
# Sds by which gains take the motion's noise to be above its peak.
_WIDENING = 1.0
# Shares of that which are tried.
_SHARES = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0)


class Found(NamedTuple):
    """Modes, and the targets whose modes they are."""

    targets: StructureTarget
    modes: Modes
    noise: NoiseFit
    """Of every structure of every object, in order."""


def find_modes(
    key: Key,
    targets: StructureTarget,
    settings: FitSettings,
    report: Callable[[str], None] = lambda stage: None,
) -> Found:
    """Fit every structure of many objects; keep distinct optima.

    Args:
        key: source of starts.
        targets: with the one-step gains that `make_block` sets, stacked along a leading
            object axis.
        settings: how hard to look.
        report: called with the name of each stage as it begins.

    Returns:
        Targets with the gains of filters, and up to `num_modes` modes per structure.
    """
    num_structures = targets.structures.shape[1]
    rng = host_generator(key)
    single = with_read_velocities(targets)
    guesses = Guesses.of(single)
    report("fitting single steps")
    fits, lack = _single_step_fits(rng, single, guesses, settings)
    noise = _first_noise(single, best_of_each(fits, num_structures, 1))
    is_open = np.ones(len(targets.structures), bool)
    for number in range(_MOST_ROUNDS):
        report(f"fitting noise and filters, round {number + 1}")
        top = best_of_each(fits, num_structures, 1)
        found = _noise_of_structures(targets, top, noise, number > 0, is_open)
        if number >= _FEWEST_ROUNDS:
            is_open &= found.gain > _SETTLED
            if not is_open.any():
                break
        rows = np.repeat(is_open, num_structures)
        noise = found.noise.where(rows, noise)
        targets = with_gains(targets, top.take(rows), noise.take(rows))
        mine = is_open[fits.index]
        again = make_fits(
            targets, *(part[mine] for part in (fits.index, fits.structure, fits.z))
        )
        again = best_of_each(again, num_structures, settings.num_starts)
        if number == 0:
            fits = _climbed(rng, targets, guesses, again, settings, lack)
            continue
        # Gains have changed a little, and what there is to find has been found.
        again = climb(targets, again, settings.num_repeats, lack)
        again = with_other_floors(targets, again)
        fits = join_fits(fits.take(~mine), again)
    modes = collect_modes(targets, fits, settings.num_modes, lack)
    return Found(targets, modes, noise)


def find_single_step_modes(
    key: Key, targets: StructureTarget, settings: FitSettings
) -> Modes:
    """Fit every structure by its one-step likelihood alone, as equation 1 has it.

    Args:
        key: source of starts.
        targets: as for `find_modes`.
        settings: how hard to look.

    Returns:
        Up to `num_modes` modes per structure and object.
    """
    rng = host_generator(key)
    fits, lack = _single_step_fits(rng, targets, Guesses.of(targets), settings)
    return collect_modes(targets, fits, settings.num_modes, lack)


def find_modes_of_exact_starts(
    key: Key,
    targets: StructureTarget,
    starts: ExactStarts,
    settings: FitSettings,
    report: Callable[[str], None] = lambda stage: None,
) -> tuple[StructureTarget, Modes]:
    """Fit every structure by predictions that start from readings as if exact.

    Long predictions have many local optima: they are climbed from where single steps
    have led.

    Args:
        key: source of starts.
        targets: as for `find_modes`.
        starts: where predictions start.
        settings: how hard to look.
        report: called with the name of each stage as it begins.

    Returns:
        Targets with the gains of such predictions, and up to `num_modes` modes per
        structure and object.
    """
    rng = host_generator(key)
    guesses = Guesses.of(targets)
    report("fitting single steps")
    fits, lack = _single_step_fits(rng, targets, guesses, settings)
    if starts.horizon != 1:
        report("fitting open loops")
        targets = with_open_loop(targets, starts)
        again = make_fits(targets, fits.index, fits.structure, fits.z)
        fits = _climbed(rng, targets, guesses, again, settings, lack)
    return targets, collect_modes(targets, fits, settings.num_modes, lack)


def _single_step_fits(
    rng: np.random.Generator,
    targets: StructureTarget,
    guesses: Guesses,
    settings: FitSettings,
) -> tuple[Fits, np.ndarray]:
    """Fits from anywhere, and how much below the best of an object is worth a filter.

    Structures that lack more keep the fits that they have got.
    """
    starts = first_fits(rng, targets, guesses, settings)
    likelihood: Any = targets.log_likelihood
    num = np.asarray(likelihood.data.steps.mask).sum(axis=(1, 2, 3))
    lack = np.maximum(_LACK * num, _HOPELESS)
    fits = _climbed(rng, targets, guesses, starts, settings, lack, from_anywhere=True)
    return search_further(rng, targets, guesses, fits, settings, lack), lack


def _climbed(
    rng: np.random.Generator,
    targets: StructureTarget,
    guesses: Guesses,
    starts: Fits,
    settings: FitSettings,
    lack: np.ndarray,
    *,
    from_anywhere: bool = False,
) -> Fits:
    """Climb, and again from what was found of smaller structures."""
    num = settings.num_iterations
    fits = climb(targets, starts, num, lack, from_anywhere=from_anywhere)
    grown = grown_fits(rng, targets, guesses, fits, settings, lack)
    fits = join_fits(fits, climb(targets, grown, num, lack))
    return with_other_floors(targets, fits)


def _first_noise(targets: StructureTarget, top: Fits) -> NoiseFit:
    """Where the noise of every structure starts: residuals of each object's best fit.

    Args:
        targets: with one-step gains.
        top: one fit of every structure of every object, in order.
    """
    likelihood: Any = targets.log_likelihood
    evidence = _laplace_evidence(targets, top)
    num_objects, num_structures = evidence.shape
    champion = np.argmax(evidence, axis=1)
    best = top.take(np.arange(num_objects) * num_structures + champion)
    found = evaluate_points(targets, best.index, best.structure, best.z)
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[:, None]
    square = np.where(found.num > 0, found.square / np.maximum(found.num, 1.0), 0.0)
    residual = scale * np.sqrt(1.0 + np.nan_to_num(square))
    start = NoiseFit(_START_NOISE * residual, residual[..., 2:])
    return start.take(np.repeat(np.arange(num_objects), num_structures))


class _NoiseFound(NamedTuple):
    """Noise of every structure of every object, in order."""

    noise: NoiseFit
    gain: np.ndarray
    """By how much it is likelier than what was there before, of each object the most
    among structures that may count [nat]."""


def _noise_of_structures(
    targets: StructureTarget,
    top: Fits,
    start: NoiseFit,
    has_filters: bool,
    is_open: np.ndarray,
) -> _NoiseFound:
    """Noise of the most probable structures; the others get that of the best.

    Structures that are out of the question do not get their own either, once there are
    filters to tell so.

    Args:
        targets: stacked along a leading object axis.
        top: one fit of every structure of every object, in order.
        start: where to start for each of them.
        has_filters: whether the fits are of filters, or of single steps.
        is_open: of which objects; the others keep theirs.
    """
    evidence = _laplace_evidence(targets, top)
    num_objects, num_structures = evidence.shape
    num_bodies = start.reading.shape[1]
    num_fitted = min(max(1, _MOST_FITTED // num_bodies**2), num_structures)
    order = np.argsort(-evidence, axis=1, kind="stable")[:, :num_fitted]
    gap = evidence.max(axis=1, keepdims=True) - np.take_along_axis(evidence, order, 1)
    is_asked = (gap < _HOPELESS) | (not has_filters)
    is_asked[:, 0] = True
    is_asked &= is_open[:, None]
    chosen = np.arange(num_objects)[:, None] * num_structures + order
    rows = chosen[is_asked]
    fitted = top.take(rows)
    peaks = fit_noise(targets, fitted, start.take(rows))
    vector = start.vector.reshape(num_objects, num_structures, -1)
    out = vector.reshape(len(top.z), -1).copy()
    density = NoiseDensity(targets, fitted)
    out[rows] = _widened(density, peaks)
    both = np.stack([start.take(rows).vector, out[rows]], axis=1)
    before, after = density(np.arange(len(rows)), both).T
    gain = np.zeros(len(rows))
    np.subtract(after, before, out=gain, where=np.isfinite(after))
    counts = gap[is_asked] < _MAY_COUNT
    most = np.zeros(num_objects)
    np.maximum.at(most, rows[counts] // num_structures, gain[counts])
    best = out[chosen[:, 0]]
    out = out.reshape(vector.shape)
    is_left = np.ones(evidence.shape, bool)
    is_left.reshape(-1)[rows] = False
    out = np.where(is_left[..., None], best[:, None], out)
    return _NoiseFound(NoiseFit.of_vector(out.reshape(len(top.z), -1)), most)


def _widened(density: Density, peaks: NoisePeaks) -> np.ndarray:
    """Noise with the motion's somewhat above its peak, `[fit, number]`, logarithms.

    Fixed gains leave out that it is uncertain. Taken at its peak they give numbers too
    little spread for a short recording, which weights could not make good later.

    So many sds cost as much density as they would if it were normal, and no more: of
    motion that shows no noise it is flat on one side and falls steeply on the other.
    Structures that lost unlike amounts would be compared by those, and ones without
    draws are not compared again.
    """
    sd = np.sqrt(np.diagonal(np.linalg.inv(peaks.precision), axis1=1, axis2=2))
    number = np.arange(sd.shape[1]) % NUM_EACH
    wide = np.where(number >= 4, _WIDENING * sd, 0.0)
    peak, shares = peaks.noise.vector, np.array(_SHARES)
    tries = peak[:, None] + shares[:, None] * wide[:, None]
    value = density(np.arange(len(peak)), tries)
    with np.errstate(invalid="ignore"):
        drop = peaks.log_density[:, None] - value
    # Where nothing is finite nothing is lost either.
    drop = np.where(np.isnan(drop), 0.0, np.minimum(drop, 1e9))
    drop = np.maximum.accumulate(np.column_stack([0.0 * drop[:, :1], drop]), axis=1)
    most = 0.5 * np.einsum("fi,fij,fj->f", wide, peaks.precision, wide)
    known = np.append(0.0, shares)
    share = [np.interp(*each, known) for each in zip(most, drop, strict=True)]
    return peak + np.array(share)[:, None] * wide


def _laplace_evidence(targets: StructureTarget, top: Fits) -> np.ndarray:
    """Of one fit of every structure of every object, `[object, structure]`."""
    sign, log_volume = np.linalg.slogdet(top.precision)
    evidence = np.where(sign > 0, top.value - 0.5 * log_volume, -np.inf)
    evidence = evidence + 0.5 * np.log(2.0 * np.pi) * _num_used(targets)[top.structure]
    return evidence.reshape(targets.structures.shape[:2])


def _num_used(targets: StructureTarget) -> np.ndarray:
    """How many coordinates each structure uses."""
    structures, slot = np.asarray(targets.structures[0]), np.asarray(targets.slot[0])
    always = np.sum(slot < 0)
    each = np.bincount(slot[slot >= 0], minlength=structures.shape[1])
    return always + structures @ each
