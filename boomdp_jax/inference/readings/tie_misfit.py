"""By how much the readings of two bodies miss the best common tie.

A pair is inferred apart where that is more than can be noise. It is asked of the
readings as they are, and, where they miss, once more of their running medians, from
which a few gross errors and most of what is noise have gone: a tie that one of the two
allows may be there. (Medians alone would not do: of what swings fast they are off.)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

# Readings of which a running median is made, at most, and windows that a run has at
# least: bursts of half as many vanish, and what moves for longer than that stays.
_WINDOW, _LEAST_WINDOWS = 9, 6
# Of normal noise the standard deviation over the median distance from zero.
_NORMAL = 1.4826
# Noise that is left in what misses, as a share of that of single readings.
_SHARE_OF_NOISE = 2.0
_NUM_REWEIGHTED = 20


class Misfit(NamedTuple):
    """What a pair misses a tie by, root mean square [m]."""

    raw: float
    """Of the readings."""
    smooth: float
    """Of running medians of what the best robust fit leaves."""
    noise: float
    """Of single readings, of either body and angle, where the tie holds."""

    def may_be(self, tolerance: float) -> bool:
        """Whether the pair may be tied, given what is missed by without noise [m]."""
        allowed = max(tolerance, _SHARE_OF_NOISE * self.noise)
        return self.raw < tolerance or self.smooth < allowed


def pin_misfit(a: np.ndarray, b: np.ndarray, run: np.ndarray) -> Misfit:
    """How far the best point of one body is from the best point of another.

    Args:
        a: poses of the one, `[reading, 3]` [m, m, rad].
        b: poses of the other.
        run: which run each reading belongs to; readings of a run follow each other.

    Returns:
        All zero without readings.
    """
    if len(a) == 0:
        return Misfit(0.0, 0.0, 0.0)
    left, right = rotations(a[:, 2]), rotations(b[:, 2])
    matrix = np.concatenate([left, -right], axis=-1)
    offset = a[:, :2] - b[:, :2]

    def missed(weight: np.ndarray) -> np.ndarray:
        scale = np.sqrt(weight)[:, None]
        rows = (scale[..., None] * matrix).reshape(-1, 4)
        wanted = -(scale * offset).reshape(-1)
        solution = np.linalg.lstsq(rows, wanted, rcond=1e-6)[0]
        return matrix @ solution + offset

    raw = missed(np.ones(len(a)))
    # Of each of the two components.
    both = (part / np.sqrt(2.0) for part in (raw, _robust(missed, raw)))
    return _both(*both, run)


def pin_distances(
    a: np.ndarray, b: np.ndarray, scale: tuple[float, float], tolerance: float
) -> Float[np.ndarray, " 2"]:
    """How far from either centre the best common point is [m].

    Of a pin it is asked to be near where readings do not tell: a body that does not
    turn has the same motion wherever it is pinned.

    Args:
        a: poses of the one, `[reading, 3]` [m, m, rad].
        b: poses of the other.
        scale: how far from either centre a pin is expected to be [m].
        tolerance: by how much readings may miss it [m].

    Returns:
        Zero without readings.
    """
    left, right = rotations(a[:, 2]), rotations(b[:, 2])
    rows = np.concatenate([left, -right], axis=-1).reshape(-1, 4)
    wanted = -(a[:, :2] - b[:, :2]).reshape(-1)
    near = tolerance / np.repeat(np.asarray(scale), 2)
    matrix = np.concatenate([rows, np.diag(near)])
    best = np.linalg.lstsq(matrix, np.append(wanted, np.zeros(4)), rcond=None)[0]
    return np.hypot(best[0::2], best[1::2])


def slide_misfit(a: np.ndarray, b: np.ndarray, reach: float, run: np.ndarray) -> Misfit:
    """How far the one is from the best line fixed in the other, and from its angle.

    Args:
        a: poses of the one, `[reading, 3]` [m, m, rad].
        b: poses of the other.
        reach: by how far an angle moves the outline of the one, per radian [m].
        run: as `pin_misfit` has it.

    Returns:
        All zero without readings.
    """
    if len(a) == 0:
        return Misfit(0.0, 0.0, 0.0)
    place = np.einsum("tji,tj->ti", rotations(b[:, 2]), a[:, :2] - b[:, :2])
    angle = a[:, 2] - b[:, 2]

    def missed(weight: np.ndarray) -> np.ndarray:
        share = weight / weight.sum()
        off = place - share @ place
        across = np.linalg.eigh(off.T @ (share[:, None] * off))[1][:, 0]
        mean = np.angle(share @ np.exp(1j * angle))
        # Half of the chord: as the sine, but grows over all of half a turn.
        turned = 2.0 * np.sin(0.5 * (angle - mean))
        return np.stack([off @ across, reach * turned], axis=1)

    raw = missed(np.ones(len(a)))
    return _both(raw, _robust(missed, raw), run)


def rod_range(a: np.ndarray, b: np.ndarray, run: np.ndarray) -> float:
    """By how much the distance of two bodies varies, gross errors apart [m].

    Args:
        a: poses of the one, `[reading, 3]` [m, m, rad].
        b: poses of the other.
        run: as `pin_misfit` has it.
    """
    if len(a) == 0:
        return 0.0
    distance = np.hypot(*(a[:, :2] - b[:, :2]).T)
    smooth = running_median(distance[:, None], run)[0]
    return float(min(np.ptp(distance), np.ptp(smooth)))


def rotations(angle: np.ndarray) -> np.ndarray:
    """Matrices that turn by angles, `[..., 2, 2]`."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def running_median(
    values: np.ndarray, run: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Within each run, and where there was enough of it to take one.

    Args:
        values: `[reading, component]`.
        run: which run each reading belongs to; readings of a run follow each other.

    Returns:
        Medians, readings as they are where there are too few, and where it is one.
    """
    out, is_smooth = np.array(values), np.zeros(len(values), bool)
    edges = np.flatnonzero(np.diff(run) != 0) + 1
    for rows in np.split(np.arange(len(values)), edges):
        half = min(_WINDOW, len(rows) // _LEAST_WINDOWS) // 2
        if half == 0:
            continue
        windows = sliding_window_view(values[rows], 2 * half + 1, axis=0)
        # At the ends the window moves in as a whole.
        begin = np.clip(np.arange(len(rows)) - half, 0, len(windows) - 1)
        out[rows] = np.median(windows, axis=-1)[begin]
        is_smooth[rows] = True
    return out, is_smooth


def _robust(
    missed: Callable[[np.ndarray], np.ndarray], start: np.ndarray
) -> np.ndarray:
    """What the fit of least absolute distances leaves, by reweighting."""
    found = start
    for _ in range(_NUM_REWEIGHTED):
        size = np.linalg.norm(found, axis=1)
        least = max(1e-3 * float(np.median(size)), 1e-9)
        before, found = found, missed(1.0 / np.maximum(size, least))
        if np.max(np.abs(found - before)) < least:
            break
    return found


def _both(raw: np.ndarray, robust: np.ndarray, run: np.ndarray) -> Misfit:
    """Of what both fits leave, `[reading, component]`."""
    smooth, is_smooth = running_median(robust, run)
    noise = 0.0
    if np.any(is_smooth):
        rest = np.abs(robust - smooth)[is_smooth]
        noise = _NORMAL * float(np.sqrt(np.sum(np.median(rest, axis=0) ** 2)))
    return Misfit(_size(raw), _size(smooth), noise)


def _size(missed: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))
