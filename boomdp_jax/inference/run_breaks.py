"""Rows of one run that do not follow one another, as where runs were put together.

A track goes from row to row of an episode. Where a row starts somewhere else than the
one before ended, the filter has to take one of the two readings for an error, and finds
noise of readings as large as the gap.
"""

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.physics.scene_spec import SceneSpec

# A gap is one if it is so many times as far as a body goes in most rows (this quantile
# of them), and the row itself goes on from its own start by less than twice as far.
_TIMES, _QUANTILE, _GOES_ON = 4.0, 0.95, 2.0
# Shorter ones [m, rad] are rounding.
_LEAST = 1e-6
_MOST_NAMED = 5


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
        position, angle = _gaps(history, int(body))
        rows = np.flatnonzero((position > 0.0) | (angle > 0.0))
        if not len(rows):
            continue
        named = ", ".join(str(row) for row in rows[:_MOST_NAMED])
        more = (
            "" if len(rows) <= _MOST_NAMED else f" and {len(rows) - _MOST_NAMED} more"
        )
        reasons.append(
            f"{spec.names[body]}: in rows {named}{more} it starts up to "
            f"{position[rows].max():.2g} m and {angle[rows].max():.2g} rad from where "
            "the row before ended, far more than it goes in a row; expected another "
            "'episode' where another run begins"
        )
    return reasons


def _gaps(
    history: History, body: int
) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]:
    """Gaps before each row [m], [rad]; zero where there is none."""
    rows = np.asarray(history.mask)
    first = np.where(history.state_mask, history.state, np.nan)[:, body]
    last = np.where(history.next_state_mask, history.next_state, np.nan)[:, body]
    episode: Int[np.ndarray, " time"] = np.asarray(history.episode)
    goes_on = np.zeros(len(rows), bool)
    goes_on[1:] = rows[1:] & rows[:-1] & (episode[1:] == episode[:-1])
    before, after = np.roll(last, 1, axis=0), np.roll(first, -1, axis=0)
    after = np.where(np.roll(goes_on, -1)[:, None], after, last)
    found = []
    for distance in (_position, _angle):
        moved = np.where(rows, distance(last, first), np.nan)
        known = moved[~np.isnan(moved)]
        if not len(known):
            found.append(np.zeros(len(rows)))
            continue
        usual = max(float(np.quantile(known, _QUANTILE)), _LEAST)
        gap = np.where(goes_on, distance(first, before), np.nan)
        with np.errstate(invalid="ignore"):
            # Readings that are wrong are no gap: the next is where it would be.
            is_gap = (
                (gap > _TIMES * usual)
                & (distance(last, before) > (_TIMES - _GOES_ON) * usual)
                & (moved <= _GOES_ON * usual)
                & (distance(after, last) <= _GOES_ON * usual)
            )
        found.append(np.where(is_gap, gap, 0.0))
    return found[0], found[1]


def _position(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.hypot(one[:, 0] - other[:, 0], one[:, 1] - other[:, 1])


def _angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * (one[:, 2] - other[:, 2]))))
