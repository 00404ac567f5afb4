"""Ranks of the truth among posterior draws, and whether they are uniform.

Where hypotheses are drawn from the prior and data from the model, the rank of any
function of the truth among as many independent posterior draws is uniform. Cook,
Gelman and Rubin (2006); Talts et al. (2018), Validating Bayesian inference algorithms
with simulation-based calibration. Functions of the parameters alone are blind to a
posterior that ignores the data; the likelihood is not: Modrák et al. (2023),
Simulation-based calibration checking for Bayesian computation.
"""

import numpy as np
from scipy import stats

NUM_DRAWS, NUM_BINS = 63, 16
"""Draws that the truth is ranked among, and bins of the 64 ranks."""


def rank(rng: np.random.Generator, truth: float, draws: np.ndarray) -> int:
    """Rank of the truth among draws, ties broken at random."""
    below = int(np.sum(draws < truth))
    return below + int(rng.integers(np.sum(draws == truth) + 1))


def thin(rng: np.random.Generator, num: int) -> np.ndarray:
    """Places of as many draws as ranks need, at random."""
    return rng.choice(num, size=NUM_DRAWS, replace=False)


def uniformity(ranks: np.ndarray) -> float:
    """Chance that ranks would be as uneven if all were equally likely, chi-square."""
    bins = np.asarray(ranks) * NUM_BINS // (NUM_DRAWS + 1)
    counts = np.bincount(bins, minlength=NUM_BINS)
    return float(stats.chisquare(counts).pvalue)
