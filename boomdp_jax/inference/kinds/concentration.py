"""How readily an object is of a new kind: the mixture's concentration, given kinds."""

import numpy as np


def draw_concentration(
    rng: np.random.Generator,
    concentration: np.ndarray,
    num_kinds: np.ndarray,
    num_objects: np.ndarray,
    shape: float,
    rate: float,
) -> np.ndarray:
    """One Gibbs step by an auxiliary beta variable.

    Escobar and West (1995), Bayesian density estimation and inference using mixtures,
    section 6.

    Args:
        rng: source of randomness.
        concentration: of each chain.
        num_kinds: that have an object, in each chain.
        num_objects: in each chain.
        shape: of the gamma prior.
        rate: of the gamma prior.

    Returns:
        New concentrations.
    """
    beta = rng.beta(concentration + 1.0, num_objects)
    total_rate = rate - np.log(beta)
    odds = (shape + num_kinds - 1.0) / (num_objects * total_rate)
    is_more = rng.random(len(beta)) < odds / (1.0 + odds)
    return rng.gamma(shape + num_kinds - 1.0 + is_more) / total_rate


def draw_stick_concentration(
    rng: np.random.Generator, sticks: np.ndarray, shape: float, rate: float
) -> np.ndarray:
    """The same given the broken sticks of a truncated mixture.

    Ishwaran and James (2001), Gibbs sampling methods for stick-breaking priors,
    section 5.3.

    Args:
        rng: source of randomness.
        sticks: share of what is left that each kind takes, `[chain, kind - 1]`.
        shape: of the gamma prior.
        rate: of the gamma prior.

    Returns:
        Concentrations, `[chain]`.
    """
    left = -np.log1p(-np.minimum(sticks, 1.0 - 1e-15)).sum(axis=1)
    return rng.gamma(shape + sticks.shape[1], size=len(sticks)) / (rate + left)
