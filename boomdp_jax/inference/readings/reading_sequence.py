"""Readings of a history in order of time, one of each instant."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.physics.scene_spec import SceneSpec

# Median of the absolute value of a standard normal.
_MEDIAN = 0.6745
_FEWEST = 12
# Share of values that is rounding to single precision.
_DIGITS = 1e-6


class ReadingSequence(NamedTuple):
    """What was read of all bodies, instant after instant."""

    values: Float[np.ndarray, "reading body 6"]
    """NaN where nothing was read."""
    run: Int[np.ndarray, " reading"]
    """Those of one run follow one another."""


def readings_in_order(spec: SceneSpec, history: History) -> ReadingSequence:
    """Ends of all rows, and starts of those that do not go on from the one before.

    Args:
        spec: the scene; its static bodies are where it has them.
        history: its readings.
    """
    first, last = (
        np.where(mask, np.asarray(values, float), np.nan)
        for values, mask in (
            (history.state, np.asarray(history.state_mask)),
            (history.next_state, np.asarray(history.next_state_mask)),
        )
    )
    rows = np.flatnonzero(np.asarray(history.mask))
    begins = ~np.asarray(history.is_chained)[rows]
    both = np.stack([first[rows], last[rows]], axis=1)
    use = np.column_stack([begins, np.ones(len(rows), bool)])
    run = np.repeat(np.cumsum(begins)[:, None], 2, axis=1)
    values = both[use]
    for index, body in enumerate(spec.bodies):
        if body.is_static and body.pose is not None:
            values[:, index, :3] = body.pose
    return ReadingSequence(values, run[use])


def scatter(
    values: Float[np.ndarray, "reading part"],
    run: Int[np.ndarray, " reading"],
    *,
    is_angle: bool = False,
    time: Float[np.ndarray, " reading"] | None = None,
) -> float | None:
    """Standard deviation of the noise of readings, at most.

    By how far each is from the line through the ones before and after, of most of them:
    what a push adds to that only makes it more. No less than the step of values that
    were rounded.

    Args:
        values: readings; what is not finite is skipped.
        run: which run each belongs to.
        is_angle: whether whole turns do not count.
        time: of each reading, where those that were not read leave gaps; without it
            readings are taken to be evenly spaced.

    Returns:
        In the unit of the values, the root mean square of the parts'; None where one
        has fewer than twelve such triples.
    """
    squares = []
    for part in values.T:
        is_read = np.isfinite(part)
        own, of = part[is_read], run[is_read]
        change = np.diff(own)
        if is_angle:
            change = np.angle(np.exp(1j * change))
        bend = np.diff(change)
        if time is not None:
            at = time[is_read]
            share = (at[1:-1] - at[:-2]) / (at[2:] - at[:-2])
            # Off the line through the others, in units of what noise makes of that.
            bend = (1.0 - share) * change[:-1] - share * change[1:]
            bend *= np.sqrt(6.0 / (1.0 + share**2 + (1.0 - share) ** 2))
        bend = np.abs(bend[of[2:] == of[:-2]])
        if len(bend) < _FEWEST:
            return None
        sd = float(np.median(bend)) / (_MEDIAN * np.sqrt(6.0))
        squares.append(max(sd, rounding_step(own)) ** 2)
    return float(np.sqrt(np.mean(squares)))


def rounding_step(values: np.ndarray) -> float:
    """The least by which two of some values differ, but for rounding of their digits.

    Args:
        values: any number; what is not finite is skipped.
    """
    levels = np.unique(values[np.isfinite(values)])
    step = np.diff(levels)
    step = step[step > _DIGITS * np.max(np.abs(levels), initial=0.0)]
    return float(np.min(step, initial=np.inf)) if len(step) else 0.0
