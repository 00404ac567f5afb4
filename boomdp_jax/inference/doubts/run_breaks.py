"""Rows of one run that do not follow one another, as where runs were put together.

A track goes from row to row of an episode. Where a row starts somewhere else than the
one before ended, the filter has to take one of the two readings for an error, and finds
noise of readings as large as the gap. Of runs that were put together gaps are far; of
rows that were lost on the way they are about as far as the body goes in a row.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.physics.scene_spec import SceneSpec

# A gap is one if it is so many times as far as a body goes in most rows (this quantile
# of them), and the row itself goes on from its own start by less than twice as far.
_TIMES, _QUANTILE, _GOES_ON = 4.0, 0.95, 2.0
# Shorter ones [m, rad] are rounding.
_LEAST = 1e-6
# Rows are missing where a gap is more than so many times the median of others (of one
# number, an angle, the median lies lower in what noise makes of it than of two), or of
# how much farther or less far than the one before a row goes, which is more than noise;
# and more than this share of how far a body goes in a row.
_TIMES_OTHERS, _TIMES_CHANGE, _SHARE_OF_ROW = (6.0, 10.0), (2.0, 4.0), 0.2
# Last digits of readings that rounding leaves of a gap, at most.
_DIGITS = 3.0
_MOST_NAMED = 5
_GLUED = (
    "far more than it goes in a row; expected another 'episode' where another run "
    "begins"
)
_LOST = (
    "as if rows between them were missing; expected rows that follow one another, or "
    "another 'episode' after each gap"
)


def run_break_reasons(spec: SceneSpec, history: History) -> list[str]:
    """Reasons for doubt about rows that start elsewhere than the ones before ended.

    Args:
        spec: the scene, for names.
        history: its readings.

    Returns:
        One line for each body of which there are such rows.
    """
    reasons = []
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        for find, text in ((_gaps, _GLUED), (_missing, _LOST)):
            position, angle = find(history, int(body))
            rows = np.flatnonzero((position > 0.0) | (angle > 0.0))
            if len(rows):
                where = _where(spec.names[body], rows, position, angle)
                reasons.append(f"{where}, {text}")
                break
    return reasons


def _where(name: str, rows: np.ndarray, position: np.ndarray, angle: np.ndarray) -> str:
    """Which rows of a body start elsewhere, and how far."""
    named = ", ".join(str(row) for row in rows[:_MOST_NAMED])
    more = "" if len(rows) <= _MOST_NAMED else f" and {len(rows) - _MOST_NAMED} more"
    return (
        f"{name}: in rows {named}{more} it starts up to {position[rows].max():.2g} m "
        f"and {angle[rows].max():.2g} rad from where the row before ended"
    )


class _Poses(NamedTuple):
    """Poses `[time, 3]` of a body, NaN where not read, and which rows go on."""

    first: Float[np.ndarray, "time 3"]
    last: Float[np.ndarray, "time 3"]
    goes_on: Bool[np.ndarray, " time"]
    """Whether a row belongs to the run of the one before."""


def _poses(history: History, body: int) -> _Poses:
    rows = np.asarray(history.mask)
    first = np.where(history.state_mask, history.state, np.nan)[:, body, :3]
    last = np.where(history.next_state_mask, history.next_state, np.nan)[:, body, :3]
    episode: Int[np.ndarray, " time"] = np.asarray(history.episode)
    goes_on = np.zeros(len(rows), bool)
    goes_on[1:] = rows[1:] & rows[:-1] & (episode[1:] == episode[:-1])
    unread = np.where(rows, 0.0, np.nan)[:, None]
    return _Poses(first + unread, last + unread, goes_on)


def _missing(
    history: History, body: int
) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]:
    """Gaps before each row that look like lost rows [m], [rad]; zero elsewhere.

    Where most rows start at the very reading that the one before ended with, any that
    does not is told by how smoothly the body goes otherwise; where none does, by how
    far two readings of one instant lie apart.
    """
    first, last, goes_on = _poses(history, body)
    found = []
    for channels, others, by_change in zip(
        (slice(0, 2), slice(2, 3)), _TIMES_OTHERS, _TIMES_CHANGE, strict=True
    ):
        moved = _difference(last, first)[:, channels]
        gap = _difference(first, np.roll(last, 1, axis=0))[:, channels]
        gap[~goes_on] = np.nan
        size, length = np.linalg.norm(gap, axis=1), np.linalg.norm(moved, axis=1)
        is_read = ~np.isnan(size)
        is_equal = size <= _LEAST
        earlier, later = np.roll(moved, 1, axis=0), np.roll(moved, -1, axis=0)
        later[~np.roll(goes_on, -1)] = np.nan
        change = np.linalg.norm(moved - earlier, axis=1)[goes_on]
        change = change[~np.isnan(change)]
        if not np.any(is_read) or not len(change):
            found.append(np.zeros(len(gap)))
            continue
        if is_equal.sum() >= 0.5 * is_read.sum():
            least = by_change * np.median(change)
            is_smooth = np.ones(len(gap), bool)
        else:
            least = others * np.median(size[is_read])
            # A reading that is wrong shows in how far the rows beside it go.
            other = np.roll(earlier, 1, axis=0)
            other[~(goes_on & np.roll(goes_on, 1))] = np.nan
            is_smooth = _is_between(moved, earlier, later, size)
            is_smooth &= _is_between(earlier, other, moved, size)
        rounding = _DIGITS * _last_digit(np.concatenate([first, last])[:, channels])
        usual = _SHARE_OF_ROW * np.nanmedian(length)
        least = max(_LEAST, least, usual, rounding)
        with np.errstate(invalid="ignore"):
            found.append(np.where(is_smooth & (size > least), size, 0.0))
    return found[0], found[1]


def _is_between(
    moved: np.ndarray, earlier: np.ndarray, later: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Whether a row goes about as far as its neighbours do, where they were read."""
    both = np.stack([earlier, later])
    is_read = ~np.isnan(both)
    num = is_read.sum(axis=0)
    mean = np.where(is_read, both, 0.0).sum(axis=0) / np.maximum(num, 1)
    mean = np.where(num > 0, mean, moved)
    with np.errstate(invalid="ignore"):
        return np.linalg.norm(moved - mean, axis=1) < 0.5 * size


