"""Where a thing was on its way at each reading, as those around have it."""

import numpy as np
from jaxtyping import Float

from boomdp_jax.inference.doubts.way_of_body import Way

# Readings on either side for a place; for what is ahead, itself and those before.
_BESIDE, _BEFORE = 3, 2
# Places that are told worse than by so many times the noise are not told.
_MOST = 3.0
_SINGULAR = 1e10


def places_nearby(way: Way) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place at each reading, and where those up to it, or from it, have the next.

    Args:
        way: the coordinate, of which places, or speeds, or both were read.

    Returns:
        By parabolas through the readings around, and lines through those before, and
        after. NaN where too little was read.
    """
    step = np.diff(way.time)
    return (
        _through(way, -_BESIDE, _BESIDE, 3, way.time),
        _through(way, -_BEFORE, 0, 2, way.time + np.append(step, 0.0)),
        _through(way, 0, _BEFORE, 2, way.time - np.append(0.0, step)),
    )


def _through(
    way: Way, first: int, last: int, num: int, when: np.ndarray
) -> Float[np.ndarray, " reading"]:
    """Values of polynomials with so many numbers, each of some readings."""
    at = np.arange(len(way.place))[:, None] + np.arange(first, last + 1)
    own = np.clip(at, 0, len(way.place) - 1)
    is_in = (at == own) & (way.run[own] == way.run[:, None])
    unit = max(float(np.median(np.diff(way.time))), np.finfo(float).tiny)
    time = np.where(is_in, way.time[own] - when[:, None], 0.0) / unit
    powers = np.arange(num)
    rises = powers * time[..., None] ** np.maximum(powers - 1, 0) / unit
    basis = np.concatenate([time[..., None] ** powers, rises], axis=1)
    value = np.concatenate([way.place[own], way.speed[own]], axis=1)
    error = np.concatenate([way.place_error[own], way.speed_error[own]], axis=1)
    is_read = np.tile(is_in, 2) & np.isfinite(value) & np.isfinite(error)
    weight = np.where(is_read, 1.0 / np.where(is_read, error, 1.0), 0.0)
    rows = basis * weight[..., None]
    normal = rows.transpose(0, 2, 1) @ rows
    right = np.einsum("krn,kr->kn", rows, np.where(is_read, value, 0.0) * weight)
    sizes = np.linalg.eigvalsh(normal)
    is_told = sizes[:, 0] * _SINGULAR > sizes[:, -1]
    normal = np.where(is_told[:, None, None], normal, np.eye(num))
    inverse = np.linalg.inv(normal)
    is_told &= inverse[:, 0, 0] < (_MOST * way.noise) ** 2
    return np.where(is_told, np.einsum("kn,kn->k", inverse[:, 0], right), np.nan)
