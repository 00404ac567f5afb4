"""Evidence of a law where there may be less noise of the motion with it.

What a model misses it takes for noise of the motion. Measured by that, a law has to say
more than chance would, though with the law next to nothing would be left to chance. So
models with and without it are compared each at its likeliest of some levels of that
noise. What stretches of rows agree on (`residual_regression`) bounds this as well.

Only laws of axes are asked so. Real friction is never quite the model's; then all laws
of friction hold all along and take up some of that noise: of twelve drawers in MuJoCo,
whose damping and dry friction add up, ten would have been doubted, masses right.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.inference.doubts.residual_regression import (
    Absorbed,
    LawFit,
    absorb,
    unit_information,
)

FACTORS = (0.5, 0.2, 0.05)
"""Of the noise of the motion that was found."""
NUM_RIVALS = 4
"""Likeliest other laws of a block that these are compared with."""

# Nats by which stretches must agree on a law, and more than it was found to have.
_STEADY, _MORE = 8.0, 1.0
_GROUPS = ((0, 1), (2,), (3, 4), (5,))


class AtNoise(NamedTuple):
    """Innovations at one level of noise, and what would move them."""

    innovation: Float[np.ndarray, "time 2 body 6"]
    """Whitened."""
    counts: Float[np.ndarray, "time 2 body 6"]
    log_volume: float
    """Log-determinant of all whitenings."""
    moves: Float[np.ndarray, "coordinate time 2 body 6"]
    """Derivative by coordinates in use."""
    pushes: Float[np.ndarray, "part time 2 body 6"]
    """By coefficients of laws."""


def is_worth_asking(fit: LawFit) -> bool:
    """Whether a law holds all along, more than noise as it was found lets it tell."""
    return bool(fit.steady > max(_STEADY, fit.log_bayes_factor + _MORE))


def weighed_again(
    fits: Sequence[LawFit],
    levels: Sequence[AtNoise],
    z: Float[np.ndarray, " coordinate"],
    has_prior: np.ndarray,
) -> list[LawFit]:
    """The same laws, each with its evidence if noise may be less with it.

    Args:
        fits: as they were found.
        levels: the noise that was found, and less of it; pushes of all laws in turn.
        z: coordinates in use.
        has_prior: which of them are standard normal a priori.
    """
    # What is likeliest at the best of some levels is so at one of them.
    without = math.log(len(levels))
    without += max(_log_likelihood(level, z, has_prior, None) for level in levels)
    num_rows, begin, out = len(levels[0].innovation), 0, []
    for fit in fits:
        num_parts = len(fit.coefficient)
        own = slice(begin, begin + num_parts)
        begin += num_parts
        gain = max(_log_likelihood(level, z, has_prior, own) for level in levels)
        gain = unit_information(2.0 * (gain - without), num_parts, num_rows)
        evidence = max(fit.log_bayes_factor, min(gain, fit.steady))
        out.append(fit._replace(log_bayes_factor=evidence))
    return out


def _log_likelihood(
    level: AtNoise, z: np.ndarray, has_prior: np.ndarray, law: slice | None
) -> float:
    """Of the readings, coordinates and the law's coefficients at their likeliest.

    Where innovations of a channel group are larger than they should be they are divided
    by how much, with the law and without: its noise is one draw, which may be low.
    """
    if not np.all(np.isfinite(level.innovation)):
        return -np.inf
    innovation, counts = level.innovation, level.counts
    scale = group_scale(innovation, counts)
    # With the law less is left, so scales are found again.
    for _ in range(1 if law is None else 2):
        known = absorb(
            _flat(innovation / scale), _flat(level.moves / scale), z, has_prior
        )
        rest = known.rest
        if law is not None:
            rest = _without(known, _flat(level.pushes[law] / scale))
        last = scale
        left = rest[: innovation.size].reshape(innovation.shape)
        scale = group_scale(left * last, counts)
    size = np.sum(counts * np.log(last))
    return float(level.log_volume - size - 0.5 * rest @ rest)


def _without(known: Absorbed, derivative: np.ndarray) -> np.ndarray:
    """What is left of innovations without what a law explains, too."""
    columns = derivative.reshape(len(derivative), -1).T
    padded = np.zeros((len(known.rest), columns.shape[1]))
    padded[: len(columns)] = columns
    left = padded - known.basis @ (known.basis.T @ padded)
    return known.rest - left @ np.linalg.lstsq(left, known.rest, rcond=None)[0]


def _flat(values: np.ndarray) -> np.ndarray:
    """All readings of a row in one axis."""
    return values.reshape(*values.shape[:-3], -1)


def group_scale(
    innovation: Float[np.ndarray, "time 2 body 6"],
    counts: Float[np.ndarray, "time 2 body 6"],
) -> Float[np.ndarray, "body 6"]:
    """How much larger innovations of a channel group are than they should be, or one.

    The draw's noise is one of many; where it is low, that would be evidence for
    anything.
    """
    square = np.sum(innovation**2, axis=(0, 1))
    num = np.sum(counts, axis=(0, 1))
    out = np.ones_like(square)
    for group in _GROUPS:
        channels = list(group)
        each = square[:, channels].sum(axis=1) / np.maximum(
            num[:, channels].sum(axis=1), 1.0
        )
        out[:, channels] = np.sqrt(np.maximum(each, 1.0))[:, None]
    return out
