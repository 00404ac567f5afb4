"""From weighted draws to numbers for people: mean, sd, quantiles, and what is known.

A quantity is *identified* where its posterior variance is under half of its prior
variance on the scale that it is sampled on; where it is not, the prior's interval is
what can honestly be said, so that is what is reported. Unless the data moved the
quantity without narrowing it, as a few noisy readings do with a prior that is narrow
and beside the truth: then the draws' own interval is reported.
"""

import math
from typing import Any, Literal

import numpy as np

Scale = Literal["identity", "log", "logit", "axial"]
"""Scale on which spread is judged; `axial`: an angle that is the same modulo pi."""

CHANNELS = ("position", "angle", "velocity", "spin")
IMPULSES = ("velocity_impulse", "spin_impulse")
"""Groups of readings that share a noise scale, in the order of the last axis."""

_LEAST_MOVED = 0.5
"""Prior sds between the means of draws and prior above which they are not the same."""

_NO_DIRECTION = 0.5
"""Variance [rad²] of axial angles above which their mean says nothing: uniform ones
have 0.82."""

_FEWEST_DRAWS = 5.0
"""Effective draws below which a variance is not worth comparing with the prior's."""


def weighted_quantiles(
    draws: np.ndarray, weights: np.ndarray, levels: tuple[float, ...]
) -> np.ndarray:
    """Quantiles of weighted draws, interpolated between the middles of the steps.

    With equal weights this is Hazen's rule, `numpy.quantile(..., method="hazen")`.

    Args:
        draws: values, `[draw, number]`.
        weights: non-negative, sum to one, `[draw]`.
        levels: in [0, 1].

    Returns:
        Quantiles, `[level, number]`.
    """
    order = np.argsort(draws, axis=0, kind="stable")
    result = np.empty((len(levels), draws.shape[1]))
    for column in range(draws.shape[1]):
        weight = weights[order[:, column]]
        middle = np.cumsum(weight) - 0.5 * weight
        result[:, column] = np.interp(levels, middle, draws[order[:, column], column])
    return result


def axial_mean(angle: np.ndarray, weights: np.ndarray) -> float:
    """Mean of angles that are the same modulo pi [rad], in (-pi/2, pi/2]."""
    sine, cosine = weights @ np.sin(2.0 * angle), weights @ np.cos(2.0 * angle)
    return 0.5 * math.atan2(sine, cosine)


def axial_difference(angle: np.ndarray, centre: float) -> np.ndarray:
    """Difference of angles modulo pi [rad], in [-pi/2, pi/2)."""
    return np.mod(angle - centre + 0.5 * np.pi, np.pi) - 0.5 * np.pi


class Summary(dict):
    """Fields of a summary as JSON has them, and what people are told besides."""

    def __init__(self, fields: dict, is_prior: tuple[bool, ...]):
        super().__init__(fields)
        self.is_prior = is_prior
        """Of each number, whether its interval is the prior's."""


def summarise(
    draws: np.ndarray,
    weights: np.ndarray,
    prior: np.ndarray | None,
    scale: Scale | tuple[Scale, ...] = "identity",
) -> Summary:
    """Summarise one quantity, number by number.

    Args:
        draws: posterior draws, `[draw]` or `[draw, number]`.
        weights: of the draws, sum to one, `[draw]`.
        prior: equally weighted prior draws of the same quantity; None: there are none,
            then nothing counts as identified and the interval is the posterior's.
        scale: on which spread is judged, one for all numbers or one for each.

    Returns:
        `mean`, `sd`, `q05`, `q50`, `q95`, `identified`, each a plain number (a list of
        them for a vector), with None in place of what is not finite. A number whose
        prior does not vary was given, and counts as identified.
    """
    is_vector = draws.ndim == 2
    table = np.asarray(draws, np.float64).reshape(len(draws), -1)
    scales = (scale,) * table.shape[1] if isinstance(scale, str) else scale
    columns = []
    for number, one_scale in enumerate(scales):
        value = table[:, number]
        reference = prior
        if prior is not None:
            reference = np.asarray(prior, np.float64).reshape(len(prior), -1)[:, number]
        columns.append(_summarise_one(value, weights, reference, one_scale))
    fields = columns[0][0]
    if is_vector:
        fields = {key: [column[key] for column, _ in columns] for key in fields}
    return Summary(plain(fields), tuple(is_prior for _, is_prior in columns))


