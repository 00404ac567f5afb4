"""Do readings err more where a body moves faster?

A filter has the same noise of the motion in every step. Where it is not, as of contacts
that chatter while they slide, the noise that is found is a mean: whatever predicts fast
motion is too sure of it, and what predicts slow motion not sure enough.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Rows that it takes to say so.
_FEWEST = 20


class SpreadGrowth(NamedTuple):
    """How standardised innovations of one body grow with its speed."""

    p_value: float
    """Of ranks that agree as closely where they do not."""
    slow: float
    """Root mean square over the slowest third of steps; one is as expected."""
    fast: float
    """Over the fastest third."""


def spread_growth(
    innovation: Float[np.ndarray, "time channel"],
    counts: Float[np.ndarray, "time channel"],
    twist: Float[np.ndarray, "time 3"],
    radius: float,
) -> SpreadGrowth | None:
    """Compare the size of innovations with speed, by ranks.

    Spearman's coefficient with Fisher's transformation, and the variance of Fieller,
    Hartley and Pearson (1957), Tests for rank correlation coefficients.

    Args:
        innovation: whitened, of the reading that ends each step; twists alone if any
            were read.
        counts: one where it was read.
        twist: at which the body moved.
        radius: of gyration [m], by which spin is compared with velocity.

    Returns:
        What was found; None with too few readings, or with one speed only.
    """
    channels = slice(3, 6) if np.any(counts[:, 3:]) else slice(0, 3)
    num = counts[:, channels].sum(axis=1)
    square = np.sum(innovation[:, channels] ** 2 * counts[:, channels], axis=1)
    seen = num > 0
    size = square[seen] / num[seen]
    speed = np.hypot(np.hypot(twist[:, 0], twist[:, 1]), radius * twist[:, 2])[seen]
    count = len(size)
    if count < _FEWEST or np.ptp(speed) == 0 or np.ptp(size) == 0:
        return None
    agreement = float(np.corrcoef(_ranks(size), _ranks(speed))[0, 1])
    agreement = min(max(agreement, -0.9999), 0.9999)
    score = math.atanh(agreement) * math.sqrt((count - 3.0) / 1.06)
    order = np.argsort(speed, kind="stable")
    third = count // 3
    slow, fast = (
        float(np.sqrt(size[rows].mean())) for rows in (order[:third], order[-third:])
    )
    return SpreadGrowth(0.5 * math.erfc(score / math.sqrt(2.0)), slow, fast)


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks, equal values sharing the mean of theirs."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return (last - 0.5 * (count - 1))[place.reshape(-1)]