def _last_digit(values: np.ndarray) -> float:
    """The least by which two readings of a channel differ, the largest of channels."""
    least = 0.0
    for column in values.T:
        steps = np.diff(np.unique(column[~np.isnan(column)]))
        steps = steps[steps > _LEAST]
        least = max(least, float(steps.min(initial=np.inf)) if len(steps) else 0.0)
    return least


def _difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Of poses, the angle's within half a turn."""
    change = one - other
    change[:, 2] = np.angle(np.exp(1j * change[:, 2]))
    return change


def _gaps(
    history: History, body: int
) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]:
    """Gaps before each row [m], [rad]; zero where there is none."""
    first, last, goes_on = _poses(history, body)
    before, after = np.roll(last, 1, axis=0), np.roll(first, -1, axis=0)
    after = np.where(np.roll(goes_on, -1)[:, None], after, last)
    found = []
    for distance in (_position, _angle):
        moved = distance(last, first)
        known = moved[~np.isnan(moved)]
        if not len(known):
            found.append(np.zeros(len(first)))
            continue
        usual = max(float(np.quantile(known, _QUANTILE)), _LEAST)
        gap = np.where(goes_on, distance(first, before), np.nan)
        with np.errstate(invalid="ignore"):
            # Readings that are wrong are no gap: the next is where it would be.
            is_gap = (
                (gap > _TIMES * usual)
                & (distance(last, before) > (_TIMES - _GOES_ON) * usual)
                & (moved <= _GOES_ON * usual)
                & ~(np.roll(moved, 1) > _GOES_ON * usual)
                & (distance(after, last) <= _GOES_ON * usual)
            )
        found.append(np.where(is_gap, gap, 0.0))
    return found[0], found[1]


def _position(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.hypot(one[:, 0] - other[:, 0], one[:, 1] - other[:, 1])


def _angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * (one[:, 2] - other[:, 2]))))
