"""Modes from where they were: for a fit of rows of which most have been fitted before.

Hypotheses that were the best of their structures are climbed on from, with some that
particles have come to, and with neighbours' fits grown by a slot, so that a structure
whose own fit was poor gets another chance. `find_modes` looks everywhere, for four
times as long.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.fits.find_modes import Found
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
from boomdp_jax.inference.fits.fit_noise import with_gains
from boomdp_jax.inference.fits.fit_starts import Guesses, grown_fits
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.target import StructureTarget

# A structure so many nats below the best is left as it is.
_HOPELESS = 50.0
# Draws whose density is looked at to grow a fit, fits that are climbed from and how
# long, and particles that are looked at, all per structure.
_NUM_DRAWS, _NUM_STARTS, _NUM_ITERATIONS, _NUM_PARTICLES = 16, 2, 3, 4


class Known(NamedTuple):
    """What was believed of one object, on the host."""

    champion: np.ndarray
    """Best hypothesis of each structure, `[structure, dim]`."""
    noise: NoiseFit
    """Of each structure."""
    structure: np.ndarray
    """Of some hypotheses that are likely now, `[hypothesis]`."""
    z: np.ndarray


def warm_modes(
    rng: np.random.Generator,
    targets: StructureTarget,
    known: Known,
    settings: FitSettings,
) -> Found:
    """Fit every structure of one object, from what is known.

    Args:
        rng: source of randomness.
        targets: one object, in the coordinates in which all is known.
        known: what was believed.
        settings: how many modes to keep.
    """
    num_structures = targets.structures.shape[1]
    each = np.arange(num_structures)
    none = np.zeros(num_structures)
    start = Fits(0 * each, each, known.champion, none, np.zeros((len(each), 0, 0)))
    targets = with_gains(targets, start, known.noise)
    rows = []
    for k in each:
        mine = np.flatnonzero(known.structure == k)
        num = min(len(mine), _NUM_PARTICLES)
        rows.append(rng.choice(mine, num, replace=False) if num else mine)
    rows = np.concatenate(rows)
    structure = np.concatenate([each, known.structure[rows]])
    z = np.concatenate([known.champion, known.z[rows]])
    fits = make_fits(targets, 0 * structure, structure, z)
    fits = best_of_each(fits, num_structures, _NUM_STARTS)
    few = settings._replace(num_draws=_NUM_DRAWS, num_starts=_NUM_STARTS)
    grown = grown_fits(rng, targets, Guesses.of(targets), fits, few)
    fits = best_of_each(join_fits(fits, grown), num_structures, _NUM_STARTS)
    top = best_of_each(fits, num_structures, 1)
    is_left = top.value < top.value.max() - _HOPELESS
    fits = fits.take(~is_left[fits.structure])
    fits = climb(targets, fits, _NUM_ITERATIONS)
    modes = collect_modes(targets, fits, settings.num_modes)
    return Found(targets, _with(modes, top.take(is_left)), known.noise)


def _with(modes: Modes, others: Fits) -> Modes:
    """Modes of one object, with some of structures that have none."""
    z, precision = np.array(modes.z), np.array(modes.precision)
    value = np.array(modes.log_density)
    num = np.count_nonzero(np.asarray(modes.structure)[0] == 0)
    z[0, num * others.structure] = others.z
    precision[0, num * others.structure] = others.precision
    value[0, num * others.structure] = others.value
    return Modes(
        modes.structure,
        on_device(z, z.dtype),
        on_device(precision, precision.dtype),
        on_device(value, value.dtype),
    )
