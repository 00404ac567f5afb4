"""Channels between their readings, by parabolas through the ones round an instant."""

import numpy as np

# Readings that a parabola goes through at least, and instants before and after its own
# that it may take them from.
_FEWEST, _FARTHEST = 4, 24


def between_readings(
    time: np.ndarray, values: np.ndarray, read: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """What the channels of a run were at instants between their readings, about.

    A parabola by least squares through the readings near an instant, a line where they
    are too few: never before the first reading of a channel or after its last.
    Velocities come from their own readings, or, where these are too few, from the slope
    of the poses.

    Args:
        time: of each instant [s].
        values: `[instant, body, 6]`.
        read: which of them were.
        reach: instants before and after its own that a parabola takes at least.

    Returns:
        Values at all instants, those that were read among them as they were; and where
        there is one.
    """
    # Turns between readings are taken the shorter way.
    values = np.where(read, values, 0.0)
    values[..., 2] = _unwrapped(values[..., 2], read[..., 2])
    value, slope, is_known = _parabolas(time, values, read, reach)
    found = np.where(read, values, value)
    has_value = read | is_known
    has_slope = is_known[..., :3] & ~has_value[..., 3:]
    found[..., 3:] = np.where(has_slope, slope[..., :3], found[..., 3:])
    has_value[..., 3:] |= has_slope
    return found, has_value


def _unwrapped(angle: np.ndarray, read: np.ndarray) -> np.ndarray:
    """Angles `[instant, body]` without jumps from one reading to the next [rad]."""
    out = angle.copy()
    for body in range(angle.shape[1]):
        rows = read[:, body]
        out[rows, body] = np.unwrap(angle[rows, body])
    return out


def _parabolas(
    time: np.ndarray, values: np.ndarray, read: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value and slope of each instant's parabola, and where there is one."""
    width = _widths(read, reach)
    power, weighed = np.zeros((5, *read.shape)), np.zeros((3, *read.shape))
    for offset in range(-_FARTHEST, _FARTHEST + 1):
        here = np.arange(max(0, -offset), len(time) - max(0, offset))
        there = here + offset
        counts = read[there] & (abs(offset) <= width[here])
        apart = np.where(counts, (time[there] - time[here])[:, None, None], 0.0)
        for k in range(5):
            power[k, here] += np.where(counts, apart**k, 0.0)
        for k in range(3):
            weighed[k, here] += np.where(counts, apart**k * values[there], 0.0)
    is_between = np.cumsum(read, axis=0) > 0
    is_between &= np.flip(np.cumsum(np.flip(read, 0), axis=0), 0) > 0
    # In units of the window: sums of powers then have one size.
    unit = np.sqrt(power[2] / np.maximum(power[0], 1.0))
    unit = np.where(unit > 0.0, unit, 1.0)
    row, column = np.indices((3, 3))
    matrix = np.moveaxis(power[row + column], (0, 1), (-2, -1))
    scale = unit[..., None] ** -np.arange(3.0)
    matrix = matrix * scale[..., :, None] * scale[..., None, :]
    right = np.moveaxis(weighed, 0, -1) * scale
    # Too few for a parabola: its bend is taken as zero.
    is_line = power[0] < _FEWEST
    bend = np.array([0.0, 0.0, 1.0])
    keeps = np.where(is_line[..., None], 1.0 - bend, 1.0)
    matrix = matrix * keeps[..., :, None] * keeps[..., None, :]
    matrix = matrix + (1.0 - keeps)[..., None] * np.eye(3)
    is_known = (power[0] >= 2) & is_between & (np.linalg.cond(matrix) < 1e8)
    matrix = np.where(is_known[..., None, None], matrix, np.eye(3))
    found = np.linalg.solve(matrix, (right * keeps)[..., None])[..., 0]
    return found[..., 0], found[..., 1] / unit, is_known


def _widths(read: np.ndarray, reach: int) -> np.ndarray:
    """Instants before and after each one within which there are readings enough."""
    num = len(read)
    total = np.concatenate([np.zeros((1, *read.shape[1:]), int), np.cumsum(read, 0)])
    at, width = np.arange(num), np.full(read.shape, _FARTHEST)
    for wide in range(_FARTHEST - 1, max(reach, 1) - 1, -1):
        high, low = np.minimum(at + wide + 1, num), np.maximum(at - wide, 0)
        width = np.where(total[high] - total[low] >= _FEWEST, wide, width)
    return width
