"""Gains at the noise's mean, for those who keep them: the mean, not the peak.

Of the motion's noise readings often say only that it is below some level, and its peak
sits at that level's edge; filters that take it at the peak, or above, lose much of what
was measured: of sixty rows of a pinned box, posteriors of the mass with gains at one
standard deviation above the peak were twice as wide as those with noise inferred.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.fits.find_modes import Found
from boomdp_jax.inference.fits.fit import (
    Fits,
    FitSettings,
    best_of_each,
    climb,
    collect_modes,
    make_fits,
)
from boomdp_jax.inference.fits.fit_noise import NoiseDensity, with_gains
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.noise.proposal import NoiseProposal

# Structures that get a mean of their own, and so many nats of the best.
_MOST, _NEAR = 4, 8.0


class TypicalNoise(NamedTuple):
    """Modes under gains of the mean noise, and what is known of the noise."""

    found: Found
    chosen: np.ndarray
    """Structures of the object with a noise of their own, the most probable first."""
    proposal: NoiseProposal
    """Of the noise of each of those."""


def typical_noise(
    rng: np.random.Generator,
    found: Found,
    settings: FitSettings,
    *,
    is_near: bool = False,
) -> TypicalNoise:
    """Give every structure the gains of the mean noise at its best fit; climb again.

    Where all was near before, modes stay: new gains would move them by little.

    Args:
        rng: source of randomness.
        found: modes of one object, and the targets whose modes they are.
        settings: how hard to look.
        is_near: whether noise and modes are known to be near already.

    Returns:
        The same with other gains, and the modes that belong to them.
    """
    targets, modes = found.targets, found.modes
    num_structures = targets.structures.shape[1]
    value = np.asarray(modes.log_density, float)[0]
    dim = modes.z.shape[-1]
    fits = Fits(
        np.zeros(len(value), int),
        np.asarray(modes.structure)[0],
        np.asarray(modes.z, float)[0],
        value,
        np.asarray(modes.precision, float).reshape(-1, dim, dim),
    ).take(np.isfinite(value))
    top = best_of_each(fits, num_structures, 1)
    height = top.value - 0.5 * np.linalg.slogdet(top.precision)[1]
    chosen = np.argsort(-height, kind="stable")[:_MOST]
    chosen = chosen[height[chosen] > height[chosen[0]] - _NEAR]
    structure = top.structure[chosen]
    proposal = NoiseProposal.fit(
        rng,
        NoiseDensity(targets, top.take(chosen)),
        found.noise.take(structure),
        is_near=is_near,
    )
    # The last component is the one that weighed draws were fitted by.
    typical = proposal.center[:, -1]
    vector = np.tile(typical[0], (num_structures, 1))
    vector[structure] = typical
    noise = NoiseFit.of_vector(vector)
    if is_near:
        return TypicalNoise(found._replace(noise=noise), structure, proposal)
    # In a world of another law some structure may have no fit that is finite.
    targets = with_gains(targets, top, noise.take(top.structure))
    again = make_fits(targets, fits.index, fits.structure, fits.z)
    fits = climb(targets, again, settings.num_repeats)
    modes = collect_modes(targets, fits, settings.num_modes)
    return TypicalNoise(Found(targets, modes, noise), structure, proposal)
