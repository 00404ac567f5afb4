"""Further climbs where few of the first ones agree on how high there is to go.

Slipping and holding, saturated limits and angles make many local optima, and the best
few of many starts tend to lie in one basin. Of boxes with a wheel whose numbers are
drawn from the prior, seen for twenty steps, the best of eight climbs from such starts
misses the truth by more than five nats in one of six (29 of 184), by tens mostly. What
gives a miss away is that few climbs end at the best: an optimum is taken for the
highest once several have (Boender and Rinnooy Kan 1987, Mathematical Programming 37,
59), of climbs that know nothing of each other. The first ones do not count: they start
from the highest few of many points or go on from each other (while they did, eleven of
the 29 were left). So climbs start from anywhere, without regard to how high that is,
besides from the best one with some coordinates changed (iterated local search, Lourenço
et al. 2003). None of the 184 is left then.
"""

from typing import Any

import numpy as np

from boomdp_jax.inference.fits.fit import (
    Fits,
    FitSettings,
    Host,
    best_of_each,
    climb,
    join_fits,
    make_fits,
)
from boomdp_jax.inference.fits.fit_starts import Guesses
from boomdp_jax.inference.fits.seeds import random_starts
from boomdp_jax.inference.likelihoods.target import StructureTarget

# So many climbs that count within so many nats of the best of an object's best
# structure, and it is taken for the best there is.
_AGREE, _NEAR = 3, 2.0
# Structures of a lone body that are searched, climbs of each in a round, and most
# iterations of one; the work grows with the square of the number of channels.
_MOST_STRUCTURES, _NUM_CLIMBS, _NUM_ITERATIONS = 3, 16, 12
# Share of the coordinates that change where a climb starts from the best one, and by
# how much in half of them; in the others they come from a start from anywhere.
_SHARE, _NUDGE = 0.3, 0.5
# In terms of what a structure may lack: fits that are searched further have not come to
# their best.
_LENIENCE = 2.0


def search_further(
    rng: np.random.Generator,
    targets: StructureTarget,
    guesses: Guesses,
    fits: Fits,
    settings: FitSettings,
    lack: np.ndarray,
) -> Fits:
    """Add climbs of objects whose best fit is not known to be the highest.

    Args:
        rng: source of randomness.
        targets: with one-step gains, stacked along a leading object axis.
        guesses: where constraints would have to be.
        fits: climbed ones, of all structures.
        settings: how many rounds of climbs.
        lack: as for `climb`; structures that lack twice as much are not searched.

    Returns:
        The same, and what was found.
    """
    num_structures = targets.structures.shape[1]
    likelihood: Any = targets.log_likelihood
    num_bodies = likelihood.reference.shape[-2]
    most = max(1, _MOST_STRUCTURES // num_bodies)
    num = max(2, _NUM_CLIMBS // num_bodies**2)
    host = Host.of(targets)
    # Of several bodies a climb is dear, and all count.
    counted = fits.take(np.zeros(0, int)) if num_bodies == 1 else fits
    is_anywhere = np.arange(num) < num // 2
    for _ in range(settings.num_searches):
        top = best_of_each(fits, num_structures, 1)
        rows = _doubtful(counted, top, lack, num_structures, most)
        if rows.size == 0:
            break
        starts = [
            _starts(rng, host, guesses, top.take(rows[i : i + 1]), num)
            for i in range(len(rows))
        ]
        each = np.repeat(rows, num)
        begun = make_fits(
            targets, top.index[each], top.structure[each], np.concatenate(starts)
        )
        found = climb(targets, begun, _NUM_ITERATIONS, is_patient=True)
        fits = join_fits(fits, found)
        if num_bodies == 1:
            found = found.take(np.tile(is_anywhere, len(rows)))
        counted = join_fits(counted, found)
    return fits


def _doubtful(
    counted: Fits, top: Fits, lack: np.ndarray, num_structures: int, most: int
) -> np.ndarray:
    """Rows of `top`, one fit of every structure in order, that are to be searched.

    Those of objects of which few of the climbs that count end at the best.
    """
    value = top.value.reshape(-1, num_structures)
    champion = np.argmax(value, axis=1)
    highest = value[np.arange(len(value)), champion]
    agrees = (counted.structure == champion[counted.index]) & (
        counted.value > highest[counted.index] - _NEAR
    )
    num = np.bincount(counted.index[agrees], minlength=len(value))
    order = np.argsort(-value, axis=1, kind="stable")[:, :most]
    # Where nothing is finite nothing is above minus infinity.
    least = (highest - _LENIENCE * lack)[:, None]
    is_worth = np.take_along_axis(value, order, axis=1) > least
    is_searched = is_worth & (num < _AGREE)[:, None]
    rows = np.arange(len(value))[:, None] * num_structures + order
    return rows[is_searched]


def _starts(
    rng: np.random.Generator, host: Host, guesses: Guesses, best: Fits, num: int
) -> np.ndarray:
    """Starts of one structure, half of them from anywhere, `[start, dim]`."""
    i, in_use = best.index[0], host.in_use[best.structure[0]]
    anywhere = random_starts(rng, guesses.z[i], guesses.has[i], host.period, num)
    near = best.z + _NUDGE * rng.standard_normal(anywhere.shape)
    changed = np.where(rng.random((num, 1)) < 0.5, near, anywhere)
    is_changed = rng.random(anywhere.shape) < _SHARE
    is_from_best = np.arange(num)[:, None] >= num // 2
    changed = np.where(is_changed, changed, best.z)
    return host.wrap(np.where(in_use, np.where(is_from_best, changed, anywhere), 0.0))
