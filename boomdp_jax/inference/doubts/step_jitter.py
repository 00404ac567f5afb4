"""Steps that are not as long as told, by poses and velocities of the same rows.

Over a step that lasted longer than told a body goes farther than its velocities say, by
more the faster it moves, and turns farther as well. Noise of readings does neither.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from boomdp_jax.inference.readings.outliers import SD_OF_MEDIAN
from boomdp_jax.inference.readings.pose_steps import (
    SHARED,
    Steps,
    norm_of,
    pooled_sds,
    ranks_of,
    sds_of_correlation,
    weighted_median,
)

# Steps whose lengths vary by more than this share of themselves (one sd), and so many
# sds of a rank correlation.
_LEAST_JITTER, _SDS = 0.1, 4.0
# More than this is no jitter: steps would be negative. Poses that are rounded to more
# than a body moves in a row look so.
_MOST_JITTER = 0.6
# Share of rows in which a number does not change, from which poses are rounded so.
_MOST_UNMOVED = 0.05
# Rows in which velocity changes by more than so many times itself stop, start or hit
# something: they say nothing of the length of a step.
_STEADY = 0.2
# Fewer rows tell nothing.
_FEWEST = 16
# How many times as fast the fastest third of rows has to be as the slowest.
_LEAST_CONTRAST = 1.1


class Jitter(NamedTuple):
    """Steps whose lengths vary."""

    what: str
    """By what it shows most: positions or angles."""
    jitter: float
    """One sd [s]."""


def step_jitter(parts: list[Steps]) -> Jitter | None:
    """By how much lengths of steps vary, if they do.

    Three statistics are pooled: of positions and of angles, how much residuals grow
    with speed, and how much the two go together.

    Args:
        parts: positions and angles of one body.

    Returns:
        By how much; None: no more than readings have by chance.
    """
    found = [each for each in map(_growth, parts) if each is not None]
    sds = [each.sds for each in found]
    if len(found) == 2:
        sds.append(_common(*found))
    if not found or pooled_sds(sds) <= _SDS:
        return None
    best = max(found, key=lambda each: each.sds)
    if not _LEAST_JITTER < best.share < _MOST_JITTER:
        return None
    return Jitter(best.what, best.jitter)


class _Growth(NamedTuple):
    """How residuals along the motion grow with its speed."""

    what: str
    sds: float
    share: float
    """Sd of a step's length, as a share of it."""
    jitter: float
    """The same [s]."""
    rest: Float[np.ndarray, " row"]
    """Residuals along the motion [m] or [rad]."""
    index: Int[np.ndarray, " row"]
    """Which rows they are of."""


def _growth(steps: Steps) -> _Growth | None:
    """Rank correlation of squared residuals and speeds, in sds of it.

    Speeds and directions are those beside the row: its own hold its own noise, and of
    a body at rest residuals and speeds would be one and the same.
    """
    speed, change = norm_of(steps.beside), steps.half_change
    with np.errstate(invalid="ignore"):
        is_steady = (speed > 0.0) & (2.0 * norm_of(change) < _STEADY * speed)
    use = is_steady & _beside(steps, is_steady)
    if np.sum(use) < _FEWEST:
        return None
    if np.mean(steps.rate[use] == 0.0) > _MOST_UNMOVED:
        return None
    beside, speed = steps.beside[use], speed[use]
    rate, mean = steps.rate[use], steps.mean[use]
    ratio = _scale(rate, mean, beside)
    rest = np.sum((rate - ratio * mean) * beside, axis=1) / speed
    # What is in proportion to the push is lateness, either way.
    push = np.sum(change[use] * beside, axis=1) / speed
    if np.any(push):
        some = push != 0.0
        rest = rest - push * weighted_median(rest[some] / push[some], push[some] ** 2)
    # In lengths: noise of poses is one of those, and steps may differ.
    length, rest = speed * steps.dt[use], rest * steps.dt[use]
    size, ranks = ranks_of(np.abs(rest)), ranks_of(length)
    correlation = float(np.mean(size * ranks))
    # Neighbours share readings, and a speed lasts.
    other = size - correlation * ranks
    shared = sum(
        max(float(np.mean(other[k:] * other[:-k]) * np.mean(ranks[k:] * ranks[:-k])), 0)
        for k in (1, 2)
    )
    num = len(length) / (1.0 + 2.0 * shared)
    sds = sds_of_correlation(correlation, num)
    order = np.argsort(length)
    third = len(order) // 3
    slow, fast = order[:third], order[-third:]
    spread = [
        (SD_OF_MEDIAN * np.median(np.abs(rest[some]))) ** 2 for some in (slow, fast)
    ]
    far = [np.mean(length[some] ** 2) for some in (slow, fast)]
    if far[1] < _LEAST_CONTRAST**2 * far[0]:
        return None
    more = max(spread[1] - spread[0], 0.0) / (far[1] - far[0])
    share = float(np.sqrt(more))
    jitter = share * float(np.median(steps.dt[use]))
    return _Growth(steps.what, sds, share, jitter, rest, steps.index[use])


def _beside(steps: Steps, is_steady: Bool[np.ndarray, " row"]) -> np.ndarray:
    """Rows whose neighbours are steady as well: of a stop the rows before it too."""
    follows = np.append(False, steps.run[1:] == steps.run[:-1])
    before = ~follows | np.append(True, is_steady[:-1])
    after = ~np.append(follows[1:], False) | np.append(is_steady[1:], True)
    return before & after


def _common(one: _Growth, other: _Growth) -> float:
    """Whether residuals of positions and angles go together, in sds.

    A step that was longer is longer for both, and their noise has nothing in common.
    """
    _, mine, its = np.intersect1d(one.index, other.index, return_indices=True)
    if len(mine) < _FEWEST:
        return 0.0
    correlation = np.mean(ranks_of(one.rest[mine]) * ranks_of(other.rest[its]))
    return sds_of_correlation(float(correlation), len(mine) / SHARED)


def _scale(rate: np.ndarray, mean: np.ndarray, beside: np.ndarray) -> float:
    """Ratio of rates to velocities that is taken out first; one where it is unclear."""
    size = float(np.sum(mean * beside))
    if size <= 0.0:
        return 1.0
    ratio = float(np.sum(rate * beside)) / size
    error = np.sqrt(np.sum(((rate - ratio * mean) * beside) ** 2)) / size
    return ratio if error < 0.05 and abs(ratio - 1.0) < 0.2 else 1.0
