"""Poses of bodies at instants at which others were read, for pairs read in turn.

Between two of its readings a body is put on the straight line from the one to the
next. By how much that is off is told by how far each reading is from the line through
its neighbours: of a steady push that is four times as much, of a sudden one at least as
much. A pair is allowed to miss a tie by that.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History

# Longest time between two readings that is bridged [s], and turn [rad]: in a longer one
# a push may come and go, and half a turn more looks like half a turn less.
_LONGEST, _LARGEST_TURN = 0.5, 1.5
# Of fewer readings of a run no one has two neighbours.
_FEWEST = 3


class Tracks(NamedTuple):
    """Poses in order of time, each instant once."""

    pose: Float[np.ndarray, "instant body 3"]
    """[m, m, rad]; NaN where neither read nor between readings."""
    error: Float[np.ndarray, "instant body 3"]
    """By how much they may be off besides their noise; zero where they were read."""
    run: Int[np.ndarray, " instant"]
    """Which run each belongs to: rows that follow each other without a gap."""


def bridged_tracks(history: History) -> Tracks:
    """Poses of all bodies at all instants at which any of them was read.

    Args:
        history: readings of all bodies.
    """
    rows = np.asarray(history.mask)
    before, after = (
        np.where(np.asarray(mask)[rows], np.asarray(values, float)[rows], np.nan)
        for values, mask in (
            (history.state, history.state_mask),
            (history.next_state, history.next_state_mask),
        )
    )
    is_chained = np.asarray(history.is_chained)[rows]
    # Channels of an instant that only the row before it has.
    is_only = np.isnan(before[1:]) & is_chained[1:, None, None]
    before[1:] = np.where(is_only, after[:-1], before[1:])
    starts = np.flatnonzero(~is_chained)
    dt = np.asarray(history.dt, float)[rows]
    none = np.zeros((0, history.num_bodies, 3))
    poses, errors, run = [none], [none], [np.zeros(0, int)]
    for number, own in enumerate(np.split(np.arange(len(dt)), starts)):
        if len(own) == 0:
            continue
        read = np.concatenate([before[own], after[own[-1:]]])[..., :3]
        run.append(np.full(len(read), number))
        if len(read) < _FEWEST:
            poses.append(read)
            errors.append(np.zeros_like(read))
            continue
        time = np.append(0.0, np.cumsum(dt[own]))
        filled = [
            [_bridged(time, read[:, body, c], c == 2) for c in range(3)]
            for body in range(read.shape[1])
        ]
        # From [body, channel, which, instant].
        pose, error = np.transpose(np.array(filled), (2, 3, 0, 1))
        poses.append(pose)
        errors.append(error)
    return Tracks(np.concatenate(poses), np.concatenate(errors), np.concatenate(run))


def _bridged(
    time: Float[np.ndarray, " instant"],
    read: Float[np.ndarray, " instant"],
    is_angle: bool,
) -> tuple[Float[np.ndarray, " instant"], Float[np.ndarray, " instant"]]:
    """One channel of one body in one run, and by how much it may be off."""
    at = np.flatnonzero(np.isfinite(read))
    filled, error = np.array(read), np.zeros_like(read)
    if len(at) < _FEWEST or len(at) == len(read):
        return filled, error
    value = np.unwrap(read[at]) if is_angle else read[at]
    share = (time[at[1:-1]] - time[at[:-2]]) / (time[at[2:]] - time[at[:-2]])
    bend = np.abs(value[1:-1] - value[:-2] - share * (value[2:] - value[:-2]))
    bend = np.concatenate([bend[:1], bend, bend[-1:]])
    after = np.clip(np.searchsorted(at, np.arange(len(read))), 1, len(at) - 1)
    is_short = time[at[after]] - time[at[after - 1]] <= _LONGEST
    if is_angle:
        is_short &= np.abs(value[after] - value[after - 1]) < _LARGEST_TURN
    is_between = (np.arange(len(read)) > at[0]) & (np.arange(len(read)) < at[-1])
    is_new = np.isnan(read) & is_between & is_short
    filled[is_new] = np.interp(time, time[at], value)[is_new]
    error[is_new] = np.maximum(bend[after], bend[after - 1])[is_new]
    return filled, error