def _summarise_one(
    value: np.ndarray, weights: np.ndarray, prior: np.ndarray | None, scale: Scale
) -> tuple[dict, bool]:
    """Statistics of one number's draws or of its prior, and whether of the latter."""
    own = _statistics(value, weights, scale)
    if prior is None:
        return {**own, "identified": False}, False
    equal = np.full(len(prior), 1.0 / len(prior))
    if np.all(prior == prior[0]):
        return {**own, "identified": True}, False
    if len(value) == 1:
        # A single hypothesis says what it is, and nothing of what is known.
        return {**own, "identified": False}, False
    num = 1.0 / np.sum(weights**2)
    centre, spread = _moments(value, weights, scale, prior)
    prior_centre, prior_spread = _moments(prior, equal, scale, prior)
    if num >= _FEWEST_DRAWS and spread < 0.5 * prior_spread:
        return {**own, "identified": True}, False
    # The draws' mean has an error of its own.
    least = _LEAST_MOVED * np.sqrt(prior_spread) + 2.0 * np.sqrt(spread / num)
    if scale == "axial" and prior_spread > _NO_DIRECTION:
        least = np.inf
    if num >= _FEWEST_DRAWS and abs(centre - prior_centre) > least:
        return {**own, "identified": False}, False
    return {**_statistics(prior, equal, scale), "identified": False}, True


def plain(value: Any) -> Any:
    """Turn arrays and numbers into what JSON knows; what is not finite becomes None."""
    if isinstance(value, Summary):
        return value
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | bool | int):
        return value
    return str(value)


def _statistics(value: np.ndarray, weights: np.ndarray, scale: Scale) -> dict:
    """Mean, sd and quantiles of one number; an axial one is unrolled at its mean."""
    if np.all(value == value[0]):
        names = ("mean", "q05", "q50", "q95")
        sd = 0.0 if np.isfinite(value[0]) else np.nan
        return {**dict.fromkeys(names, float(value[0])), "sd": sd}
    centre = axial_mean(value, weights) if scale == "axial" else 0.0
    if scale == "axial":
        value = axial_difference(value, centre)
    with np.errstate(invalid="ignore"):
        mean = weights @ value
        sd = np.sqrt(weights @ (value - mean) ** 2)
    levels = weighted_quantiles(value[:, None], weights, (0.05, 0.5, 0.95))[:, 0]
    return {
        "mean": float(centre + mean),
        "sd": float(sd),
        "q05": float(centre + levels[0]),
        "q50": float(centre + levels[1]),
        "q95": float(centre + levels[2]),
    }


def _moments(
    value: np.ndarray, weights: np.ndarray, scale: Scale, prior: np.ndarray
) -> tuple[float, float]:
    """Mean and variance on a scale; NaN where a value is infinite.

    Axial angles are unrolled at their own mean, which is told from the prior's.
    """
    centre = 0.0
    if scale == "axial":
        own = axial_mean(value, weights)
        middle = axial_mean(prior, np.full(len(prior), 1.0 / len(prior)))
        centre = float(axial_difference(np.array([own]), middle)[0])
        value = axial_difference(value, own)
    elif scale == "log":
        value = np.log(np.maximum(value, np.finfo(np.float32).tiny))
    elif scale == "logit":
        size = np.finfo(np.float32).tiny
        value = np.log(np.maximum(value, size)) - np.log(np.maximum(1.0 - value, size))
    with np.errstate(invalid="ignore"):
        mean = float(weights @ value)
        return centre + mean, float(weights @ (value - mean) ** 2)
