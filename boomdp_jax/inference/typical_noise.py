"""Gains at the noise's mean, for those who keep them: the mean, not the peak.

Of the motion's noise readings often say only that it is below some level, and its peak
sits at that level's edge; filters that take it at the peak, or above, lose much of what
was measured: of sixty rows of a pinned box, posteriors of the mass with gains at one
standard deviation above the peak were twice as wide as those with noise inferred.
"""

import numpy as np

from boomdp_jax.inference.find_modes import Found
from boomdp_jax.inference.fit import (
    Fits,
    FitSettings,
    best_of_each,
    climb,
    collect_modes,
    make_fits,
)
from boomdp_jax.inference.fit_noise import with_gains
from boomdp_jax.inference.noise_level import NoiseFit
from boomdp_jax.inference.noise_proposal import NoiseProposal

# Structures that get a mean of their own, and so many nats of the best.
_MOST, _NEAR = 4, 8.0


def with_typical_gains(
    rng: np.random.Generator, found: Found, settings: FitSettings
) -> Found:
    """Give every structure the gains of the mean noise at its best fit; climb again.

    Args:
        rng: source of randomness.
        found: modes, and the targets whose modes they are.
        settings: how hard to look.

    Returns:
        The same with other gains, and the modes that belong to them.
    """
    targets, modes = found.targets, found.modes
    num_objects, num_structures = targets.structures.shape[:2]
    value = np.asarray(modes.log_density, float)
    keep = np.isfinite(value).reshape(-1)
    index = np.repeat(np.arange(num_objects), value.shape[1])
    dim = modes.z.shape[-1]
    fits = Fits(
        index,
        np.asarray(modes.structure).reshape(-1),
        np.asarray(modes.z, float).reshape(-1, dim),
        value.reshape(-1),
        np.asarray(modes.precision, float).reshape(-1, dim, dim),
    ).take(keep)
    top = best_of_each(fits, num_structures, 1)
    height = top.value - 0.5 * np.linalg.slogdet(top.precision)[1]
    chosen = _probable(top.index, height)
    proposal = NoiseProposal.fit(
        rng,
        targets,
        top.take(chosen),
        np.arange(len(chosen)),
        found.noise.take(top.index[chosen] * num_structures + top.structure[chosen]),
    )
    vector = found.noise.vector
    # The last component is the one that weighed draws were fitted by.
    typical = proposal.center[:, -1]
    best: dict[int, np.ndarray] = {}
    for row, mean in zip(chosen, typical, strict=True):
        best.setdefault(int(top.index[row]), mean)
    for number in range(num_objects):
        vector[number * num_structures : (number + 1) * num_structures] = best[number]
    vector[top.index[chosen] * num_structures + top.structure[chosen]] = typical
    noise = NoiseFit.of_vector(vector)
    # In a world of another law some structure may have no fit that is finite.
    mine = top.index * num_structures + top.structure
    targets = with_gains(targets, top, noise.take(mine))
    again = make_fits(targets, fits.index, fits.structure, fits.z)
    fits = climb(targets, again, settings.num_repeats)
    return Found(targets, collect_modes(targets, fits, settings.num_modes), noise)


def _probable(index: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Rows of each object's highest few, highest first."""
    rows = []
    for number in np.unique(index):
        mine = np.flatnonzero(index == number)
        mine = mine[np.argsort(-height[mine], kind="stable")][:_MOST]
        rows.append(mine[height[mine] > height[mine[0]] - _NEAR])
    return np.concatenate(rows)
